"""Which cell of probes lights each surface, for `probes`: kernels over the places of `probe_map`."""

import numba as nb
import numpy as np

from glintrack.render.probe_map import (
    EMPTY,
    FACET,
    FAR_FACET,
    FAR_VOLUME,
    VOLUME,
    facet_cell,
    facet_corners,
    slot_of,
    volume_key,
)
from glintrack.render.solid_heights import view_of_solids

OPEN = -1  # cell of a surface beyond all that rises, which sees the whole sky
SPACE = -2  # cells of points in space are counted down from here, so that they are told from facets'
AS_FACETS, IN_SPACE, BY_SIDES, BY_HALVES = range(4)  # roles of instances: as facets, trees, vehicles
LONG_M = 7.0  # vehicles whose sides have an upper and a lower half
CORNERS = 8  # cells of a point in space, by the signs of a normal's components
_SUNK_M = 0.6  # into a crown
_UPWARD = 0.5  # upward component of normals whose sky view the map of heights knows
_LEAST_SEEN, _MOST_HERE = 0.02, 4.0  # of what probes see of the sky, and how much more a place among them may
_LEAST_LEFT = 1e-6  # by leaves, of a surface that the map may know
_STEP = 512  # surfaces that are looked up together
_ASKED, _UNKNOWN = -2, -3  # in the place of a cell's number: to be looked up, and not found
_ANY_FACET, _UPWARD_FACET = CORNERS, CORNERS + 1  # ways to read a cell, after those by the normal's signs


@nb.njit(cache=True, forceinline=True)
def _in_space(seen, instance, material):
    """Whether a surface finds its probe in space: trees, hedges, and every leaf card."""
    if instance >= 0 and seen.role[instance] != AS_FACETS:
        return seen.role[instance] == IN_SPACE
    return material >= 0 and material < seen.sheets.size and seen.sheets[material]


@nb.njit(cache=True, forceinline=True)
def _sunk(seen, instance, px, py, pz):
    """A point of a crown, some way into it: what is seen of a crown is its outside, and has leaves around."""
    if instance < 0:
        return px, py, pz
    mx, my, mz = seen.middle[instance, 0] - px, seen.middle[instance, 1] - py, seen.middle[instance, 2] - pz
    length = np.sqrt(mx * mx + my * my + mz * mz)
    step = min(_SUNK_M, length) / max(length, 1e-9)
    return px + step * mx, py + step * my, pz + step * mz


@nb.njit(cache=True)
def _kind(px, py, window, volume):
    inside = window[0] <= px <= window[2] and window[1] <= py <= window[3]
    if volume:
        return VOLUME if inside else FAR_VOLUME
    return FACET if inside else FAR_FACET


@nb.njit(cache=True)
def add_wanted(rays, seen, where, known, counts, wanted, first_row, new_cells):
    """Number every cell and probe that some rays lack.

    Returns how many probes are new (−1: more than there is room for), and the numbers of cells and rows.
    """
    _, window, scale = where
    cell_map, row_map = known
    rows, first_cell, most = counts
    corners, used, cells = np.empty(4, np.int64), 0, first_cell
    for ray in rays:
        p, n, instance = seen.point[ray], seen.normal[ray], seen.instance[ray]
        px, py, pz = float(p[0]), float(p[1]), float(p[2])
        nx, ny, nz = float(n[0]), float(n[1]), float(n[2])
        volume = _in_space(seen, instance, seen.material[ray])
        kind = _kind(px, py, window, volume)
        if volume:
            key = volume_key(*_sunk(seen, instance, px, py, pz), kind, scale)
        else:
            key, _, _ = facet_cell(px, py, pz, nx, ny, nz, kind, scale)
        slot = slot_of(cell_map.keys, key)
        if cell_map.keys[slot] == key:
            continue
        if rows + 6 > most or cells + 2 * CORNERS > CORNERS * most or used + 4 > most:
            return -1, cells, rows
        cell_map.keys[slot] = key
        if volume:
            cells += -cells % CORNERS
            cell_map.numbers[slot] = cells
            wanted[used], first_row[used] = key, rows
            space_cells(rows, 1, new_cells[cells - first_cell : cells - first_cell + CORNERS])
            used, cells, rows = used + 1, cells + CORNERS, rows + 6
            continue
        cell_map.numbers[slot] = cells
        facet_corners(px, py, pz, nx, ny, nz, kind, scale, corners)
        for c in range(4):
            at = slot_of(row_map.keys, corners[c])
            if row_map.keys[at] != corners[c]:
                row_map.keys[at], row_map.numbers[at] = corners[c], rows
                wanted[used], first_row[used] = corners[c], rows
                used, rows = used + 1, rows + 1
            new_cells[cells - first_cell, c] = row_map.numbers[at]
        cells += 1
    return used, cells, rows


@nb.njit(cache=True)
def space_cells(first, down, cells):
    """The eight cells of a point whose probes face `AXES` from row ``first`` on; the last if ``down``."""
    for k in range(CORNERS):
        x, y = first + (2 if k & 1 else 1), first + (4 if k & 2 else 3)
        z = first if not k & 4 else (first + 5 if down else x)
        cells[k, 0], cells[k, 1], cells[k, 2], cells[k, 3] = z, x, y, y


@nb.njit(nogil=True, cache=True, error_model="numpy")
def look_up(start, stop, seen, where, known, heights, out, unknown):
    """Look up surfaces ``start`` to ``stop``: cell, place in it, sky view, and what of that is its own."""
    asked = np.empty(_STEP, np.int64), np.empty(_STEP, np.int64), np.empty(_STEP, np.int8)
    _look_up_all(start, stop, seen, where, known, heights, asked, out, unknown)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _look_up_all(start, stop, seen, where, known, heights, asked, out, unknown):
    """`look_up`, with room for the key, number and way of each cell that is asked for in a step."""
    cell_map, (_, found, ways) = known[0], asked
    for first in range(start, stop, _STEP):
        last = min(first + _STEP, stop)
        for i in range(first, last):
            _ask(i, i - first, seen, where, asked, out)
        _number(last - first, cell_map, known[1], asked)
        for i in range(first, last):
            if found[i - first] >= 0:
                _read(i, found[i - first], ways[i - first], known, out)
            unknown[i] |= found[i - first] == _UNKNOWN
        for i in range(first, last):
            if out[3][i] < 0:
                _scale(i, seen, heights, out)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _ask(i, k, seen, where, asked, out):
    """Which cell a surface asks for: its key or, on a vehicle, its number, and which way it is read."""
    box, window, scale = where
    keys, found, ways = asked
    cell, part, view, here = out
    m, instance = seen.material[i], seen.instance[i]
    nx, ny, nz = float(seen.normal[i, 0]), float(seen.normal[i, 1]), float(seen.normal[i, 2])
    cell[i], part[i, 0], part[i, 1], view[i], here[i] = OPEN, 0, 0, 1.0, 1.0
    px, py, pz = float(seen.point[i, 0]), float(seen.point[i, 1]), float(seen.point[i, 2])
    inside = box[0, 0] <= px <= box[1, 0] and box[0, 1] <= py <= box[1, 1]
    keys[k], found[k], ways[k] = EMPTY, OPEN, 0
    if m < 0 or not inside or pz > box[1, 2]:
        return
    if instance >= 0 and seen.role[instance] >= BY_SIDES:  # by its own axes
        t = seen.transforms[instance]
        bx = t[0, 0] * nx + t[1, 0] * ny + t[2, 0] * nz
        by = t[0, 1] * nx + t[1, 1] * ny + t[2, 1] * nz
        bz = t[0, 2] * nx + t[1, 2] * ny + t[2, 2] * nz
        scaled = 1.0 / np.sqrt(bx * bx + by * by + bz * bz)
        found[k] = seen.body[instance]
        nx, ny, nz = bx * scaled, by * scaled, bz * scaled
        if found[k] < 0:
            return
        if seen.role[instance] == BY_HALVES and pz > seen.middle[instance, 2]:
            found[k] += CORNERS
    else:
        volume = _in_space(seen, instance, m)
        kind, found[k] = _kind(px, py, window, volume), _ASKED
        if not volume:
            keys[k], fx, fy = facet_cell(px, py, pz, nx, ny, nz, kind, scale)
            part[i, 0], part[i, 1] = np.uint8(255 * fx + 0.5), np.uint8(255 * fy + 0.5)
            ways[k] = _UPWARD_FACET if kind == FACET and nz > _UPWARD else _ANY_FACET
            return
        keys[k] = volume_key(*_sunk(seen, instance, px, py, pz), kind, scale)
    ways[k] = (1 if nx < 0 else 0) + (2 if ny < 0 else 0) + (4 if nz < 0 else 0)
    level = nx * nx + nz * nz
    part[i, 0] = np.uint8(255 * nx * nx / level + 0.5) if level > 1e-9 else 0
    part[i, 1] = np.uint8(255 * ny * ny + 0.5)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _number(count, cell_map, cells, asked):
    """Number of each cell that is asked for by key, `_UNKNOWN` if there is none."""
    keys, found, _ = asked
    key, number = np.int64(EMPTY), np.int64(_UNKNOWN)  # of the last
    for k in range(count):
        if found[k] == _ASKED:
            if keys[k] != key:
                key = keys[k]
                slot = slot_of(cell_map.keys, key)
                number = np.int64(cell_map.numbers[slot]) if cell_map.keys[slot] == key else _UNKNOWN
            found[k] = number


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _read(i, found, way, known, out):
    """Cell and sky view; of a surface that the map may know ``here`` is what leaves leave, below 0."""
    _, cells, views, past_leaves = known
    cell, part, view, here = out
    if way < CORNERS:
        cell[i] = SPACE - (found + way)
        view[i] = blended_view(cells, found + way, part[i, 0], part[i, 1], views)
        return
    cell[i] = found
    among, leaves = _blended(cells, found, part[i, 0], part[i, 1], views, past_leaves)
    view[i] = among
    if way == _UPWARD_FACET and among > _LEAST_SEEN:
        here[i] = -max(leaves, _LEAST_LEFT)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _scale(i, seen, heights, out):
    """Bring the sky view of a surface to the very place, by the map of heights and what leaves leave."""
    view, here = out[2], out[3]
    px, py, pz = float(seen.point[i, 0]), float(seen.point[i, 1]), float(seen.point[i, 2])
    nx, ny, nz = float(seen.normal[i, 0]), float(seen.normal[i, 1]), float(seen.normal[i, 2])
    solids, leaves, among = view_of_solids(heights, px, py, pz, nx, ny, nz), -here[i], view[i]
    here[i] = 1.0
    if solids >= 0:
        here[i] = min(solids * leaves / among, _MOST_HERE)
        view[i] = here[i] * among


@nb.njit(cache=True, forceinline=True)
def blended_view(cells, cell, across, along, views):
    """Sky view factor of a place in a cell, without probes that no light reaches; 0 if none is left."""
    return _blended(cells, cell, across, along, views, views)[0]


@nb.njit(cache=True, forceinline=True)
def _blended(cells, cell, across, along, views, values):
    """Sky view factor and another value of a place in a cell, from the probes that light reaches."""
    fx, fy = across / 255.0, along / 255.0
    total, seen, other = 0.0, 0.0, 0.0
    for c in range(4):
        row = cells[cell, c]
        one = views[row]
        if one >= 0:
            weight = max((fx if c & 1 else 1 - fx) * (fy if c >> 1 else 1 - fy), 1e-3)
            total += weight
            seen += weight * one
            other += weight * values[row]
    return (seen / total, other / total) if total > 0 else (0.0, 0.0)
