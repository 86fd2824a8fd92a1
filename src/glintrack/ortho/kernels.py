"""Compiled sweep over a ground grid: the place of each cell in the frame by collinearity, and a sample there.

Row by row, in loops that vectorise: places of cells from the grid and its heights, Eqs. (4)–(5), pixels and
fractions of a pixel, samples. Single precision is enough because all coordinates are relative to a place in
the grid and the pixel there, not to the lens.

Samples are nearest, bilinear and cubic ones of one band. ``source`` is the flattened frame, its pixels
``side`` and its rows ``below`` apart; ``out`` the grid, with this row from ``row`` on; its places in the
frame are `Pixels`. Offsets are unsigned: numba then omits the test for negative ones. Nothing is sliced,
which would count references in every row.
"""

from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.distortion import distort
from glintrack.core.interpolation import keys_weights
from glintrack.stokes import axis_turn, rotate_qu


class Pixels(NamedTuple):
    """Places of a row of cells in the frame.

    Parameters
    ----------
    at
        Offset of each place's upper left pixel in the flattened frame.
    down, right
        Fraction of a pixel, NaN off the frame. [pixel]
    """

    at: Int[Array, "x"]
    down: Float[Array, "x"]
    right: Float[Array, "x"]


@nb.njit(cache=True, error_model="numpy")
def sample_nearest(source, band, side, below, pixels, first, last, out, row):
    """Values of the nearest pixels."""
    at, down, right, half = pixels.at, pixels.down, pixels.right, np.float32(0.5)
    for j in range(np.uintp(first), np.uintp(last)):
        k = np.uintp(at[j]) + band + (below if down[j] >= half else np.uintp(0))
        value = source[k + (side if right[j] >= half else np.uintp(0))]
        out[row + j * side + band] = value if down[j] == down[j] else np.float32(np.nan)


@nb.njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def sample_bilinear(source, band, side, below, pixels, first, last, out, row):
    """Bilinear values; next to missing pixels, the weighted mean of the others."""
    at, down, right = pixels.at, pixels.down, pixels.right
    for j in range(np.uintp(first), np.uintp(last)):
        k, fr, fc = np.uintp(at[j]) + band, down[j], right[j]
        v00, v01, v10, v11 = source[k], source[k + side], source[k + below], source[k + below + side]
        upper, lower = v00 + fc * (v01 - v00), v10 + fc * (v11 - v10)
        value = upper + fr * (lower - upper)
        if not np.isfinite(value):
            value = present(v00, v01, v10, v11, fr, fc)
        out[row + j * side + band] = value


@nb.njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def sample_cubic(source, band, side, below, pixels, window, weights, first, last, out, row):
    """Cubic convolution by `cubic_weights`; bilinear next to missing pixels."""
    at, down, right = pixels.at, pixels.down, pixels.right
    s1, s2, s3 = side, side + side, side + side + side
    for j in range(np.uintp(first), np.uintp(last)):
        k0 = np.uintp(window[j]) + band
        k1 = k0 + below
        k2 = k1 + below
        k3 = k2 + below
        c0, c1, c2, c3 = weights[4, j], weights[5, j], weights[6, j], weights[7, j]
        l0 = c0 * source[k0] + c1 * source[k0 + s1] + c2 * source[k0 + s2] + c3 * source[k0 + s3]
        l1 = c0 * source[k1] + c1 * source[k1 + s1] + c2 * source[k1 + s2] + c3 * source[k1 + s3]
        l2 = c0 * source[k2] + c1 * source[k2 + s1] + c2 * source[k2 + s2] + c3 * source[k2 + s3]
        l3 = c0 * source[k3] + c1 * source[k3 + s1] + c2 * source[k3 + s2] + c3 * source[k3 + s3]
        value = weights[0, j] * l0 + weights[1, j] * l1 + weights[2, j] * l2 + weights[3, j] * l3
        if not np.isfinite(value):
            k = np.uintp(at[j]) + band
            v00, v01, v10, v11 = source[k], source[k + side], source[k + below], source[k + below + side]
            value = present(v00, v01, v10, v11, down[j], right[j])
        out[row + j * side + band] = value


@nb.njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def cubic_weights(size, above, left, down, right, window, weights):
    """Windows of 4 × 4 pixels about the pixel in row ``above``, column ``left`` of a frame of ``size``.

    ``weights`` are of the window's rows (0 to 3) and columns (4 to 7): those of `keys_weights`; between
    the two outermost pixels linear.
    """
    low_r, low_c, zero = np.int32(size[0] - 4), np.int32(size[1] - 4), np.int32(0)
    step, side = size[1] * size[2], size[2]
    for j in range(len(above)):
        i, k = min(max(above[j] - np.int32(1), zero), low_r), min(max(left[j] - np.int32(1), zero), low_c)
        window[j] = i * step + k * side
        weights[0, j], weights[1, j], weights[2, j], weights[3, j] = _in_window(down[j], above[j] - i)
        weights[4, j], weights[5, j], weights[6, j], weights[7, j] = _in_window(right[j], left[j] - k)


@nb.njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _in_window(f, before):
    """Weights of four pixels, the place behind the ``before``-th of them."""
    one, zero = np.float32(1.0), np.float32(0.0)
    w0, w1, w2, w3 = keys_weights(f)
    first, last = before == 0, before == 2
    w0 = one - f if first else (zero if last else w0)
    w1 = f if first else (zero if last else w1)
    w2 = zero if first else (one - f if last else w2)
    w3 = zero if first else (f if last else w3)
    return w0, w1, w2, w3


@nb.njit(cache=True, error_model="numpy")
def present(v00, v01, v10, v11, fr, fc):
    """Bilinear value of the pixels that are there; NaN where they have half the weight or less."""
    zero, one = np.float32(0.0), np.float32(1.0)
    total, weight = zero, zero
    if np.isfinite(v00):
        total, weight = total + (one - fr) * (one - fc) * v00, weight + (one - fr) * (one - fc)
    if np.isfinite(v01):
        total, weight = total + (one - fr) * fc * v01, weight + (one - fr) * fc
    if np.isfinite(v10):
        total, weight = total + fr * (one - fc) * v10, weight + fr * (one - fc)
    if np.isfinite(v11):
        total, weight = total + fr * fc * v11, weight + fr * fc
    # a dark mirror blanks what is nearer to it than to its neighbours
    return total / weight if weight > np.float32(0.5) else np.float32(np.nan)


NEAREST, BILINEAR, CUBIC = 0, 1, 2


class Collinearity(NamedTuple):
    """Collinearity relative to a place in the grid.

    Parameters
    ----------
    origin
        A place, the principal row and column and the focal length. [m, m, m, pixel, pixel, pixel]
    linear
        The distance ahead of the lens [m] and that times row and column, these less those of the place
        [m pixel], as linear functions of a cell's offset east, north and up of the place: value there and
        slopes. Last the place's row and column, or the principal ones if it is not before the lens. [pixel]
    distortion
        The lens's coefficients; empty without.
    """

    origin: Float[Array, "6"]
    linear: Float[Array, "3 5"]
    distortion: Float[Array, "k"]


@nb.njit(nogil=True, cache=True, error_model="numpy")
def sample(
    start, stop, source, size, collinearity, places, method, to_meridian, polarized, dolp_floor, out, dolp
):
    """Rows of the grid; NaN behind the lens and off the frame.

    ``source`` is the flattened frame, row by row and band by band, and ``out`` the grid likewise. ``size`` is
    the frame's rows, columns and bands, and the grid's columns. ``collinearity`` is a `Collinearity`,
    ``places`` are `rectify.GridCells`. ``polarized`` is the number of components of each Stokes vector to
    rotate, 0 for none, and ``to_meridian`` the lens's place from the origin and their reference axis.
    ``dolp`` is empty where it is not needed.
    """
    origin, height, node_row = collinearity.origin, places.height, places.node_row
    count, side, below = size[3], np.uintp(size[2]), np.uintp(size[1] * size[2])
    nodes = np.empty(height.shape[1], np.float32)
    node, share = _between(places.node_column, height.shape[1])
    x, y, z = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.float32)
    down, right = np.empty(count, np.float32), np.empty(count, np.float32)
    at, above, left = np.empty(count, np.int64), np.empty(count, np.int32), np.empty(count, np.int32)
    pixels = Pixels(at, down, right)
    window, weights = np.empty(count, np.int64), np.empty((8, count), np.float32)
    for i in range(start, stop):
        row = np.uintp(i) * np.uintp(count) * side
        _across(i, places.east, origin[0], x)
        _across(i, places.north, origin[1], y)
        if node_row.size > 0:
            _over_nodes(height, node_row[i], node, share, origin[2], nodes, z)
        else:
            _across(i, height, origin[2], z)
        _project(x, y, z, collinearity.linear, down, right)
        if collinearity.distortion.size > 0:
            _distort(down, right, origin, collinearity.distortion)
        _pixels_above(down, right, size, at, above, left)
        first, last = _range_on_frame(down)
        _leave_empty(out, row, row + first * side)
        _leave_empty(out, row + last * side, row + count * side)
        if method == CUBIC:
            cubic_weights(size, above, left, down, right, window, weights)
        for band in range(side):  # one after the other: a loop over the few bands of each cell is slower
            if method == NEAREST:
                sample_nearest(source, band, side, below, pixels, first, last, out, row)
            elif method == BILINEAR:
                sample_bilinear(source, band, side, below, pixels, first, last, out, row)
            else:
                sample_cubic(source, band, side, below, pixels, window, weights, first, last, out, row)
        if polarized > 0:
            _turn_row(x, y, z, to_meridian, side, np.uintp(polarized), first, last, out, row)
        if dolp.size > 0:
            _dolp_row(out, row, side, dolp_floor, dolp[i])


@nb.njit(cache=True, error_model="numpy")
def _across(i, values, origin, to):
    """Copy a row of an array, less the origin; an array of one row or column repeats. [m]"""
    i = np.uintp(i if values.shape[0] > 1 else 0)
    if values.shape[1] == 1:
        value = np.float32(values[i, 0] - origin)
        for j in range(len(to)):
            to[j] = value
        return
    for j in range(len(to)):
        to[j] = values[i, np.uintp(j)] - origin


@nb.njit(cache=True, error_model="numpy")
def _over_nodes(height, node_row, node, share, origin, nodes, z):
    """Heights between the nodes of a terrain, bilinear, from the origin. [m]"""
    above = np.uintp(min(int(node_row), height.shape[0] - 2))
    part = np.float32(node_row - above)
    for k in range(node[0], node[len(node) - 1] + 2):
        upper, lower = height[above, np.uintp(k)] - origin, height[above + np.uintp(1), np.uintp(k)] - origin
        nodes[k] = upper + part * (lower - upper)
    for j in range(len(z)):
        left, right = nodes[np.uintp(node[j])], nodes[np.uintp(node[j] + 1)]
        z[j] = left + share[j] * (right - left)


@nb.njit(cache=True)
def _between(node_column, count):
    """Node to the left of each cell, and its fraction of a node."""
    node, share = np.empty(len(node_column), np.intp), np.empty(len(node_column), np.float32)
    for j in range(len(node)):
        node[j] = min(int(node_column[j]), count - 2)
        share[j] = node_column[j] - node[j]
    return node, share


@nb.njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def _project(x, y, z, linear, row, column):
    """Collinearity, Eqs. (4)–(5): a quotient of linear functions; NaN behind the lens. [pixel]"""
    one, none = np.float32(1.0), np.float32(np.nan)
    a0, ax, ay, az = _four(linear[0])
    r0, rx, ry, rz = _four(linear[1])
    c0, cx, cy, cz = _four(linear[2])
    row_there, column_there = np.float32(linear[1, 4]), np.float32(linear[2, 4])
    for j in range(len(x)):
        ahead = a0 + ax * x[j] + ay * y[j] + az * z[j]
        near = one / ahead if ahead > 0 else none
        row[j] = row_there + (r0 + rx * x[j] + ry * y[j] + rz * z[j]) * near
        column[j] = column_there + (c0 + cx * x[j] + cy * y[j] + cz * z[j]) * near


@nb.njit(nogil=True, cache=True, inline="always")
def _four(values):
    return np.float32(values[0]), np.float32(values[1]), np.float32(values[2]), np.float32(values[3])


@nb.njit(cache=True, error_model="numpy")
def _distort(row, column, origin, coefficients):
    """Distort places by the lens (`distortion.distort`); ``origin`` ends in its axis and focal length."""
    middle_r, middle_c, k = origin[3], origin[4], origin[5]
    for j in range(len(row)):
        across, down = distort((column[j] - middle_c) / k, (row[j] - middle_r) / k, coefficients)
        row[j], column[j] = middle_r + k * down, middle_c + k * across


@nb.njit(cache=True, error_model="numpy")
def _pixels_above(down, right, size, at, above, left):
    """Split places into the upper left of their four pixels and the rest, which is NaN off the frame."""
    half, zero, none = np.float32(0.5), np.float32(0.0), np.float32(np.nan)
    last_r, last_c = np.float32(size[0] - 1), np.float32(size[1] - 1)
    low_r, low_c, step, side = np.int32(size[0] - 2), np.int32(size[1] - 2), size[1] * size[2], size[2]
    for j in range(len(at)):
        r, c = down[j], right[j]
        inside = (r >= -half) & (r < last_r + half) & (c >= -half) & (c < last_c + half)
        r, c = min(max(r, zero), last_r) if inside else zero, min(max(c, zero), last_c) if inside else zero
        i0, j0 = min(np.int32(r), low_r), min(np.int32(c), low_c)
        at[j], above[j], left[j] = i0 * step + j0 * side, i0, j0
        down[j] = r - np.float32(i0) if inside else none
        right[j] = c - np.float32(j0)


@nb.njit(cache=True)
def _range_on_frame(down):
    """First cell on the frame, and the one after the last."""
    first, last = 0, len(down)
    while first < last and np.isnan(down[first]):
        first += 1
    while first < last and np.isnan(down[last - 1]):
        last -= 1
    return first, last


@nb.njit(cache=True)
def _leave_empty(out, start, stop):
    for k in range(start, stop):
        out[k] = np.float32(np.nan)


@nb.njit(cache=True, error_model="numpy")
def _turn_row(x, y, z, to_meridian, side, components, first, last, out, row):
    """Turn (Q, U) from the detector's +x to the vertical plane of each ray."""
    lx, ly, lz = to_meridian[0], to_meridian[1], to_meridian[2]
    mx, my, mz = to_meridian[3], to_meridian[4], to_meridian[5]
    for j in range(np.uintp(first), np.uintp(last)):
        kx, ky, kz = lx - x[j], ly - y[j], lz - z[j]
        norm = 1.0 / np.sqrt(kx * kx + ky * ky + kz * kz)
        c, s = axis_turn(mx, my, mz, 0.0, 0.0, 1.0, kx * norm, ky * norm, kz * norm)
        for k in range(row + j * side, row + (j + np.uintp(1)) * side, components):
            q, u = k + np.uintp(1), k + np.uintp(2)
            out[q], out[u] = rotate_qu(out[q], out[u], c, s)


@nb.njit(cache=True, error_model="numpy")
def _dolp_row(out, row, side, floor, dolp):
    """Degree of linear polarization, Eq. (2); NaN at or below the floor."""
    for j in range(len(dolp)):
        k = row + np.uintp(j) * side
        total, q, u = out[k], out[k + np.uintp(1)], out[k + np.uintp(2)]
        dolp[j] = np.sqrt(q * q + u * u) / total if total > floor else np.float32(np.nan)
