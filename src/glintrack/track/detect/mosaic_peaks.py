"""Evidence of vehicles in the residuals of raw elements: change, peaks, motion and likelihood ratio.

1. Squared change of elements (``pan``, ``all``) or of S1/S0 and S2/S0 of superpixels (``dolp``) over its
   variance. DoLP and angle of polarization follow from those two ratios. Readings are compared with the
   *expected readings of the same elements*, so the effect of the polarizers' different places cancels.
2. Its mean logarithm on a ground grid, where each cell is seen.
3. Peaks of the means under windows of a vehicle's size.
4. Track before detect: support of each peak by the best straight motion through earlier frames. An earlier
   frame counts no more than the peak itself, so that one strong glint elsewhere supports nothing.
5. A logistic model of these numbers gives the log-likelihood ratio of vehicle against clutter. Its constants
   are in ``data/calibration/mosaic.toml``; ``python tools/calibrate.py mosaic`` fits and writes them.
"""

from dataclasses import dataclass

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.core.records import Mosaic
from glintrack.track.calibration import read_calibration
from glintrack.track.detect.footprint import peak_places, peaks
from glintrack.track.detect.mosaic_model import ElementPrediction

FREEDOM = 3.0  # of Student's t: one wild element is no vehicle
APART_M = 3.0  # of peaks: cars in a queue stand 6 m apart
CAP = 4.0  # of a window's strength: a glint shows no more vehicle than a car
MIN_STRENGTH_SPREADS = 2.0  # of a peak
SPREAD_RANGE = 0.03, 0.2  # of the flights that calibrate the model
MAX_STRENGTH = 6.0  # strength counts no further
MIN_SPEED_M_S, SPEED_STEP_M_S = 2.5, 1.2
FEATURES = (
    "support_root", "strength", "still", "still_root", "restless", "restless_root", "log_spread"
)  # fmt: skip
MAX_RATIO = 8.0  # beyond it the calibration flights hold no clutter to count
MIN_RATIO = 1.1  # of a detection: with less false tracks come, with more tracks are lost
_ROUNDING = 1 - 1e-9  # of the best motion's support: rounding in a sum leaves out none that is better


@dataclass(frozen=True)
class PastStrength:
    """Strength of the windows in earlier frames.

    Parameters
    ----------
    layers, ages_s
        Of each frame, the greatest within a cell [1], and how long ago it was [s].
    restless
        Mean over the last seconds. [1]
    """

    layers: Float[Array, "frame row column"]
    ages_s: Float[Array, "frame"]
    restless: Float[Array, "row column"]


@dataclass(frozen=True)
class Peaks:
    """Peaks of one frame, likely vehicles or not.

    Parameters
    ----------
    place
        Row and column of each in the grid of windows. [cell]
    features
        `FEATURES` of each: root of the mean strength along the best straight motion; its own strength; the
        mean at a standstill, which speaks against a vehicle; the mean over the last seconds at its place,
        which speaks for one, since roads are where something moved before; and the logarithm of the frame's
        spread, since a strength says more where windows hold more readings. [1]
    velocity
        East and north speed of that motion. [m s⁻¹]
    """

    place: Float[Array, "peak 2"]
    features: Float[Array, "peak feature"]
    velocity: Float[Array, "peak 2"]

    def __len__(self) -> int:
        """Count of peaks."""
        return len(self.place)


def no_peaks() -> Peaks:
    """No peaks at all."""
    return Peaks(np.empty((0, 2)), np.empty((0, len(FEATURES))), np.empty((0, 2)))


def searched_elements(
    layout: tuple[tuple[str | float, ...], ...], channel: str
) -> tuple[tuple[int, int], ...]:
    """Places in the superpixel of the elements that a channel searches.

    Without a mirror or an open element, pan is what the polarizers see.

    Raises
    ------
    ValueError
        If the channel is DoLP and fewer than three polarizers are there.
    """
    every = [(i, j) for i, row in enumerate(layout) for j in range(len(row))]
    polarizers = [(i, j) for i, j in every if not isinstance(layout[i][j], str)]
    if channel == "dolp":
        if len(polarizers) < 3:
            raise ValueError(
                "`mosaic` must have three polarizers in a superpixel for channel 'dolp', "
                f"got {len(polarizers)}"
            )
        return tuple(polarizers)
    bare = [place for place in every if place not in polarizers]
    return tuple(bare if channel == "pan" and bare else every)


def element_change(
    seen: ElementPrediction, mosaic: Mosaic, places: tuple[tuple[int, int], ...], channel: str
) -> tuple[tuple[Float[Array, "row column"], ...], Float[Array, "plane 2"]]:
    """Squared change over its variance, and where in the superpixel each plane of it lies.

    Parameters
    ----------
    seen, mosaic, places
        The prediction of these kinds of elements, and what it was made of.
    channel
        ``pan``, ``dolp`` or ``all``.
    """
    if channel != "dolp":
        return seen.z2, np.array(places, float)
    gains = np.array([mosaic.gains[place] for place in places])
    to_stokes = np.linalg.pinv(gains)
    out = np.empty(seen.z2[0].shape, np.float32)
    stack = (np.stack(part, axis=-1) for part in (seen.readings, seen.expected, seen.var))
    over_rows(_normalized_stokes, len(out), *stack, to_stokes, out)
    return (out,), np.array([np.mean(places, axis=0)])


@nb.njit(cache=True, nogil=True)
def _normalized_stokes(start, stop, readings, expected, var, to_stokes, out):
    """Mahalanobis distance of (S1, S2)/S0 from its expectation, halved: like one z² for two numbers."""
    n = readings.shape[2]
    s, t = np.empty(3), np.empty(3)
    for i in range(start, stop):
        for j in range(out.shape[1]):
            for k in range(3):
                s[k] = t[k] = 0.0
                for p in range(n):
                    s[k] += to_stokes[k, p] * readings[i, j, p]
                    t[k] += to_stokes[k, p] * expected[i, j, p]
            if not (s[0] > 0.0 and t[0] > 0.0):
                out[i, j] = np.nan
                continue
            q, u = t[1] / t[0], t[2] / t[0]
            a = b = c = 0.0
            for p in range(n):
                jq = (to_stokes[1, p] - q * to_stokes[0, p]) / t[0]
                ju = (to_stokes[2, p] - u * to_stokes[0, p]) / t[0]
                a += jq * jq * var[i, j, p]
                b += jq * ju * var[i, j, p]
                c += ju * ju * var[i, j, p]
            dq, du = s[1] / s[0] - q, s[2] / s[0] - u
            det = a * c - b * b
            out[i, j] = (c * dq * dq - 2 * b * dq * du + a * du * du) / det if det > 0.0 else np.nan


def evidence_on_ground(
    planes: tuple[Float[Array, "row column"], ...],
    offsets: Float[Array, "plane 2"],
    side: int,
    element: tuple[Float[Array, "y x"], Float[Array, "y x"]],
) -> Float[Array, "y x"]:
    """Mean over the planes of log(1 + z²/ν) where each cell of a ground grid is seen; 0 where unknown.

    Parameters
    ----------
    planes, offsets
        From `element_change`.
    side
        Elements along a superpixel.
    element
        Row and column of the element that sees each cell.
    """
    out = np.zeros(element[0].shape, np.float32)
    logs = np.log1p(np.stack(planes) * np.float32(1 / FREEDOM))
    over_rows(_gather, len(out), logs, offsets, side, *element, out)
    return out


@nb.njit(cache=True, nogil=True)
def _gather(start, stop, planes, offsets, side, row, column, out):
    n, rows, columns = planes.shape
    per_side, share = np.float32(1 / side), np.float32(1 / n)
    for k in range(n):
        first_row = np.float32(0.5 - offsets[k, 0] / side)
        first_column = np.float32(0.5 - offsets[k, 1] / side)
        for i in range(start, stop):
            for j in range(out.shape[1]):
                r, c = row[i, j] * per_side + first_row, column[i, j] * per_side + first_column
                if r >= 0 and c >= 0 and r < rows and c < columns:  # False of what sees nothing
                    value = planes[k, int(r), int(c)]
                    if value == value:
                        out[i, j] += share * value


def find_peaks(
    means: Float[Array, "row column"],
    usual: float,
    spread: float,
    past: PastStrength,
    cell_m: float,
    max_speed_m_s: float,
) -> Peaks:
    """Peaks of a frame and their features.

    Parameters
    ----------
    means, usual, spread
        Evidence on the ground under the windows, its median, and the median of what lies above it, less
        that: of the ground at rest, since vehicles are few. [1]
    past
        Strength in the frames before.
    cell_m
        Side of a cell. [m]
    max_speed_m_s
        Greatest speed of the motions that are tried. [m s⁻¹]
    """
    spread = float(np.clip(spread, *SPREAD_RANGE))
    cells = peaks(means, usual + MIN_STRENGTH_SPREADS * spread, APART_M, cell_m)
    now = means[tuple(cells.T)] - usual
    place = peak_places(means - np.float32(usual), cells)
    velocity = velocities(MIN_SPEED_M_S, max_speed_m_s, SPEED_STEP_M_S)
    best, motion, still = motion_support(past, cells, np.clip(now, 0.0, CAP), velocity, cell_m)
    often, strength = past.restless[tuple(cells.T)], np.minimum(now, MAX_STRENGTH)
    whole = np.full(len(cells), np.log(spread))
    features = [np.sqrt(best), strength, still, np.sqrt(still), often, np.sqrt(often), whole]
    return Peaks(place, np.stack(features, axis=-1), motion)


def velocities(slowest_m_s: float, fastest_m_s: float, step_m_s: float) -> Float[Array, "velocity 2"]:
    """East and north speeds on a square lattice, between two speeds. [m/s]"""
    count = int(np.ceil(fastest_m_s / step_m_s))
    axis = step_m_s * np.arange(-count, count + 1)
    east, north = np.meshgrid(axis, axis)
    speed = np.hypot(east, north)
    inside = (speed >= slowest_m_s) & (speed <= fastest_m_s)
    return np.stack([east[inside], north[inside]], axis=-1)


def motion_support(
    past: PastStrength,
    peak: Int[Array, "peak 2"],
    strength: Float[Array, "peak"],
    velocity: Float[Array, "velocity 2"],
    cell_m: float,
) -> tuple[Float[Array, "peak"], Float[Array, "peak 2"], Float[Array, "peak"]]:
    """Mean strength of each peak along its best straight motion, and that motion.

    Parameters
    ----------
    past
        Strength in the frames before.
    peak, strength
        Row and column of the peaks of this frame, and their strengths.
    velocity
        East and north speeds to be tried. [m/s]
    cell_m
        Side of a cell. [m]

    Returns
    -------
    Mean over this and the earlier frames, the velocity [m/s], and the same mean at a standstill. Off the grid
    an earlier frame counts as half of the peak: it says nothing.
    """
    out, best = np.empty(len(peak)), np.zeros((len(peak), 2))
    still = np.empty(len(peak))
    layers, ages_s = np.ascontiguousarray(past.layers, np.float32), np.asarray(past.ages_s, float)
    over_rows(
        _support, len(peak), layers, ages_s, peak, strength, velocity, cell_m, out, best, still
    )  # fmt: skip
    return out, best, still


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _support(start, stop, layers, ages, peak, strength, velocity, cell, out, best, still):
    frames, rows, columns = layers.shape
    back = np.empty((len(velocity), frames, 2), np.int64)  # cells from a peak to where it was
    for v in range(len(velocity)):
        for f in range(frames):
            back[v, f, 0] = int(np.floor(velocity[v, 1] * ages[f] / cell + 0.5))
            back[v, f, 1] = int(np.floor(0.5 - velocity[v, 0] * ages[f] / cell))
    for p in range(start, stop):
        now, i, j = strength[p], peak[p, 0], peak[p, 1]
        standing = now
        for f in range(frames):
            standing += min(layers[f, i, j], now)
        still[p] = standing / (frames + 1)
        most = -1.0
        for v in range(len(velocity)):
            total = now
            for f in range(frames):
                r, c = i + back[v, f, 0], j + back[v, f, 1]
                if 0 <= r < rows and 0 <= c < columns:
                    total += min(layers[f, r, c], now)
                else:
                    total += 0.5 * now
                if total + (frames - 1 - f) * now < _ROUNDING * most:  # whatever the other frames show
                    break
            if total > most:
                most = total
                best[p, 0], best[p, 1] = velocity[v, 0], velocity[v, 1]
        out[p] = most / (frames + 1)


def log_likelihood_ratio(channel: str, features: Float[Array, "peak feature"]) -> Float[Array, "peak"]:
    """Log-likelihood ratio of vehicle against clutter for peaks of these `FEATURES`. [nat]"""
    return np.minimum(read_calibration("mosaic").models[channel].log_odds(features), MAX_RATIO)


def ratio_of_detections(channel: str, ratio: Float[Array, "peak"]) -> Float[Array, "peak"]:
    """Log-likelihood ratio among peaks beyond `MIN_RATIO`, of which little clutter is left. [nat]

    Bayes's rule needs p(features, detected | vehicle) over the density of the clutter that is detected, which
    the tracker measures. So the logarithm of the ratio of the two detection probabilities is subtracted.
    """
    return ratio - read_calibration("mosaic").constants["detection_ratio"][channel]
