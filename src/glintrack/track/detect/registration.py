"""Small shifts of a frame against the background, from errors of the reported pose.

One weighted Gauss-Newton step of Lucas and Kanade (IJCAI 1981) over the whole frame, its residuals clipped
so that vehicles do not pull. What remains after many frames is drift, and belongs to the background: the slow
mean of the shift is left in the image, which anchors the background to the reported ground coordinates.
"""

import math

import numba as nb
import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array

WORTH_PX = 0.02  # a smaller shift changes less than the noise does


def shift_between(
    image: Float[Array, "y x"], mean: Float[Array, "y x"], clip: float, most_px: float
) -> tuple[float, float]:
    """Displacement (rows, columns) of the image's content against the background; 0 without texture.

    Parameters
    ----------
    image, mean
        Frame and background, NaN where there is no data. [unit of the image]
    clip
        Differences count at most this much. [unit of the image]
    most_px
        A longer displacement is not believed and cut to this. [pixel]
    """
    rr, rc, cc, r, c = _normal_equations(image, mean, np.float32(clip))
    determinant = rr * cc - rc * rc
    if not determinant > 1e-6 * rr * cc:
        return 0.0, 0.0
    rows, columns = -(r * cc - c * rc) / determinant, -(c * rr - r * rc) / determinant
    scale = min(1.0, most_px / max(math.hypot(rows, columns), 1e-12))
    return rows * scale, columns * scale


def shift_image(image: Float[Array, "y x"], rows: float, columns: float) -> Float[Array, "y x"]:
    """Image whose pixel (y, x) is what was at (y + rows, x + columns), bilinear over pixels with data."""
    if math.hypot(rows, columns) < WORTH_PX:
        return image
    return _shift(image, np.float32(rows), np.float32(columns))


@nb.njit(cache=True)
def _normal_equations(image, mean, clip):
    """Of a step down and a step right: three sums of squared slopes, and two of slopes by differences."""
    total, row = np.zeros(5), np.empty(5, np.float32)
    for y in range(1, image.shape[0] - 1, 2):  # every other row knows enough
        _add_row(image[y, 1:-1], mean[y - 1, 1:-1], mean[y], mean[y + 1, 1:-1], clip, row)
        for k in range(5):
            total[k] += row[k]
    return total


# sums of a row's few hundred terms may be taken in any order, on vectors; the divisor is positive
@nb.njit(cache=True, fastmath={"reassoc", "nsz"}, error_model="numpy", forceinline=True)
def _add_row(image, above, here, below, clip, out):
    half, nothing, endless = np.float32(0.5), np.float32(0.0), np.float32(np.inf)
    rr = rc = cc = r = c = nothing
    left, mine, right = here[:-2], here[1:-1], here[2:]
    for x in range(len(image)):
        difference = image[x] - mine[x]
        gy, gx = half * (below[x] - above[x]), half * (right[x] - left[x])
        known = abs(difference + gy + gx) < endless
        # an outlier tells nothing of the shift: its weight falls as its size grows
        size = abs(difference)
        weight = clip / (size if size > clip else clip)
        weight = weight * weight if known else nothing
        difference = difference if known else nothing
        gy, gx = gy if known else nothing, gx if known else nothing
        rr += weight * gy * gy
        rc += weight * gy * gx
        cc += weight * gx * gx
        r += weight * gy * difference
        c += weight * gx * difference
    out[0], out[1], out[2], out[3], out[4] = rr, rc, cc, r, c


@nb.njit(cache=True)
def _shift(image, rows, columns):
    height, width = image.shape
    out = np.empty_like(image)
    y_step, x_step = int(np.floor(rows)), int(np.floor(columns))
    fy, fx = np.float32(rows - y_step), np.float32(columns - x_step)
    one = np.float32(1.0)
    for y in range(height):
        y0 = min(max(y + y_step, 0), height - 1)
        y1 = min(max(y + y_step + 1, 0), height - 1)
        for x in range(width):
            x0 = min(max(x + x_step, 0), width - 1)
            x1 = min(max(x + x_step + 1, 0), width - 1)
            a, b, c, d = image[y0, x0], image[y0, x1], image[y1, x0], image[y1, x1]
            wa, wb, wc, wd = (one - fy) * (one - fx), (one - fy) * fx, fy * (one - fx), fy * fx
            value = wa * a + wb * b + wc * c + wd * d
            if not np.isfinite(value):
                value = total = np.float32(0.0)
                if np.isfinite(a):
                    value, total = value + wa * a, total + wa
                if np.isfinite(b):
                    value, total = value + wb * b, total + wb
                if np.isfinite(c):
                    value, total = value + wc * c, total + wc
                if np.isfinite(d):
                    value, total = value + wd * d, total + wd
                # what lies mostly on missing pixels is missing
                value = value / total if total >= np.float32(0.5) else np.float32(np.nan)
            out[y, x] = value
    return out
