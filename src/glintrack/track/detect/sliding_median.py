"""Median and spread of each pixel in a window of past frames, and the change against them.

Background is the median of the window, with the frame itself in it: from three frames on, what moves is in
none of it. The variance of a residual is a + b |∇B|² + c S²: noise, registration error times gradient (a and
b are fitted to each frame), and what this pixel has been seen to do before (S, the median deviation of the
window).
"""

from itertools import pairwise

import numba as nb
import numpy as np
from jaxtyping import Float
from scipy import ndimage

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.track.detect.registration import some_of

BINS = 24  # of gradient, in which a frame's noise is fitted
QUANTILE, OF_GAUSSIAN = 0.75, 1.1503  # of |residual|, and what it is of a unit Gaussian
LOWPASS_M = 25.0  # illumination that changes more slowly than this is no vehicle
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


def standardized(
    image: Float[Array, "y x"],
    background: Float[Array, "y x"],
    spread: Float[Array, "y x"],
    slope2: Float[Array, "y x"],
    gsd_m: float,
    floor: float,
) -> Float[Array, "y x"]:
    """Change of a frame in its standard deviations; NaN where there is no data. [1]

    Parameters
    ----------
    image
        Registered and of the background's gain. [unit of the image]
    background, spread, slope2
        From `median_and_spread` and `gradient2`.
    gsd_m
        Side of a pixel. [m]
    floor
        Least standard deviation, such as that of rounding. [unit of the image]
    """
    rest = image - background
    few, few_slopes = some_of(rest), some_of(slope2)
    known = np.isfinite(few)
    few, few_slopes = few[known], few_slopes[known]
    limit = 3 * float(1.4826 * np.median(np.abs(few))) + floor if len(few) else 1.0
    size = max(3, round(LOWPASS_M / gsd_m))
    clipped, inside = np.empty(rest.shape, np.float32), np.empty(rest.shape, np.float32)
    over_rows(_within, len(rest), rest, np.float32(limit), clipped, inside)
    slow = ndimage.uniform_filter(clipped, size) / np.maximum(ndimage.uniform_filter(inside, size), 0.05)
    a, b = _noise(few - some_of(slow)[known], few_slopes)
    out = np.empty(rest.shape, np.float32)
    least = np.float32(max(a, floor**2))
    over_rows(_divided, len(rest), rest, slow, slope2, spread, least, np.float32(b), out)
    return out


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
def _within(start, stop, rest, limit, clipped, inside):
    """Residuals within a limit, 0 for others and unknown ones, and which they are."""
    nothing, one = np.float32(0.0), np.float32(1.0)
    for y in range(start, stop):
        for x in range(rest.shape[1]):
            here = abs(rest[y, x]) <= limit
            clipped[y, x] = rest[y, x] if here else nothing
            inside[y, x] = one if here else nothing


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _divided(start, stop, rest, slow, slope2, spread, least, per_slope2, out):
    """Residuals over what is slow, in their standard deviations."""
    share = np.float32(SPREAD_SHARE * 1.4826**2)
    for y in range(start, stop):
        for x in range(rest.shape[1]):
            variance = least + per_slope2 * slope2[y, x] + share * spread[y, x] * spread[y, x]
            out[y, x] = (rest[y, x] - slow[y, x]) / np.sqrt(variance)


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
            # two ordered runs of distances, from the middle outwards: the median is met on the way
            low, high = (n - 1) // 2, n // 2
            if low == high:
                low -= 1
                d, seen = np.float32(0.0), 1
                high += 1
            else:
                d, seen = np.float32(0.0), 0
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
