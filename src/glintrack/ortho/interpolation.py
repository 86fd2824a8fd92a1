"""Compiled rows of interpolation: nearest, bilinear and cubic samples of one band at places in a frame.

``source`` is the frame laid flat, its pixels ``side`` and its rows ``below`` apart; ``out`` the grid, this
row from ``row`` on; its places in the frame are `Pixels`. Offsets are unsigned: numba then does
not ask at every access whether they are negative. Nothing is sliced, which would count references in every
row.
"""

from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.cubic import keys_weights
from glintrack.core.kernels.parts import kernel_part


class Pixels(NamedTuple):
    """Places of a row of cells in the frame.

    Parameters
    ----------
    at
        Offset of each place's upper left (or nearest) pixel in the frame laid flat.
    down, right
        What is left of the place, NaN off the frame. [pixel]
    """

    at: Int[Array, "x"]
    down: Float[Array, "x"]
    right: Float[Array, "x"]


@kernel_part(error_model="numpy")
def nearest_row(source, band, side, pixels, first, last, out, row):
    """Values of the nearest pixels."""
    at, down = pixels.at, pixels.down
    for j in range(np.uintp(first), np.uintp(last)):
        value = source[np.uintp(at[j]) + band]
        out[row + j * side + band] = value if down[j] == down[j] else np.float32(np.nan)


@kernel_part(error_model="numpy", fastmath={"contract"}, forceinline=True)
def bilinear_row(source, band, side, below, pixels, first, last, out, row):
    """Bilinear values; beside missing pixels, the mean of the others by their weights."""
    at, down, right = pixels.at, pixels.down, pixels.right
    for j in range(np.uintp(first), np.uintp(last)):
        k, fr, fc = np.uintp(at[j]) + band, down[j], right[j]
        v00, v01, v10, v11 = source[k], source[k + side], source[k + below], source[k + below + side]
        upper, lower = v00 + fc * (v01 - v00), v10 + fc * (v11 - v10)
        value = upper + fr * (lower - upper)
        if not np.isfinite(value):
            value = present(v00, v01, v10, v11, fr, fc)
        out[row + j * side + band] = value


@kernel_part(error_model="numpy", fastmath={"contract"}, forceinline=True)
def cubic_row(source, band, side, below, pixels, window, weights, first, last, out, row):
    """Cubic convolution by `cubic_weights`; bilinear beside missing pixels."""
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


@kernel_part(error_model="numpy", fastmath={"contract"}, forceinline=True)
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


@kernel_part(error_model="numpy")
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
    # a dark mirror blanks what lies nearer to it than to its neighbours
    return total / weight if weight > np.float32(0.5) else np.float32(np.nan)
