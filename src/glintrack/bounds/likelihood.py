"""The ideal observer: likelihood ratio between a frame with a vehicle and the same one without.

Place, background and vehicle are known; only noise is not. The log-likelihood ratio T of independent elements
has under both hypotheses the cumulants of one function, K(s) = ln E₀[e^{sT}] = Σ ln ∫ p₁ˢ p₀¹⁻ˢ: under the
vehicle it is K(s + 1). Tails follow by the saddle point, down to false alarms so rare that no draws reach.

References
----------
Lugannani and Rice, Adv. Appl. Prob. 12, 475 (1980); Kay, Fundamentals of Statistical Signal Processing II
(1998), §3; Barrett and Myers, Foundations of Image Science (2004), §13.2 (ideal observer, its moments).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import log_ndtr, ndtr

from glintrack.core.arrays import Array

Cumulants = Callable[[float], float]
_STEP = 1e-3  # of numerical derivatives of K: its curvature is at least 1e-9 of itself there
_CERTAIN = math.log(1e-6)  # a miss less probable than this is none
_LARGEST = 1e4
_BISECTIONS = 60


class Elements(NamedTuple):
    """Means of what some elements collect without and with a vehicle, and what noise they have.

    Parameters
    ----------
    without, present
        Expected electrons without the vehicle and with it. [e]
    dark_e
        RMS of the noise in the dark: dark current, read, quantizer. [e]
    full_well_e
        Electrons at which an element stops counting: all above is one outcome. [e]
    """

    without: Float[Array, "element"]
    present: Float[Array, "element"]
    dark_e: float
    full_well_e: float


def element_cumulants(elements: Elements) -> tuple[Cumulants, float]:
    """K(s) of elements with shot and dark noise, full ones censored; and the s up to which it is finite.

    Shot noise is taken as normal with the variance of its mean: of 50 electrons and more.
    """
    m0, m1 = (np.asarray(m, float) for m in elements[:2])
    v0, v1 = np.maximum(m0, 0) + elements.dark_e**2, np.maximum(m1, 0) + elements.dark_e**2
    full = elements.full_well_e
    full0, full1 = log_ndtr((m0 - full) / np.sqrt(v0)), log_ndtr((m1 - full) / np.sqrt(v1))
    grows = v1 > v0
    limit = float((v1[grows] / (v1[grows] - v0[grows])).min()) if grows.any() else _LARGEST

    def cumulants(s: float) -> float:
        mixed = s * v0 + (1 - s) * v1
        if mixed.min(initial=1.0) <= 0:
            return math.inf
        inside = -0.5 * s * (1 - s) * (m1 - m0) ** 2 / mixed
        inside += 0.5 * (s * np.log(v0) + (1 - s) * np.log(v1) - np.log(mixed))
        centre, width = (s * m1 * v0 + (1 - s) * m0 * v1) / mixed, np.sqrt(v0 * v1 / mixed)
        inside += log_ndtr((full - centre) / width)
        return float(np.logaddexp(inside, s * full1 + (1 - s) * full0).sum())

    return cumulants, min(limit, _LARGEST)


def detectability(cumulants: Cumulants) -> float:
    """d′ of the ideal observer: the root of E₁[T] − E₀[T], which for equal normal noise is √(ΣΔ²/σ²). [1]"""
    return math.sqrt(max(_inner_slope(cumulants, 1.0, -_STEP) - _inner_slope(cumulants, 0.0, _STEP), 0.0))


def detection_probability(cumulants: Cumulants, false_alarm: float, limit: float = _LARGEST) -> float:
    """P(T > t | vehicle) at the threshold where P(T > t | none) is the false-alarm probability. [1]

    Parameters
    ----------
    cumulants, limit
        From `element_cumulants`, or any K(s) and the s up to which it is finite.
    false_alarm
        Of one hypothesis, greater than 0 and less than a half.

    Raises
    ------
    ValueError
        If the false-alarm probability is out of its range.
    """
    if not 0 < false_alarm < 0.5:
        raise ValueError(f"`false_alarm` must be greater than 0 and less than 0.5, got {false_alarm:g}")
    half = cumulants(0.5)
    if 2 * half - math.log(false_alarm) < _CERTAIN:  # Chernoff's bound on a miss
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
    here, threshold = cumulants(s), _slope(cumulants, s)
    curvature = (cumulants(s + _STEP) - 2 * here + cumulants(s - _STEP)) / _STEP**2
    saddle = s - origin
    w = math.copysign(math.sqrt(max(2 * (saddle * threshold - here), 1e-300)), saddle)
    u = saddle * math.sqrt(max(curvature, 1e-300))
    density = math.exp(-(w**2) / 2) / math.sqrt(2 * math.pi)
    return float(np.clip(ndtr(-w) + density * (1 / u - 1 / w), 0.0, 1.0))


def _inner_slope(cumulants: Cumulants, s: float, step: float) -> float:
    """K′ from one side: past 0 and 1 K may end at once, where one of the means is dark."""
    return (4 * cumulants(s + step) - 3 * cumulants(s) - cumulants(s + 2 * step)) / (2 * step)


def _slope(cumulants: Cumulants, s: float) -> float:
    return (cumulants(s + _STEP) - cumulants(s - _STEP)) / (2 * _STEP)
