"""Register a frame to a background to a fraction of a pixel, as a whole and tile by tile, in gain and offset.

Rectification leaves errors of a fraction of a pixel that differ over the frame: of pose, of terrain, of a
mosaic of cameras. The shift of the whole frame is estimated from coarse to fine. Then each tile takes one
weighted Gauss-Newton step of Lucas and Kanade (IJCAI 1981). Its normal equations are summed with its
neighbours', and a prior limits its deviation. Large differences have small weights, so that vehicles have
little influence.
"""

import math

import numba as nb
import numpy as np
from jaxtyping import Float
from scipy import ndimage

from glintrack.core.arrays import Array
from glintrack.core.interpolation import keys_weights
from glintrack.core.parallel import over_rows

SAMPLES = 60_000  # pixels: enough for a quantile, few enough to sort
TILE_M = 32.0
PRIOR_PX = 0.3  # standard deviation of a tile's shift about the frame's
LEVELS = (8, 4, 2, 1)  # a pixel of the coarsest is so many of the frame
STEPS = 2  # at each level: one step ends short of a shift near a pixel
MIN_PIXELS = 32  # along a side of a level
MAX_STEP_PX = 1.5


def estimate_shifts(
    image: Float[Array, "y x"], background: Float[Array, "y x"], gsd_m: float
) -> Float[Array, "row column 2"]:
    """Estimate the displacement of tiles of a frame against the background, in rows and columns. [pixel]

    Parameters
    ----------
    image, background
        Of one gain; NaN where there is no data. [unit of the image]
    gsd_m
        Side of a pixel. [m]
    """
    whole = np.zeros((1, 1, 2))
    for level in LEVELS:
        if min(image.shape) < level * MIN_PIXELS:
            continue
        here, there = _downsample(image, level), _downsample(background, level)
        for _ in range(STEPS):
            placed = shift_image(here, whole / level)
            whole = whole + level * _step(placed, there, 2 * _scale_of(placed - there))
    tile = max(8.0, TILE_M / gsd_m)
    shape = tuple(max(1, round(n / tile)) for n in image.shape)
    placed = shift_image(image, whole)
    noise = max(_scale_of(placed - background), 1e-12)
    sums = _normal_equations(placed, background, 2 * noise, shape)
    for axis in (0, 1):
        sums = 3 * ndimage.uniform_filter1d(sums, 3, axis, mode="nearest")
    step, _ = _solve(sums, (noise / PRIOR_PX) ** 2)
    return (whole + np.clip(step, -1, 1)).astype(np.float32)


def _step(image: Array, background: Array, clip: float) -> Float[Array, "2"]:
    """Estimate the displacement of an image by one step, at most `MAX_STEP_PX`. [pixel]"""
    sums = _normal_equations(image, background, clip, (1, 1))[0, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        step, determinant = _solve(sums, 0.0)
    if not determinant > 1e-6 * sums[0] * sums[2]:
        return np.zeros(2)
    return step * min(1.0, MAX_STEP_PX / max(math.hypot(*step), 1e-12))


def _solve(sums: Float[Array, "*n 5"], ridge: float) -> tuple[Float[Array, "*n 2"], Float[Array, "*n"]]:
    """Solve the normal equations; with their determinant."""
    rr, rc, cc, r, c = (sums[..., k] for k in range(5))
    rr, cc = rr + ridge, cc + ridge
    determinant = rr * cc - rc * rc
    step = np.stack([-(r * cc - c * rc), -(c * rr - r * rc)], axis=-1) / determinant[..., None]
    return step, determinant


def _normal_equations(
    image: Array, background: Array, clip: float, shape: tuple[int, ...]
) -> Float[Array, "row column 5"]:
    """Compute the normal equations of a shift in each tile: sums of products of slopes and differences."""
    sums = np.zeros((*shape, 5))
    over_rows(_tile_sums, shape[0], image, background, np.float32(clip), sums)
    return sums


def shift_image(image: Float[Array, "y x"], shift: Float[Array, "row column 2"]) -> Float[Array, "y x"]:
    """Sample an image at every pixel plus its tile's shift: cubic, with shifts linear between tiles.

    Next to missing data the nearest pixel is taken.
    """
    out = np.empty(image.shape, np.float32)
    image = np.ascontiguousarray(image, np.float32)
    over_rows(_shift_rows, len(out), image, np.ascontiguousarray(shift, np.float32), out)
    return out


def subsample(image: Float[Array, "y x"], most: int = SAMPLES) -> Float[Array, "pixel"]:
    """Take at most so many pixels, evenly over the image but not along its columns."""
    step = -(-image.size // most)
    while step > 1 and (image.shape[1] % step == 0 or image.shape[1] % step == step - 1):
        step += 1
    return image.reshape(-1)[::step]


def gain_between(image: Float[Array, "y x"], background: Float[Array, "y x"]) -> tuple[float, float]:
    """Fit gain and offset of a background against a frame: a line, fitted again to the pixels near it."""
    x, y = (subsample(one).astype(float) for one in (image, background))
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    if len(x) < 16 or np.ptp(x) == 0:
        return 1.0, 0.0
    gain = float(
        np.subtract(*np.quantile(y, [0.9, 0.1])) / max(np.subtract(*np.quantile(x, [0.9, 0.1])), 1e-12)
    )
    gain = gain if gain > 0 else 1.0
    offset = float(np.median(y) - gain * np.median(x))
    for _ in range(3):
        rest = np.abs(y - gain * x - offset)
        near = rest <= 3 * np.median(rest) + 1e-12
        mx, my = x[near].mean(), y[near].mean()
        spread = ((x[near] - mx) ** 2).sum()
        if spread <= 0:
            break
        gain = float(((x[near] - mx) * (y[near] - my)).sum() / spread)
        offset = float(my - gain * mx)
    return (gain, offset) if gain > 0 else (1.0, 0.0)


def _scale_of(difference: Array) -> float:
    """Estimate the standard deviation by the median, from a sample of the known pixels."""
    known = subsample(difference)
    known = known[np.isfinite(known)]
    return float(1.4826 * np.median(np.abs(known))) + 1e-12 if len(known) else 1.0


def _downsample(image: Array, factor: int) -> Array:
    if factor == 1:
        return np.ascontiguousarray(image, np.float32)
    rows, columns = (n // factor for n in image.shape)
    cut = image[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor)
    return np.ascontiguousarray(cut.mean(axis=(1, 3)), np.float32)


@nb.njit(cache=True, nogil=True)
def _tile_sums(start, stop, image, background, clip, sums):
    """Rows of `_normal_equations`; a difference beyond the clip loses weight."""
    height, width = image.shape
    half = np.float32(0.5)
    for i in range(start, stop):
        y0 = max(1, int(i * height / sums.shape[0]))
        y1 = min(height - 1, int((i + 1) * height / sums.shape[0]))
        for j in range(sums.shape[1]):
            x0 = max(1, int(j * width / sums.shape[1]))
            x1 = min(width - 1, int((j + 1) * width / sums.shape[1]))
            rr = rc = cc = r = c = 0.0
            for y in range(y0, y1):
                for x in range(x0, x1):
                    d = image[y, x] - background[y, x]
                    gy = half * (background[y + 1, x] - background[y - 1, x])
                    gx = half * (background[y, x + 1] - background[y, x - 1])
                    s = d + gy + gx
                    if not (s == s):
                        continue
                    w = clip / max(abs(d), clip)
                    w *= w
                    rr += w * gy * gy
                    rc += w * gy * gx
                    cc += w * gx * gx
                    r += w * gy * d
                    c += w * gx * d
            sums[i, j, 0], sums[i, j, 1], sums[i, j, 2], sums[i, j, 3], sums[i, j, 4] = rr, rc, cc, r, c


@nb.njit(cache=True, nogil=True)
def _shift_rows(start, stop, image, shift, out):
    """Rows of `shift_image`."""
    height, width = image.shape
    rows, columns = shift.shape[0], shift.shape[1]
    along = np.empty((columns, 2))
    for y in range(start, stop):
        v = min(max((y + 0.5) * rows / height - 0.5, 0.0), rows - 1.0)
        i0 = min(int(v), max(rows - 2, 0))
        i1, a = min(i0 + 1, rows - 1), v - i0
        for j in range(columns):
            for k in range(2):
                along[j, k] = (1 - a) * shift[i0, j, k] + a * shift[i1, j, k]
        for x in range(width):
            u = min(max((x + 0.5) * columns / width - 0.5, 0.0), columns - 1.0)
            j0 = min(int(u), max(columns - 2, 0))
            j1, b = min(j0 + 1, columns - 1), u - j0
            p = y + (1 - b) * along[j0, 0] + b * along[j1, 0]
            q = x + (1 - b) * along[j0, 1] + b * along[j1, 1]
            p0, q0 = int(np.floor(p)), int(np.floor(q))
            if p0 < -1 or q0 < -1 or p0 >= height or q0 >= width:
                out[y, x] = np.nan
                continue
            wy, wx = keys_weights(np.float32(p - p0)), keys_weights(np.float32(q - q0))
            total = np.float32(0.0)
            if 1 <= q0 < width - 2:
                for k in range(4):
                    row = image[min(max(p0 + k - 1, 0), height - 1)]
                    total += wy[k] * (
                        wx[0] * row[q0 - 1] + wx[1] * row[q0] + wx[2] * row[q0 + 1] + wx[3] * row[q0 + 2]
                    )
            else:
                for k in range(4):
                    row = image[min(max(p0 + k - 1, 0), height - 1)]
                    for m in range(4):
                        total += wy[k] * wx[m] * row[min(max(q0 + m - 1, 0), width - 1)]
            if not (total == total):  # next to missing data
                total = image[
                    min(max(int(np.rint(p)), 0), height - 1), min(max(int(np.rint(q)), 0), width - 1)
                ]
            out[y, x] = total
