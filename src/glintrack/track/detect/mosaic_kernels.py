"""Compiled loops of the ground map: predict readings, update the map, follow the scale of residuals.

Every kind of element (place in the superpixel) has its own map. A cell holds the sums of a weighted
straight-line fit of past readings v at offsets (x, y) from the cell's centre, relative to a reference value
r: ``[Σw, Σwx, Σwy, Σwxx, Σwxy, Σwyy, Σwv, Σwxv, Σwyv, Σwvv, r]``. The weight of a reading falls with its
distance as a biweight, ``(1 − d²/R²)²``, and with its age as exp(−age/τ). Weights of new readings grow with
time, so that old sums need no update.

A coarse map per kind of element holds the scale of residuals e: a quantile of e²/σ², where σ² is the variance
of the sensor's noise. Edges, parallax and glints raise it.
"""

import math

import numba as nb
import numpy as np

TERMS = 11


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _fit(cell, ridge):
    """Straight-line fit of a cell: value, slopes along columns and rows, mean squared residual."""
    w = float(cell[0])
    per = 1.0 / w
    x, y, v = per * cell[1], per * cell[2], per * cell[6]  # means
    a11 = cell[3] + ridge * w - cell[1] * x
    a22 = cell[5] + ridge * w - cell[2] * y
    a12 = cell[4] - cell[1] * y
    b1 = cell[7] - cell[1] * v
    b2 = cell[8] - cell[2] * v
    det = a11 * a22 - a12 * a12
    if det <= 1e-12 * w * w:
        sx = sy = 0.0
    else:
        over = 1.0 / det
        sx = over * (a22 * b1 - a12 * b2)
        sy = over * (a11 * b2 - a12 * b1)
    spread = per * (cell[9] - cell[6] * v - sx * b1 - sy * b2)
    return v - sx * x - sy * y, sx, sy, max(spread, 0.0)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def predict_readings(start, stop, map_, x_of, y_of, least, ridge, out):
    """Predict the reading of each element of a kind, with slopes and spread, from the cell under it.

    Parameters
    ----------
    start, stop
        Rows of elements.
    map_ : (row, column, TERMS)
    x_of, y_of : (row, column)
        Ground points of the kind's elements: columns and rows of the map.
    least
        Minimum sum of weights of a cell that predicts.
    ridge
        Regularization of the slopes. [cell²]
    out : (row, column, 5)
        Predicted reading, slopes along columns and rows, mean squared residual, sum of weights; NaN for none.
    """
    height, width, columns = map_.shape[0], map_.shape[1], out.shape[1]
    row, column = np.empty(columns, np.int64), np.empty(columns, np.int64)
    weight = np.empty(columns, np.float32)
    for i in range(start, stop):
        for j in range(columns):  # read memory for many elements at a time
            x, y = x_of[i, j], y_of[i, j]
            weight[j] = 0.0
            if -0.5 < x < width - 0.5 and -0.5 < y < height - 0.5:
                row[j], column[j] = int(y + 0.5), int(x + 0.5)
                weight[j] = map_[row[j], column[j], 0]
        for j in range(columns):
            out[i, j, 0] = np.nan
            if weight[j] < least:
                continue
            cell = map_[row[j], column[j]]
            value, sx, sy, spread = _fit(cell, ridge)
            at = cell[10] + value + sx * (x_of[i, j] - column[j]) + sy * (y_of[i, j] - row[j])
            out[i, j, 0], out[i, j, 1], out[i, j, 2] = at, sx, sy
            out[i, j, 3], out[i, j, 4] = spread, weight[j]


@nb.njit(cache=True, nogil=True)
def update_map(map_, readings, weight, x_of, y_of, metric, reach, gain):
    """Add readings of one kind to its map.

    Parameters
    ----------
    map_ : (row, column, TERMS)
        Changed in place.
    readings, weight, x_of, y_of : (row, column)
        Readings, their weights (0 to leave one out), and map coordinates.
    metric : (3,)
        Squared distance of an offset (x, y) in cells: ``m0 xx + m1 xy + m2 yy``, 1 at the edge of the kernel.
    reach : (2,)
        Extent of the kernel in x and y. [cell]
    gain
        exp(time/τ).
    """
    height, width = map_.shape[:2]
    m0, m1, m2 = np.float32(metric[0]), np.float32(metric[1]), np.float32(metric[2])
    one, grown = np.float32(1.0), np.float32(gain)
    for i in range(readings.shape[0]):
        for j in range(readings.shape[1]):
            share = weight[i, j] * grown
            if not share > 0.0:
                continue
            x, y = x_of[i, j], y_of[i, j]
            if not (-reach[0] < x < width + reach[0] and -reach[1] < y < height + reach[1]):
                continue
            first, last = max(math.ceil(y - reach[1]), 0), min(math.floor(y + reach[1]), height - 1)
            left, right = max(math.ceil(x - reach[0]), 0), min(math.floor(x + reach[0]), width - 1)
            value = readings[i, j]
            for r in range(first, last + 1):
                dy = y - np.float32(r)
                for c in range(left, right + 1):
                    dx = x - np.float32(c)
                    d = m0 * dx * dx + m1 * dx * dy + m2 * dy * dy
                    if d >= one:
                        continue
                    w = share * (one - d) * (one - d)
                    cell = map_[r, c]
                    if cell[0] == 0.0:
                        cell[10] = value
                    v = value - cell[10]
                    wx, wy, wv = w * dx, w * dy, w * v
                    cell[0] += w
                    cell[1] += wx
                    cell[2] += wy
                    cell[3] += wx * dx
                    cell[4] += wx * dy
                    cell[5] += wy * dy
                    cell[6] += wv
                    cell[7] += wv * dx
                    cell[8] += wv * dy
                    cell[9] += wv * v


@nb.njit(cache=True, nogil=True)
def _cell_of(x, y, ratio):
    """Row and column of the coarse cell at fine coordinates."""
    return int(np.floor((y + 0.5) * ratio)), int(np.floor((x + 0.5) * ratio))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def residuals(start, stop, fitted, readings, noise, scale, places, ratio, parts, var, z2):
    """Compute the expected variance of each residual of one kind, and its square over that.

    Parameters
    ----------
    start, stop
        Rows of elements.
    fitted : (row, column, 5)
        From `predict_readings`.
    readings, noise : (row, column)
        Readings, and variance of the sensor's noise.
    scale : (coarse row, coarse column)
    places
        Columns and rows of the elements in fine cells.
    ratio
        Coarse cells in a fine one.
    parts : (3,)
        Weights of the scale, of the fit's spread, and of the spread over the sum of weights.
    var, z2 : (row, column)
        Results; NaN without a prediction or a reading.
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
    """Raise the scale where a residual exceeds it, and lower it elsewhere, except under a mask."""
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
    """Compute the weight of each reading in the map.

    A predicted reading has weight 1, one that differs less, and a masked one 0. A reading that has differed
    in every frame for longer than ``heal_s`` has most of its weight, or a hole after a stopped vehicle would
    stay.
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
    """Add to the normal equations of the shift that best explains the residuals, with robust weights.

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
