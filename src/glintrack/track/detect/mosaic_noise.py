"""Compiled loops over residuals: their usual size, how much of each is learnt, what shift explains them.

A coarse ground-locked map per kind of element holds a scale: the quantile of e²/σ² that residuals e have
there, with σ² the sensor's own noise. Edges, parallax and glints raise it, and what raised it once is
forgotten.
"""

import numba as nb
import numpy as np


@nb.njit(cache=True, nogil=True)
def _cell_of(x, y, ratio):
    """Row and column of the coarse cell about a place in fine cells."""
    return int(np.floor((y + 0.5) * ratio)), int(np.floor((x + 0.5) * ratio))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def residuals(start, stop, fitted, readings, noise, scale, places, ratio, parts, var, z2):
    """Expected variance of each residual of one kind, and its square over that.

    Parameters
    ----------
    start, stop
        Rows of elements.
    fitted : (row, column, 5)
        From `mosaic_kernels.predict`.
    readings, noise : (row, column)
        Readings, and variance of the sensor's noise.
    scale : (coarse row, coarse column)
    places
        Columns and rows of the elements in fine cells.
    ratio
        Coarse cells in a fine one.
    parts : (3,)
        What of the scale, of the fit's spread, and of the spread over the sum of weights counts.
    var, z2 : (row, column)
        Written; NaN where nothing is predicted or read.
    """
    height, width = scale.shape
    x, y = places
    for i in range(start, stop):
        for j in range(readings.shape[1]):
            expected = fitted[i, j, 0]
            if not (expected == expected and readings[i, j] == readings[i, j]):
                var[i, j] = z2[i, j] = np.nan
                continue
            n = noise[i, j]
            fx, fy = (x[i, j] + 0.5) * ratio - 0.5, (y[i, j] + 0.5) * ratio - 0.5
            c, r = int(np.floor(fx)), int(np.floor(fy))
            ax, ay = fx - c, fy - r
            left, right = min(max(c, 0), width - 1), min(max(c + 1, 0), width - 1)
            top, bottom = min(max(r, 0), height - 1), min(max(r + 1, 0), height - 1)
            s = (1 - ay) * ((1 - ax) * scale[top, left] + ax * scale[top, right]) + ay * (
                (1 - ax) * scale[bottom, left] + ax * scale[bottom, right]
            )
            spread = max(fitted[i, j, 3], n)
            v = max(parts[0] * s * n + parts[1] * spread, n) + parts[2] * spread / fitted[i, j, 4]
            e = readings[i, j] - expected
            var[i, j], z2[i, j] = v, e * e / v


@nb.njit(cache=True, nogil=True)
def follow_scale(fitted, readings, noise, weight, scale, x, y, ratio, up, down, least):
    """Raise the scale by a factor where a residual exceeds it, lower it elsewhere, but not what is masked."""
    height, width = scale.shape
    for i in range(readings.shape[0]):
        for j in range(readings.shape[1]):
            e = readings[i, j] - fitted[i, j, 0]
            if not e == e or weight[i, j] <= 0.0:
                continue
            r, c = _cell_of(x[i, j], y[i, j], ratio)
            if not (0 <= r < height and 0 <= c < width):
                continue
            if e * e > scale[r, c] * noise[i, j]:
                scale[r, c] *= up
            else:
                scale[r, c] = max(scale[r, c] * down, least)


@nb.njit(cache=True, nogil=True)
def flag(z2, x, y, ratio, limit, out):
    """Mark coarse cells in which some residual exceeds a limit."""
    height, width = out.shape
    for i in range(z2.shape[0]):
        for j in range(z2.shape[1]):
            if z2[i, j] > limit:
                r, c = _cell_of(x[i, j], y[i, j], ratio)
                if 0 <= r < height and 0 <= c < width:
                    out[r, c] = True


@nb.njit(cache=True, nogil=True, error_model="numpy")
def update_weight(z2, x, y, ratio, differed_s, masked, soft, heal_s, healing, out):
    """How much of each reading is learnt.

    All of what was predicted, less of what differs, nothing of what is masked; and most of what has differed
    in every frame for longer than ``heal_s``, or a hole where a vehicle stood would stay for ever.
    """
    height, width = differed_s.shape
    for i in range(z2.shape[0]):
        for j in range(z2.shape[1]):
            r, c = _cell_of(x[i, j], y[i, j], ratio)
            out[i, j] = 1.0
            if not (0 <= r < height and 0 <= c < width):
                continue
            if masked[r, c]:
                out[i, j] = 0.0
            elif z2[i, j] == z2[i, j]:
                w = 1.0 / (1.0 + z2[i, j] / soft)
                out[i, j] = max(w * w, healing if differed_s[r, c] > heal_s else 0.0)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def shift_terms(fitted, readings, var, guess, soft, out):
    """Normal equations of the shift of all places that best explains the residuals, robustly weighted.

    ``out`` gains Σw gx², Σw gx gy, Σw gy², Σw gx e, Σw gy e, with slopes g of the fit and e the residual.
    """
    for i in range(readings.shape[0]):
        for j in range(readings.shape[1]):
            v = var[i, j]
            if not v == v:
                continue
            gx, gy = fitted[i, j, 1], fitted[i, j, 2]
            e = readings[i, j] - fitted[i, j, 0]
            left = e - guess[0] * gx - guess[1] * gy
            w = 1.0 / (1.0 + left * left / (v * soft))
            w = w * w / v
            out[0] += w * gx * gx
            out[1] += w * gx * gy
            out[2] += w * gy * gy
            out[3] += w * gx * e
            out[4] += w * gy * e
