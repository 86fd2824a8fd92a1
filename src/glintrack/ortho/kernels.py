"""Compiled kernels: project each cell of a ground grid into the frame, sample there, turn Stokes vectors."""

import numba as nb
import numpy as np

from ..distortion import bent
from ..stokes import axis_turn, rotate_qu

NEAREST, BILINEAR, CUBIC = 0, 1, 2


@nb.njit(nogil=True, cache=True, error_model="numpy")
def sample(
    start,
    stop,
    source,
    shape,
    row0,
    column0,
    pitch,
    m,
    lens,
    focal,
    principal,
    lens_bending,
    east,
    north,
    height,
    method,
    out,
):
    """Rows of the grid by collinearity; NaN behind the lens and off the frame.

    ``source`` is the frame laid flat, row by row and band by band, of ``shape``; ``out`` likewise from its
    second axis on. Offsets are unsigned: numba then does not ask at every access whether they are negative.
    """
    rows, columns, bands = shape[0], shape[1], shape[2]
    # the constants of every cell once: (row, column) = centre + scaled rotation · ray / distance ahead
    k = focal / pitch
    ax, ay, az = -m[2, 0], -m[2, 1], -m[2, 2]
    rx, ry, rz = -k * m[1, 0], -k * m[1, 1], -k * m[1, 2]
    cx, cy, cz = k * m[0, 0], k * m[0, 1], k * m[0, 2]
    r_middle, c_middle = (principal[0] - row0) / pitch, (principal[1] - column0) / pitch
    lx, ly, lz = lens[0], lens[1], lens[2]
    last_r, last_c = rows - 1.0, columns - 1.0
    step_r, step_c = np.uintp(columns * bands), np.uintp(bands)
    one, half = np.float32(1.0), np.float32(0.5)
    for i in range(start, stop):
        for j in range(east.shape[1]):
            x, y, z = east[i, j] - lx, north[i, j] - ly, height[i, j] - lz
            ahead = ax * x + ay * y + az * z
            near = 1.0 / ahead
            r = r_middle + (rx * x + ry * y + rz * z) * near
            c = c_middle + (cx * x + cy * y + cz * z) * near
            if lens_bending.size > 0:
                across, down = bent((c - c_middle) / k, (r - r_middle) / k, lens_bending)
                r, c = r_middle + k * down, c_middle + k * across
            to = np.uintp(j * bands)
            if not (ahead > 0 and -0.5 <= r < rows - 0.5 and -0.5 <= c < columns - 0.5):
                for b in range(np.uintp(bands)):
                    out[i, to + b] = np.nan
                continue
            if method == NEAREST:
                at = np.uintp(int(r + 0.5)) * step_r + np.uintp(int(c + 0.5)) * step_c
                for b in range(np.uintp(bands)):
                    out[i, to + b] = source[at + b]
                continue
            r, c = min(max(r, 0.0), last_r), min(max(c, 0.0), last_c)
            i0, j0 = min(int(r), rows - 2), min(int(c), columns - 2)
            fr, fc = np.float32(r - i0), np.float32(c - j0)
            at = np.uintp(i0) * step_r + np.uintp(j0) * step_c
            w00, w01, w10, w11 = (one - fr) * (one - fc), (one - fr) * fc, fr * (one - fc), fr * fc
            smooth = method == CUBIC and 1 <= i0 < rows - 2 and 1 <= j0 < columns - 2
            for b in range(np.uintp(bands)):
                k00, k10 = at + b, at + step_r + b
                v00, v01 = source[k00], source[k00 + step_c]
                v10, v11 = source[k10], source[k10 + step_c]
                value = w00 * v00 + w01 * v01 + w10 * v10 + w11 * v11
                if smooth:
                    cubic = _cubic(source, k00 - step_r - step_c, step_r, step_c, fr, fc)
                    value = cubic if np.isfinite(cubic) else value
                if not np.isfinite(value):  # beside a pixel without data
                    total, weight = np.float32(0.0), np.float32(0.0)
                    if np.isfinite(v00):
                        total, weight = total + w00 * v00, weight + w00
                    if np.isfinite(v01):
                        total, weight = total + w01 * v01, weight + w01
                    if np.isfinite(v10):
                        total, weight = total + w10 * v10, weight + w10
                    if np.isfinite(v11):
                        total, weight = total + w11 * v11, weight + w11
                    # a dark mirror blanks what lies nearer to it than to its neighbours
                    value = total / weight if weight > half else np.float32(np.nan)
                out[i, to + b] = value


@nb.njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _cubic(source, corner, step_r, step_c, fr, fc):
    """Cubic convolution with a = −½: third order for smooth pictures (Keys, IEEE Trans. ASSP 29, 1981)."""
    wr0, wr1, wr2, wr3 = _keys(fr)
    wc0, wc1, wc2, wc3 = _keys(fc)
    c1, c2 = step_c, step_c + step_c
    c3 = c2 + step_c
    p0 = corner
    p1 = p0 + step_r
    p2 = p1 + step_r
    p3 = p2 + step_r
    l0 = wc0 * source[p0] + wc1 * source[p0 + c1] + wc2 * source[p0 + c2] + wc3 * source[p0 + c3]
    l1 = wc0 * source[p1] + wc1 * source[p1 + c1] + wc2 * source[p1 + c2] + wc3 * source[p1 + c3]
    l2 = wc0 * source[p2] + wc1 * source[p2 + c1] + wc2 * source[p2 + c2] + wc3 * source[p2 + c3]
    l3 = wc0 * source[p3] + wc1 * source[p3 + c1] + wc2 * source[p3 + c2] + wc3 * source[p3 + c3]
    return wr0 * l0 + wr1 * l1 + wr2 * l2 + wr3 * l3


@nb.njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _keys(f):
    half, one, two = np.float32(0.5), np.float32(1.0), np.float32(2.0)
    w0 = half * f * (f * (two - f) - one)
    w1 = one + half * f * f * (np.float32(3.0) * f - np.float32(5.0))
    w2 = half * f * (one + f * (np.float32(4.0) - np.float32(3.0) * f))
    return w0, w1, w2, half * f * f * (f - one)


@nb.njit(nogil=True, cache=True)
def to_meridian(start, stop, stokes, m, lens, east, north, height):
    """Turn (Q, U) from the detector's +x to the vertical plane of each ray, in place on our own array."""
    for i in range(start, stop):
        for j in range(stokes.shape[1]):
            kx, ky, kz = lens[0] - east[i, j], lens[1] - north[i, j], lens[2] - height[i, j]
            norm = 1.0 / np.sqrt(kx * kx + ky * ky + kz * kz)
            c, s = axis_turn(m[0, 0], m[0, 1], m[0, 2], 0.0, 0.0, 1.0, kx * norm, ky * norm, kz * norm)
            q, u = rotate_qu(stokes[i, j, 1], stokes[i, j, 2], c, s)
            stokes[i, j, 1], stokes[i, j, 2] = q, u
