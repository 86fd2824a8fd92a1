"""Terms that neighbouring elements share, kept for the next: light through the same air, the same facet.

Each function fills scratch arrays of the kernel in `pixels` only where its key has changed.
"""

import numba as nb
import numpy as np

from glintrack.render.shading.normals import NORMAL_NODES, square_cell
from glintrack.render.shading.rough import ABOVE, BELOW, SKY, SUN

FACETS_KEPT = 128  # a power of two; a row of a frame shows more, several times each
_MIX_X, _MIX_Y, _MIX_Z = 40993.0, 79193.0, 15437.0  # spread the normals over the slots
FINE_STEPS = 128  # between nodes of the airmass: the nearest is good to 2e-4 of the transmittance


@nb.njit(cache=True, fastmath=True, forceinline=True)
def through_air(lights, step, row, kept_step, kept, width):
    """Make ``kept[row]`` the lights of a row through the air of a fine step of airmass."""
    if kept_step[row] == step:
        return
    kept_step[row] = step
    low = step // FINE_STEPS
    part = np.float32((step - low * FINE_STEPS) / FINE_STEPS)
    high = min(low + 1, lights.shape[0] - 1)
    for e in range(lights.shape[2]):
        for x in range(width):
            under, over = lights[low, row, e, x], lights[high, row, e, x]
            kept[row, e, x] = under + part * (over - under)


@nb.njit(cache=True, fastmath=True, forceinline=True)
def gather_around(nx, ny, nz, optical, terms, r, c, rough, at, facet):
    """Interpolate the table of rough reflection to a facet's normal, at each of the four looks around.

    Facets are met again in the next row: ``facet`` keeps some, in the slot that is returned, and ``at`` says
    which.
    """
    row_low, column_low = rough.grid.row_low[r], rough.grid.column_low[c]
    rows, columns = rough.grid.direction.shape[:2]
    place = float(row_low * columns + column_low)
    slot = int(abs(nx * _MIX_X + ny * _MIX_Y + nz * _MIX_Z) + optical * 11 + place * 5) & (FACETS_KEPT - 1)
    known = at[slot, 0] == optical and at[slot, 1] == place
    if known and at[slot, 2] == nx and at[slot, 3] == ny and at[slot, 4] == nz:
        return slot
    at[slot, 0], at[slot, 1], at[slot, 2], at[slot, 3], at[slot, 4] = optical, place, nx, ny, nz
    first_row, gathered = rough.first, rough.gathered
    stride = 2 if rough.soft[optical] else 1
    i, k, fx, fy = square_cell(nx, ny, nz, stride)
    w11 = np.float32(fx * fy)
    w10, w01 = np.float32(fx) - w11, np.float32(fy) - w11
    w00 = np.float32(1.0) - w10 - w01 - w11
    corner = i * NORMAL_NODES + k
    across = stride * NORMAL_NODES if fx > 0 else 0  # what has no part need not be in the table
    along = stride if fy > 0 else 0
    values = gathered.shape[1] * terms * min(columns, 2)  # rows of two looks side by side follow each other
    for near in range(2):
        look = min(row_low + near, rows - 1) * columns + column_low
        a, b = first_row[optical, corner, look], first_row[optical, corner + along, look]
        c, d = first_row[optical, corner + across, look], first_row[optical, corner + across + along, look]
        for x in range(values):
            low = w00 * gathered[a, x] + w01 * gathered[b, x]
            facet[slot, near, 0, x] = low + w10 * gathered[c, x] + w11 * gathered[d, x]
    return slot


@nb.njit(cache=True, fastmath=True, forceinline=True)
def add_gathered(around, terms, skies, r, c, rough, facet, slot, mixed, mirrored):
    """Interpolate between the looks around, and add what sun, surroundings and sky send.

    ``around`` is the weight of the reflection, what `mirrored_place.mirrored_here` says of the place, and the
    part of the sun that arrives. [1]
    """
    weight, (sky_view, off_mean), sunlight = around
    row_part, column_part = rough.grid.row_part[r], rough.grid.column_part[c]
    w11 = np.float32(weight * row_part * column_part)
    w10, w01 = np.float32(weight * row_part) - w11, np.float32(weight * column_part) - w11
    w00 = np.float32(weight) - w10 - w01 - w11
    sky, glint = np.float32(sky_view), np.float32(sunlight)
    below, above = np.float32(off_mean), np.float32((1.0 - sky_view) * off_mean)
    side = terms if rough.grid.direction.shape[1] > 1 else 0
    for term in range(terms):
        for x in range(facet.shape[3]):
            low = w00 * facet[slot, 0, term, x] + w01 * facet[slot, 0, side + term, x]
            mixed[x] = low + w10 * facet[slot, 1, term, x] + w11 * facet[slot, 1, side + term, x]
        to = term * (2 + skies)
        for s in range(3):
            mirrored[to, s] += glint * mixed[3 * SUN + s]
            mirrored[to + 1, s] += above * mixed[3 * ABOVE + s] + below * mixed[3 * BELOW + s]
        for e in range(skies):
            for s in range(3):
                mirrored[to + 2 + e, s] += sky * mixed[3 * (SKY + e) + s]


@nb.njit(cache=True, fastmath=True, forceinline=True)
def gathered_off_sky(lobe, r, c, rough, facet, slot):
    """I, Q and U of what is gathered off surfaces, if all of them send a radiance of 1.

    ``lobe`` is the weight of the reflection, what of the sky is mirrored, and the number of Fresnel terms and
    their amounts. [1]
    """
    weight, sky_view, terms, amounts = lobe
    row_part, column_part = rough.grid.row_part[r], rough.grid.column_part[c]
    side = terms if rough.grid.direction.shape[1] > 1 else 0
    i, q, u = 0.0, 0.0, 0.0
    for term in range(terms):
        for near in range(2):
            for right in range(2):
                part = (row_part if near else 1.0 - row_part) * (column_part if right else 1.0 - column_part)
                row = facet[slot, near, term + right * side]
                above, below = weight * amounts[term] * part * (1.0 - sky_view), weight * amounts[term] * part
                i += above * row[3 * ABOVE] + below * row[3 * BELOW]
                q += above * row[3 * ABOVE + 1] + below * row[3 * BELOW + 1]
                u += above * row[3 * ABOVE + 2] + below * row[3 * BELOW + 2]
    return i, q, u


@nb.njit(cache=True, fastmath=True, forceinline=True)
def set_path(where, path, share, at, here, width, total):
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
                for x in range(width):
                    low, high = path[row_low, column, s, x], path[row_high, column, s, x]
                    here[side, s, x] = low + raised * (high - low)
    right = np.float32(share * column_part)
    left = np.float32(share) - right
    for s in range(3):
        for x in range(width):
            total[s, x] = left * here[0, s, x] + right * here[1, s, x]
