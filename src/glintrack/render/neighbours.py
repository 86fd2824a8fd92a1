"""What neighbouring elements share, kept from one to the next: light through the same air, the same facet.

Each function fills scratch arrays of the kernel in `pixels` only where its key has changed.
"""

import numba as nb
import numpy as np

from .normals import NORMAL_NODES, square_cell
from .rough import ABOVE, BELOW, SKY, SUN

FINE_STEPS = 128  # between nodes of the airmass: the nearest is good to 2e-4 of the transmittance


@nb.njit(cache=True, fastmath=True, forceinline=True)
def through_air(lights, step, row, kept_step, kept):
    """Make ``kept[row]`` the lights of a row through the air of a fine step of airmass."""
    if kept_step[row] == step:
        return
    kept_step[row] = step
    low = step // FINE_STEPS
    part = np.float32((step - low * FINE_STEPS) / FINE_STEPS)
    high = min(low + 1, lights.shape[0] - 1)
    for e in range(lights.shape[2]):
        for x in range(lights.shape[3]):
            under, over = lights[low, row, e, x], lights[high, row, e, x]
            kept[row, e, x] = under + part * (over - under)


@nb.njit(cache=True, fastmath=True, forceinline=True)
def gather_around(
    nx, ny, nz, optical, terms, looks, row_low, column_low, soft, first_row, gathered, at, facet
):  # fmt: skip
    """Interpolate the table of rough reflection to a facet's normal, at each of the four looks around.

    ``facet`` is left alone if it was made for the same facet, class and looks; ``at`` says for which.
    """
    place = float(row_low * looks[1] + column_low)
    if at[0] == optical and at[1] == place and at[2] == nx and at[3] == ny and at[4] == nz:
        return
    at[0], at[1], at[2], at[3], at[4] = optical, place, nx, ny, nz
    stride = 2 if soft[optical] else 1
    i, k, fx, fy = square_cell(nx, ny, nz, stride)
    w11 = np.float32(fx * fy)
    w10, w01 = np.float32(fx) - w11, np.float32(fy) - w11
    w00 = np.float32(1.0) - w10 - w01 - w11
    corner = i * NORMAL_NODES + k
    across = stride * NORMAL_NODES if fx > 0 else 0  # what has no part need not be in the table
    along = stride if fy > 0 else 0
    for near in range(4):
        row, column = min(row_low + (near >> 1), looks[0] - 1), min(column_low + (near & 1), looks[1] - 1)
        look = row * looks[1] + column
        a, b = first_row[optical, corner, look], first_row[optical, corner + along, look]
        c, d = first_row[optical, corner + across, look], first_row[optical, corner + across + along, look]
        for term in range(terms):
            for x in range(gathered.shape[1]):
                low = w00 * gathered[a + term, x] + w01 * gathered[b + term, x]
                facet[near, term, x] = low + w10 * gathered[c + term, x] + w11 * gathered[d + term, x]


@nb.njit(cache=True, fastmath=True, forceinline=True)
def add_gathered(weight, openness, sunlight, terms, skies, row_part, column_part, facet, mirrored):
    """Interpolate between the looks around, and add what sun, surroundings and sky send."""
    w11 = np.float32(weight * row_part * column_part)
    w10, w01 = np.float32(weight * row_part) - w11, np.float32(weight * column_part) - w11
    w00 = np.float32(weight) - w10 - w01 - w11
    sky, even, glint = np.float32(openness), np.float32(1.0 - openness), np.float32(sunlight)
    for term in range(terms):
        to = term * (2 + skies)
        for s in range(3):
            mirrored[to, s] += glint * _mixed(facet, term, 3 * SUN + s, w00, w01, w10, w11)
            mirrored[to + 1, s] += even * _mixed(facet, term, 3 * ABOVE + s, w00, w01, w10, w11)
            mirrored[to + 1, s] += _mixed(facet, term, 3 * BELOW + s, w00, w01, w10, w11)
        for e in range(skies):
            for s in range(3):
                at = 3 * (SKY + e) + s
                mirrored[to + 2 + e, s] += sky * _mixed(facet, term, at, w00, w01, w10, w11)


@nb.njit(cache=True, fastmath=True, forceinline=True)
def _mixed(facet, term, x, w00, w01, w10, w11):
    low = w00 * facet[0, term, x] + w01 * facet[1, term, x]
    return low + w10 * facet[2, term, x] + w11 * facet[3, term, x]


@nb.njit(cache=True, fastmath=True, forceinline=True)
def set_path(where, path, share, at, here, total):
    """Begin with path radiance, interpolated between rows and columns of the frame.

    ``here`` holds it at the column before and after, for the row and column in ``at``.
    """
    row_low, row_part, column_low, column_part = where
    column_high = min(column_low + 1, path.shape[1] - 1)
    row_high = min(row_low + 1, path.shape[0] - 1)
    raised, cell = np.float32(row_part), float(row_low * path.shape[1] + column_low)
    if at[0] != cell or at[1] != row_part:
        at[0], at[1] = cell, row_part
        for side in range(2):
            column = column_high if side else column_low
            for s in range(3):
                for x in range(path.shape[3]):
                    low, high = path[row_low, column, s, x], path[row_high, column, s, x]
                    here[side, s, x] = low + raised * (high - low)
    right = np.float32(share * column_part)
    left = np.float32(share) - right
    for s in range(3):
        for x in range(total.shape[1]):
            total[s, x] = left * here[0, s, x] + right * here[1, s, x]
