"""Compiled loops of the ground map of raw elements: predict a reading, add it to the map, follow its scale.

Every kind of element (place in the superpixel) has its own map. A cell holds what a weighted straight-line
fit of past readings v at offsets (x, y) from the cell's centre needs, about a reference value r: ``[Σw,
Σwx, Σwy, Σwxx, Σwxy, Σwyy, Σwv, Σwxv, Σwyv, Σwvv, r]``. The weight of a reading falls with its distance as
a biweight, ``(1 − d²/R²)²``, and with its age as exp(−age/τ): ages are kept by letting weights grow with
time.
"""

import math

import numba as nb
import numpy as np

TERMS = 11


@nb.njit(cache=True, nogil=True)
def _fit(cell, ridge):
    """Straight-line fit of a cell: value, slopes along columns and rows, mean squared residual."""
    w = cell[0]
    a11 = cell[3] + ridge * w - cell[1] * cell[1] / w
    a22 = cell[5] + ridge * w - cell[2] * cell[2] / w
    a12 = cell[4] - cell[1] * cell[2] / w
    b1 = cell[7] - cell[1] * cell[6] / w
    b2 = cell[8] - cell[2] * cell[6] / w
    det = a11 * a22 - a12 * a12
    if det <= 1e-12 * w * w:
        sx = sy = 0.0
    else:
        sx = (a22 * b1 - a12 * b2) / det
        sy = (a11 * b2 - a12 * b1) / det
    value = (cell[6] - sx * cell[1] - sy * cell[2]) / w
    spread = (cell[9] - cell[6] * cell[6] / w - sx * b1 - sy * b2) / w
    return value, sx, sy, max(spread, 0.0)


@nb.njit(cache=True, nogil=True)
def predict(start, stop, map_, x_of, y_of, least, ridge, out):
    """Reading predicted of each element of a kind, with slopes and spread, from the cell under it.

    Parameters
    ----------
    start, stop
        Rows of elements.
    map_ : (row, column, TERMS)
    x_of, y_of : (row, column)
        Ground points of the kind's elements: columns and rows of the map.
    least
        Sum of weights under which a cell predicts nothing.
    ridge
        Pulls slopes to nought. [cell²]
    out : (row, column, 5)
        Predicted reading, slopes along columns and rows, mean squared residual, sum of weights; NaN for none.
    """
    height, width = map_.shape[:2]
    for i in range(start, stop):
        for j in range(out.shape[1]):
            x, y = x_of[i, j], y_of[i, j]
            out[i, j, 0] = np.nan
            if not (-0.5 < x < width - 0.5 and -0.5 < y < height - 0.5):
                continue
            c, r = int(x + 0.5), int(y + 0.5)
            cell = map_[r, c]
            if cell[0] < least:
                continue
            value, sx, sy, spread = _fit(cell, ridge)
            out[i, j, 0] = cell[10] + value + sx * (x - c) + sy * (y - r)
            out[i, j, 1], out[i, j, 2], out[i, j, 3], out[i, j, 4] = sx, sy, spread, cell[0]


@nb.njit(cache=True, nogil=True)
def update_map(map_, readings, weight, x_of, y_of, metric, reach, gain):
    """Add readings of one kind to its map.

    Parameters
    ----------
    map_ : (row, column, TERMS)
        Changed.
    readings, weight, x_of, y_of : (row, column)
        What was read, how much it counts (0 to leave it out), and where.
    metric : (3,)
        Squared distance of an offset (x, y) in cells: ``m0 xx + m1 xy + m2 yy``, 1 at the edge of the kernel.
    reach : (2,)
        Farthest x and y at which that may be under 1. [cell]
    gain
        exp(time/τ).
    """
    height, width = map_.shape[:2]
    m0, m1, m2 = metric[0], metric[1], metric[2]
    for i in range(readings.shape[0]):
        for j in range(readings.shape[1]):
            share = weight[i, j] * gain
            if not share > 0.0:
                continue
            x, y = x_of[i, j], y_of[i, j]
            if not (-reach[0] < x < width + reach[0] and -reach[1] < y < height + reach[1]):
                continue
            first, last = max(math.ceil(y - reach[1]), 0), min(math.floor(y + reach[1]), height - 1)
            left, right = max(math.ceil(x - reach[0]), 0), min(math.floor(x + reach[0]), width - 1)
            value = readings[i, j]
            for r in range(first, last + 1):
                dy = y - r
                for c in range(left, right + 1):
                    dx = x - c
                    d = m0 * dx * dx + m1 * dx * dy + m2 * dy * dy
                    if d >= 1.0:
                        continue
                    w = share * (1.0 - d) * (1.0 - d)
                    cell = map_[r, c]
                    if cell[0] == 0.0:
                        cell[10] = value
                    v = value - cell[10]
                    cell[0] += w
                    cell[1] += w * dx
                    cell[2] += w * dy
                    cell[3] += w * dx * dx
                    cell[4] += w * dx * dy
                    cell[5] += w * dy * dy
                    cell[6] += w * v
                    cell[7] += w * dx * v
                    cell[8] += w * dy * v
                    cell[9] += w * v * v
