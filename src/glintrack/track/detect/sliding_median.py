"""Median and spread of each pixel in a window of past frames, and the change against them.

The background is the median of the window, with the frame itself in it: from three frames on it contains no
moving vehicle. The variance of a residual is a + b |∇B|² + c S²: noise, registration error times gradient (a
and b are fitted to each frame), and the past deviation of this pixel (S, the median deviation of the window).
"""

from itertools import pairwise

import numba as nb
import numpy as np
from jaxtyping import Float
from scipy import ndimage

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.track.detect.registration import subsample

BINS = 24  # of gradient, in which a frame's noise is fitted
QUANTILE, OF_GAUSSIAN = 0.75, 1.1503  # of |residual|, and its value for a unit Gaussian
LOWPASS_M = 25.0  # a change of illumination over this distance is no vehicle
SPREAD_SHARE = 0.5


def median_and_spread(
    stack: Float[Array, "frame y x"], least: int = 1
) -> tuple[Float[Array, "y x"], Float[Array, "y x"]]:
    """Median of each pixel and the median distance from it; NaN where fewer than ``least`` frames know it."""
    median = np.empty(stack.shape[1:], np.float32)
    spread = np.empty(stack.shape[1:], np.float32)
    over_rows(_median_and_spread, len(median), stack, least, median, spread)
    return median, spread


def gradient2(background: Float[Array, "y x"]) -> Float[Array, "y x"]:
    """Mean squared gradient about each pixel; 0 where unknown. [unit² pixel⁻²]"""
    known = np.isfinite(background)
    level = np.median(background[known]) if known.any() else 0.0
    filled = np.where(known, background, level).astype(np.float32)
    gy, gx = np.gradient(filled)
    return ndimage.uniform_filter(gy * gy + gx * gx, 3)


def standardize_change(
    image: Float[Array, "y x"],
    background: Float[Array, "y x"],
    spread: Float[Array, "y x"],
    slope2: Float[Array, "y x"],
    gsd_m: float,
    floor: float,
) -> Float[Array, "y x"]:
    """Normalize the change of a frame by its standard deviation; NaN without data. [1]

    Parameters
    ----------
    image
        Frame, registered and with the background's gain. [unit of the image]
    background, spread, slope2
        From `median_and_spread` and `gradient2`.
    gsd_m
        Side of a pixel. [m]
    floor
        Minimum standard deviation, such as that of rounding. [unit of the image]
    """
    rest = image - background
    few, few_slopes = subsample(rest), subsample(slope2)
    known = np.isfinite(few)
    few, few_slopes = few[known], few_slopes[known]
    limit = 3 * float(1.4826 * np.median(np.abs(few))) + floor if len(few) else 1.0
    size = max(3, round(LOWPASS_M / gsd_m))
    inside = np.abs(rest) <= np.float32(limit)
    clipped, share = np.where(inside, rest, np.float32(0)), inside.astype(np.float32)
    slow = ndimage.uniform_filter(clipped, size) / np.maximum(ndimage.uniform_filter(share, size), 0.05)
    a, b = _noise(few - subsample(slow)[known], few_slopes)
    variance = np.float32(max(a, floor**2)) + np.float32(b) * slope2
    variance += np.float32(SPREAD_SHARE * 1.4826**2) * spread * spread
    return ((rest - slow) / np.sqrt(variance)).astype(np.float32)


def _noise(rest: Array, slope2: Array) -> tuple[float, float]:
    """Variance on flat ground, and per squared gradient: a line through robust variances of bins."""
    if len(rest) < 10 * BINS:
        return float(np.var(rest)) if len(rest) else 1.0, 0.0
    order = np.argsort(slope2, kind="stable")
    size, slope2 = np.abs(rest[order]), slope2[order]
    edges = np.linspace(0, len(rest), BINS + 1).astype(int)
    bins = [slice(first, last) for first, last in pairwise(edges)]
    x = np.array([slope2[one].mean() for one in bins])
    y = np.array([(np.quantile(size[one], QUANTILE) / OF_GAUSSIAN) ** 2 for one in bins])
    if not y.max() > 0:  # frames without noise
        return 0.0, 0.0
    weight = 1 / np.maximum(y, 1e-12 * max(y.max(), 1e-30))
    design = np.stack([np.ones_like(x), x], axis=1) * weight[:, None]
    a, b = np.linalg.lstsq(design, y * weight, rcond=None)[0]
    return (float(max(a, 0.25 * y.min())), float(b)) if b > 0 else (float(np.median(y)), 0.0)


@nb.njit(cache=True, nogil=True)
def _median_and_spread(start, stop, stack, least, median, spread):
    frames, _, width = stack.shape
    values = np.empty(frames, np.float32)
    for y in range(start, stop):
        for x in range(width):
            n = 0
            for k in range(frames):
                v = stack[k, y, x]
                if v == v:
                    j = n
                    while j > 0 and values[j - 1] > v:
                        values[j] = values[j - 1]
                        j -= 1
                    values[j] = v
                    n += 1
            if n < least:
                median[y, x] = np.nan
                spread[y, x] = np.nan
                continue
            m = values[n // 2] if n % 2 else np.float32(0.5) * (values[n // 2 - 1] + values[n // 2])
            median[y, x] = m
            # merge two ordered runs of distances, from the middle outwards, up to their median
            low, high, d, seen = (n - 1) // 2, n // 2, np.float32(0.0), 0
            if low == high:
                low, high, seen = low - 1, high + 1, 1
            while seen < (n + 1) // 2:
                left = m - values[low] if low >= 0 else np.float32(np.inf)
                right = values[high] - m if high < n else np.float32(np.inf)
                if left <= right:
                    d = left
                    low -= 1
                else:
                    d = right
                    high += 1
                seen += 1
            spread[y, x] = d
