"""Ideal observer: likelihood ratio between a frame with a vehicle and the same one without.

Position, background and vehicle are known; only noise is not. The log-likelihood ratio T of independent
elements has under both hypotheses the cumulants of one function, K(s) = ln E₀[e^{sT}] = Σ ln ∫ p₁ˢ p₀¹⁻ˢ:
with the vehicle it is K(s + 1). Tails follow by the saddle point, down to false alarms too rare for draws.

Of DoLP alone, Q/I and U/I have normal noise to first order; the density of their length follows by a sum over
the angle, and the cumulants by Monte Carlo over draws of both hypotheses, the same for every s.

References
----------
Lugannani and Rice, Adv. Appl. Prob. 12, 475 (1980); Kay, Fundamentals of Statistical Signal Processing II
(1998), §3; Barrett and Myers, Foundations of Image Science (2004), §13.2 (ideal observer, its moments).
"""

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple, cast

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage
from scipy.special import log_ndtr, logsumexp, ndtr

from glintrack.bounds.evidence import (
    Polarization,
    dolp_variance,
    group_elements,
    superpixel_polarization,
)
from glintrack.bounds.finder import DIRECTIONS, FOOTPRINTS_M
from glintrack.core.arrays import Array
from glintrack.sensor import Sensor, SensorDesign

REACH_ELEMENTS = 14.0  # from a vehicle's silhouette: its shadow
_CHANGED = 0.05  # of the noise: less is the renderer's rounding
Cumulants = Callable[[float], float]
_STEP = 1e-3  # of numerical derivatives of K: its curvature is at least 1e-9 of itself there
_MIN_LOG_MISS = math.log(1e-6)  # a less probable miss counts as none
_MAX_S = 1e4
_BISECTIONS = 60
DRAWS = 64  # of each hypothesis and superpixel
MAX_SUPERPIXELS = 24  # of a vehicle that are used, those with the largest contrast: a lower bound
_ANGLES = 24  # a step of 2σ/3: the sum of a Gaussian is good to 1e-15
_REACH = 8.0  # standard deviations


def count_hypotheses(area_m: tuple[float, float, float, float]) -> float:
    """Count positions and directions of a car in the window: footprints side by side, times eight."""
    west, south, east, north = area_m
    length, width = FOOTPRINTS_M[0]
    return (east - west) * (north - south) / (length * width) * DIRECTIONS


def ideal_observer(
    group: str,
    without_e: Float[Array, "row column"],
    present_e: Float[Array, "row column"],
    nearest: Int[Array, "row column"],
    vehicles: Int[Array, "vehicle"],
    sensor: Sensor,
    false_alarm: float,
    rng: np.random.Generator,
) -> tuple[Float[Array, "vehicle"], Float[Array, "vehicle"]]:
    """P_D and d′ of each vehicle with its position and the background known.

    Parameters
    ----------
    group
        pan, dolp or all.
    without_e, present_e
        Expected electrons of the frame without vehicles and with them. [e]
    nearest
        Vehicle of each element, from `assign_elements`.
    vehicles
        Ids.
    sensor, false_alarm
        The sensor; the false-alarm probability of one hypothesis.
    rng
        Random generator of the draws of DoLP.
    """
    probability, d_prime = np.zeros(len(vehicles)), np.zeros(len(vehicles))
    frames, design, full_e = (without_e, present_e), sensor.design, sensor.design.saturation_e
    means = [np.minimum(mean, full_e) for mean in frames]
    read = [(mean, design.noise_variance_e2(mean)) for mean in means]
    for k, rows, columns in find_changes(*frames, nearest, vehicles, design):
        if group == "dolp":
            without, present = (dolp_of(*one, rows, columns, sensor) for one in read)
            if not len(present.mean):
                continue
            cumulants, limit = dolp_cumulants(without, present, rng), math.inf
        else:
            inside = is_in_group(group, rows, columns, sensor)
            if not inside.any():
                continue
            without, present = (frame[rows[inside], columns[inside]] for frame in frames)
            variances = design.noise_variance_e2(without), design.noise_variance_e2(present)
            cumulants, limit = element_cumulants(Elements(without, present, *variances, full_e))
        d_prime[k] = detectability(cumulants)
        probability[k] = detection_probability(cumulants, false_alarm, min(limit, _MAX_S))
    return probability, d_prime


def dolp_of(mean_e: Array, variance_e2: Array, rows: Array, columns: Array, sensor: Sensor) -> Polarization:
    """Polarization of the whole superpixels that contain some elements."""
    superpixels = np.unique(np.stack([rows // sensor.side, columns // sensor.side], axis=1), axis=0)
    whole = (superpixels < np.array(mean_e.shape) // sensor.side).all(axis=1)
    return superpixel_polarization(mean_e, variance_e2, sensor, superpixels[whole])


def assign_elements(on: Int[Array, "row column"]) -> Int[Array, "row column"]:
    """Id of the vehicle with the nearest silhouette to each element, −1 beyond `REACH_ELEMENTS`.

    ``on`` is from `frame.vehicles_on`. Shadows that vehicles share are thus divided between them.
    """
    found = ndimage.distance_transform_edt(on < 0, return_indices=True)
    distance, nearest = cast(tuple[Array, Array], found)  # SciPy's annotation allows None too
    return np.where(distance <= REACH_ELEMENTS, on[tuple(nearest)], -1)


def find_changes(
    without_e: Array, present_e: Array, nearest: Array, vehicles: Array, design: SensorDesign
) -> Iterator[tuple[int, Array, Array]]:
    """Row of each vehicle that changes any elements, and rows and columns of these elements."""
    sigma = np.sqrt(design.noise_variance_e2(without_e))
    rows, columns = np.nonzero((np.abs(present_e - without_e) > _CHANGED * sigma) & (nearest >= 0))
    owner = nearest[rows, columns]
    order = np.argsort(owner, kind="stable")
    first = np.searchsorted(owner[order], vehicles, "left")
    last = np.searchsorted(owner[order], vehicles, "right")
    for k, (start, stop) in enumerate(zip(first, last, strict=True)):
        if stop > start:
            mine = order[start:stop]
            yield k, rows[mine], columns[mine]


def is_in_group(group: str, rows: Array, columns: Array, sensor: Sensor) -> Array:
    """Return True for each element that belongs to a group."""
    inside = np.zeros((sensor.side, sensor.side), np.bool_)
    inside[tuple(np.transpose(group_elements(group, sensor)))] = True
    return inside[rows % sensor.side, columns % sensor.side]


class Elements(NamedTuple):
    """Expected electrons of some elements without and with a vehicle, and their noise.

    Parameters
    ----------
    without, present
        Expected electrons without the vehicle and with it. [e]
    variance_without, variance_present
        Variance of the noise of each. [e²]
    full_well_e
        Electrons at which an element saturates: all above is one outcome. [e]
    """

    without: Float[Array, "element"]
    present: Float[Array, "element"]
    variance_without: Float[Array, "element"]
    variance_present: Float[Array, "element"]
    full_well_e: float


def element_cumulants(elements: Elements) -> tuple[Cumulants, float]:
    """K(s) of elements with shot and dark noise, full ones censored; and the s up to which it is finite.

    Shot noise is taken as normal with the variance of its mean: of 50 electrons and more.
    """
    m0, m1, v0, v1 = (np.asarray(values, float) for values in elements[:4])
    full = elements.full_well_e
    full0, full1 = log_ndtr((m0 - full) / np.sqrt(v0)), log_ndtr((m1 - full) / np.sqrt(v1))
    grows = v1 > v0
    limit = float((v1[grows] / (v1[grows] - v0[grows])).min()) if grows.any() else _MAX_S

    def cumulants(s: float) -> float:
        mixed = s * v0 + (1 - s) * v1
        if mixed.min(initial=1.0) <= 0:
            return math.inf
        inside = -0.5 * s * (1 - s) * (m1 - m0) ** 2 / mixed
        inside += 0.5 * (s * np.log(v0) + (1 - s) * np.log(v1) - np.log(mixed))
        centre, width = (s * m1 * v0 + (1 - s) * m0 * v1) / mixed, np.sqrt(v0 * v1 / mixed)
        inside += log_ndtr((full - centre) / width)
        return float(np.logaddexp(inside, s * full1 + (1 - s) * full0).sum())

    return cumulants, min(limit, _MAX_S)


def detectability(cumulants: Cumulants) -> float:
    """d′ of the ideal observer: the root of E₁[T] − E₀[T], which for equal normal noise is √(ΣΔ²/σ²). [1]"""

    def inner_slope(s: float, step: float) -> float:
        """K′ from one side: past 0 and 1 K may end at once, where one of the means is dark."""
        return (4 * cumulants(s + step) - 3 * cumulants(s) - cumulants(s + 2 * step)) / (2 * step)

    return math.sqrt(max(inner_slope(1.0, -_STEP) - inner_slope(0.0, _STEP), 0.0))


def detection_probability(cumulants: Cumulants, false_alarm: float, limit: float = _MAX_S) -> float:
    """P(T > t | vehicle) at the threshold where P(T > t | none) is the false-alarm probability. [1]

    Parameters
    ----------
    cumulants, limit
        From `element_cumulants`, or any K(s) and the s up to which it is finite.
    false_alarm
        False-alarm probability of one hypothesis, greater than 0 and less than a half. [1]

    Raises
    ------
    ValueError
        If the false-alarm probability is out of its range.
    """
    if not 0 < false_alarm < 0.5:
        raise ValueError(f"`false_alarm` must be greater than 0 and less than 0.5; got {false_alarm:g}.")
    half = cumulants(0.5)
    if 2 * half - math.log(false_alarm) < _MIN_LOG_MISS:  # Chernoff's bound on a miss
        return 1.0
    if half > -1e-12:
        return false_alarm
    low, high = 0.0, min(1.0, 0.999 * limit)
    while _tail(cumulants, high, 0.0) > false_alarm and high < 0.999 * limit:
        low, high = high, min(2 * high, 0.999 * limit)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if _tail(cumulants, middle, 0.0) > false_alarm:
            low = middle
        else:
            high = middle
    return min(max(_tail(cumulants, 0.5 * (low + high), 1.0), false_alarm), 1.0)


def _tail(cumulants: Cumulants, s: float, origin: float) -> float:
    """P(T > K′(s)) by the saddle point, without the vehicle (``origin`` 0) or with it (1)."""
    if abs(s - origin) < 5 * _STEP:  # the formula's removable singularity
        # K is finite from 0 to 1, and on one side of either perhaps no farther than a step
        sides = [side for side in (-1, 1) if math.isfinite(cumulants(origin + side * 7 * _STEP))]
        ends = (_tail(cumulants, origin + side * 6 * _STEP, origin) for side in sides)
        return sum(ends) / len(sides)
    here, above, below = cumulants(s), cumulants(s + _STEP), cumulants(s - _STEP)
    threshold, curvature = (above - below) / (2 * _STEP), (above - 2 * here + below) / _STEP**2
    saddle = s - origin
    w = math.copysign(math.sqrt(max(2 * (saddle * threshold - here), 1e-300)), saddle)
    u = saddle * math.sqrt(max(curvature, 1e-300))
    density = math.exp(-(w**2) / 2) / math.sqrt(2 * math.pi)
    return float(np.clip(ndtr(-w) + density * (1 / u - 1 / w), 0.0, 1.0))


def dolp_cumulants(without: Polarization, present: Polarization, rng: np.random.Generator) -> Cumulants:
    """K(s) of the likelihood ratio of a vehicle's DoLP; see `detection_probability`.

    Parameters
    ----------
    without, present
        Polarization of the same superpixels without the vehicle and with it.
    rng
        Random generator of the draws.
    """
    gap = np.linalg.norm(present.mean, axis=1) - np.linalg.norm(without.mean, axis=1)
    contrast = gap**2 / (dolp_variance(without) + dolp_variance(present))
    used = np.argsort(-contrast, kind="stable")[:MAX_SUPERPIXELS]
    both = [Polarization(h.mean[used], h.covariance[used]) for h in (without, present)]
    deviates, lengths = rng.standard_normal((2, len(used), DRAWS, 2)), []
    for of, deviate in zip(both, deviates, strict=True):
        root = np.linalg.cholesky(of.covariance + 1e-18 * np.eye(2))
        normal = of.mean[:, None] + np.einsum("nab,ndb->nda", root, deviate)
        lengths.append(np.linalg.norm(normal, axis=-1))
    log0, log1 = (_log_density(h, np.concatenate(lengths, axis=1)) for h in both)
    proposal = np.logaddexp(log0, log1) - np.log(2)  # draws of both hypotheses in equal parts

    def cumulants(s: float) -> float:
        exponent = s * log1 + (1 - s) * log0 - proposal
        top = exponent.max(axis=1)
        mean = np.exp(exponent - top[:, None]).mean(axis=1)
        # drawn from a mixture, the mean density is 1 to within noise at s = 0 and 1: taken out linearly in s
        return float((top + np.log(mean)).sum()) - (1 - s) * ends[0] - s * ends[1]

    ends = (0.0, 0.0)
    ends = (cumulants(0.0), cumulants(1.0))
    return cumulants


def _log_density(of: Polarization, length: Array) -> Float[Array, "superpixel draw"]:
    """Log density of the length of a normal 2-vector: its density on the circle, summed over the angle."""
    inverse = np.linalg.inv(of.covariance + 1e-18 * np.eye(2))
    norm = -np.log(2 * np.pi) + 0.5 * np.log(np.linalg.det(inverse))
    middle = np.arctan2(of.mean[:, 1], of.mean[:, 0])
    widest = np.sqrt(np.linalg.eigvalsh(of.covariance)[:, -1] + 1e-18)
    half = np.minimum(np.pi, _REACH * widest[:, None] / np.maximum(length, 1e-12))
    step = (np.arange(_ANGLES) + 0.5) * 2 / _ANGLES - 1
    angle = middle[:, None, None] + half[..., None] * step
    offset = length[..., None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    offset -= of.mean[:, None, None]
    exponent = -0.5 * np.einsum("ndka,nab,ndkb->ndk", offset, inverse, offset)
    total = logsumexp(exponent, axis=-1) + np.log(2 * half / _ANGLES)
    return norm[:, None] + np.log(np.maximum(length, 1e-300)) + total
