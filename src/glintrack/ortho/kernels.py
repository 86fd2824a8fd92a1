"""Compiled kernels: project each cell of a ground grid into the frame, sample there, turn Stokes vectors."""

import numba as nb
import numpy as np

from ..stokes import axis_turn, rotate_qu

NEAREST, BILINEAR, CUBIC = 0, 1, 2


@nb.njit(nogil=True, cache=True)
def sample(
    start, stop, source, row0, column0, pitch, m, lens, focal, principal, east, north, height, method, out
):
    """Rows of the grid by collinearity; NaN behind the lens and off the frame."""
    rows, columns, bands = source.shape
    for i in range(start, stop):
        for j in range(out.shape[1]):
            x, y, z = east[i, j] - lens[0], north[i, j] - lens[1], height[i, j] - lens[2]
            ahead = -(m[2, 0] * x + m[2, 1] * y + m[2, 2] * z)
            r, c = -1.0, -1.0
            if ahead > 0:
                scale = focal / ahead
                r = (principal[0] - scale * (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z) - row0) / pitch
                c = (principal[1] + scale * (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z) - column0) / pitch
            if not (-0.5 <= r < rows - 0.5 and -0.5 <= c < columns - 0.5):
                for b in range(bands):
                    out[i, j, b] = np.nan
                continue
            if method == NEAREST:
                for b in range(bands):
                    out[i, j, b] = source[int(np.floor(r + 0.5)), int(np.floor(c + 0.5)), b]
                continue
            r, c = min(max(r, 0.0), rows - 1.0), min(max(c, 0.0), columns - 1.0)
            i0, j0 = min(int(r), rows - 2), min(int(c), columns - 2)
            fr, fc = np.float32(r - i0), np.float32(c - j0)
            for b in range(bands):
                value = np.float32(np.nan)
                if method == CUBIC and 1 <= i0 < rows - 2 and 1 <= j0 < columns - 2:
                    value = _cubic(source, i0, j0, b, fr, fc)
                if not np.isfinite(value):  # at the border, or beside a pixel without data
                    value = _bilinear(source, i0, j0, b, fr, fc)
                out[i, j, b] = value


@nb.njit(nogil=True, cache=True, inline="always")
def _bilinear(source, i0, j0, b, fr, fc):
    one = np.float32(1.0)
    v00, v01 = source[i0, j0, b], source[i0, j0 + 1, b]
    v10, v11 = source[i0 + 1, j0, b], source[i0 + 1, j0 + 1, b]
    value = (one - fr) * ((one - fc) * v00 + fc * v01) + fr * ((one - fc) * v10 + fc * v11)
    if np.isfinite(value):
        return value
    total, weight = np.float32(0.0), np.float32(0.0)
    for di in range(2):
        for dj in range(2):
            v = source[i0 + di, j0 + dj, b]
            w = (fr if di else one - fr) * (fc if dj else one - fc)
            if np.isfinite(v):
                total += w * v
                weight += w
    # a dark mirror blanks what lies nearer to it than to its neighbours
    return total / weight if weight > np.float32(0.5) else np.float32(np.nan)


@nb.njit(nogil=True, cache=True)
def _cubic(source, i0, j0, b, fr, fc):
    """Cubic convolution with a = −½: third order for smooth pictures (Keys, IEEE Trans. ASSP 29, 1981)."""
    wr0, wr1, wr2, wr3 = _keys(fr)
    wc0, wc1, wc2, wc3 = _keys(fc)
    total = np.float32(0.0)
    for k in range(4):
        s = source[i0 + k - 1]
        line = wc0 * s[j0 - 1, b] + wc1 * s[j0, b] + wc2 * s[j0 + 1, b] + wc3 * s[j0 + 2, b]
        total += (wr0 if k == 0 else wr1 if k == 1 else wr2 if k == 2 else wr3) * line
    return total


@nb.njit(nogil=True, cache=True, inline="always")
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
