"""ProbePlaces of probes: a sparse lattice of any extent, addressed by hash, on the surfaces that ask for it.

A facet asks the four lattice points around it, carried along the axis its normal is nearest to onto its own
plane: a probe then stands on the surface, not in the air beside it. Trees and hedges ask the one nearest in
space. The key of a probe holds its kind, the node of its normal (`sky`) and the place in steps of the
lattice, the key of a cell is mixed from those of its four probes: what is found does not depend on who
asked first. Beyond the scene's window, where only the margin's houses and trees rise, steps are twice as
long.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.render.light.heights import view_of_solids
from glintrack.render.light.sky import LEVEL_NODE, NORMAL_NODES, node_normals, on_square

FACET, FAR_FACET, VOLUME, FAR_VOLUME = range(4)  # kinds: on a facet, in a crown; each beyond the window
STEPS_M = np.array([2.0, 4.0, 2.0, 4.0])  # of the lattice, by kind
RISE_M = np.array([0.5, 0.5, 1.0, 2.0])  # steps of the third coordinate
LIFT_M = 0.3  # off the facet: over kerbs, and over the rounding of the third coordinate
_MIXED_BY, _MARK = np.uint64(0x9E3779B97F4A7C15), np.uint64(1 << 63)  # keys of cells are negative
_NEARLY_LEVEL = 0.97  # upward component of normals that are taken as level: roads, lawns
_HALF, _BITS = 1 << 15, 16  # lattice coordinates −32768 to 32767: 130 km
_CLASS_BITS = 11
EMPTY = -1
_SHIFT = np.array([0.31, 0.43, 0.13])  # of a step: walls on whole metres lie between lattice points


class ProbeMap(NamedTuple):
    """Open addressing: ``keys`` [1] and the number of each; capacity a power of two."""

    keys: Int[Array, "slot"]
    numbers: Int[Array, "slot"]


class ProbePlaces(NamedTuple):
    """Where probes are: centre [m], node of the normal faced, kind, and which set of directions."""

    centre: Float[Array, "probe 3"]
    facing: Int[Array, "probe"]
    kind: Int[Array, "probe"]
    set: Int[Array, "probe"]


def empty_map(capacity: int) -> ProbeMap:
    """A map without probes."""
    return ProbeMap(np.full(capacity, EMPTY, np.int64), np.full(capacity, EMPTY, np.int32))


_MAIN_AXIS = np.argmax(np.abs(node_normals()) * [1.0, 1.0, 1.0001], axis=1)


@nb.njit(cache=True)
def slot_of(keys, key):
    """Slot that holds the key, or the free one where it would go."""
    last = keys.size - 1
    mixed = np.uint64(key) * _MIXED_BY
    slot = np.int64(mixed >> np.uint64(40)) & last
    while keys[slot] != key and keys[slot] != EMPTY:
        slot = (slot + 1) & last
    return slot


@nb.njit(cache=True)
def node_of_normal(nx, ny, nz):
    """The node of `node_normals` next to a unit vector; that of level ground for what is nearly level."""
    if nz > _NEARLY_LEVEL:
        return LEVEL_NODE
    x, y = on_square(nx, ny, nz, NORMAL_NODES)
    return int(x + 0.5) * NORMAL_NODES + int(y + 0.5)


@nb.njit(cache=True)
def _key(kind, facing, a, b, c):
    key = np.int64((kind << _CLASS_BITS) | facing)
    for place in (a, b, c):
        bounded = min(max(np.int64(place) + _HALF, 0), 2 * _HALF - 1)
        key = (key << _BITS) | bounded
    return key


@nb.njit(cache=True)
def volume_key(px, py, pz, kind, scale):
    """Key of the probe in a crown that is nearest to a point."""
    step, rise = STEPS_M[kind] * scale, RISE_M[kind] * scale
    a, b = math.floor(px / step - _SHIFT[0] + 0.5), math.floor(py / step - _SHIFT[1] + 0.5)
    return _key(kind, 0, a, b, math.floor(pz / rise - _SHIFT[2] + 0.5))


@nb.njit(cache=True)
def facet_cell(px, py, pz, nx, ny, nz, kind, scale):
    """Key of the cell around a point of a facet, by all its four probes, and its place there (0 to 1)."""
    facing, u, v, w, nu, nv, nw = _carried(px, py, pz, nx, ny, nz)
    step = STEPS_M[kind] * scale
    x, y = u / step - _SHIFT[0], v / step - _SHIFT[1]
    i, j = math.floor(x), math.floor(y)
    key = np.uint64(0)
    for corner in range(4):
        one = _corner(kind, facing, i + (corner & 1), j + (corner >> 1), u, v, w, nu, nv, nw, scale)
        key = (key ^ np.uint64(one)) * _MIXED_BY
        key ^= key >> np.uint64(29)
    return np.int64(key | _MARK), x - i, y - j


@nb.njit(cache=True)
def facet_corners(px, py, pz, nx, ny, nz, kind, scale, keys):
    """Keys of the four probes around a point of a facet."""
    facing, u, v, w, nu, nv, nw = _carried(px, py, pz, nx, ny, nz)
    step = STEPS_M[kind] * scale
    i, j = math.floor(u / step - _SHIFT[0]), math.floor(v / step - _SHIFT[1])
    for corner in range(4):
        a, b = i + (corner & 1), j + (corner >> 1)
        keys[corner] = _corner(kind, facing, a, b, u, v, w, nu, nv, nw, scale)


@nb.njit(cache=True, forceinline=True)
def _carried(px, py, pz, nx, ny, nz):
    """Node of a normal, and place and normal with the axis last that it is nearest to."""
    facing = node_of_normal(nx, ny, nz)
    along = _MAIN_AXIS[facing]
    if along == 2:
        return facing, px, py, pz, nx, ny, nz
    if along == 0:
        return facing, py, pz, px, ny, nz, nx
    return facing, pz, px, py, nz, nx, ny


@nb.njit(cache=True, forceinline=True)
def _corner(kind, facing, a, b, u, v, w, nu, nv, nw, scale):
    """Key of a lattice point on a facet's plane."""
    step = STEPS_M[kind] * scale
    height = w - (nu * ((a + _SHIFT[0]) * step - u) + nv * ((b + _SHIFT[1]) * step - v)) / nw
    return _key(kind, facing, a, b, math.floor(height / (RISE_M[kind] * scale) - _SHIFT[2] + 0.5))


def kind_of(keys: Int[Array, "probe"]) -> Int[Array, "probe"]:
    """Kinds of the probes of some keys."""
    return keys >> (3 * _BITS + _CLASS_BITS)


def places_of(keys: Int[Array, "probe"], scale: float) -> ProbePlaces:
    """Where the probes of some keys are, lifted off their facets."""
    mask = (1 << _BITS) - 1
    place = np.stack([((keys >> (_BITS * k)) & mask) - _HALF for k in (2, 1, 0)], axis=1)
    facing = (keys >> (3 * _BITS)) & ((1 << _CLASS_BITS) - 1)
    kind = kind_of(keys)
    on_facet = kind <= FAR_FACET
    size = scale * np.stack([STEPS_M[kind], STEPS_M[kind], RISE_M[kind]], axis=1)
    centre = (place + _SHIFT) * size
    along = np.where(on_facet, _MAIN_AXIS[facing], 2)
    for axis, order in ((0, (2, 0, 1)), (1, (1, 2, 0))):  # (u, v, w) is (y, z, x) or (z, x, y)
        centre[along == axis] = centre[along == axis][:, order]
    centre += max(LIFT_M, 0.6 * scale * 0.5) * np.where(on_facet[:, None], node_normals()[facing], 0.0)
    parity = (place[:, 0] & 1) | (place[:, 1] & 1) << 1
    return ProbePlaces(centre.astype(np.float32), facing, kind, parity)


OPEN = -1  # cell of a surface beyond all that rises, which sees the whole sky
SPACE = -2  # cells of points in space are counted down from here, so that they are told from facets'
AS_FACETS, IN_SPACE, BY_SIDES, BY_HALVES = range(4)  # roles of instances: as facets, trees, vehicles
LONG_M = 7.0  # vehicles whose sides have an upper and a lower half
CORNERS = 8  # cells of a point in space, by the signs of a normal's components
_SUNK_M = 0.6  # into a crown
_UPWARD = 0.5  # upward component of normals whose sky view the map of heights knows
_LEAST_SEEN, _MOST_HERE = 0.02, 4.0  # of what probes see of the sky, and how much more a place among them may
_LEAST_LEFT = 1e-6  # by leaves, of a surface that the map may know


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
    for i in range(start, stop):
        unknown[i] = not _look_up_one(i, seen, where, known, heights, out)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _look_up_one(i, seen, where, known, heights, out):
    """Look up one surface; returns whether its cell is known."""
    box, window, scale = where
    cell_map, cells, views, past_leaves = known
    cell, part, view, here = out
    m, instance = seen.material[i], seen.instance[i]
    nx, ny, nz = float(seen.normal[i, 0]), float(seen.normal[i, 1]), float(seen.normal[i, 2])
    px, py, pz = float(seen.point[i, 0]), float(seen.point[i, 1]), float(seen.point[i, 2])
    cell[i], part[i, 0], part[i, 1], view[i], here[i] = OPEN, 0, 0, 1.0, 1.0
    inside = box[0, 0] <= px <= box[1, 0] and box[0, 1] <= py <= box[1, 1]
    if m < 0 or not inside or pz > box[1, 2]:
        return True
    if instance >= 0 and seen.role[instance] >= BY_SIDES:  # by its own axes
        found = np.int64(seen.body[instance])
        if found < 0:
            return True
        t = seen.transforms[instance]
        bx = t[0, 0] * nx + t[1, 0] * ny + t[2, 0] * nz
        by = t[0, 1] * nx + t[1, 1] * ny + t[2, 1] * nz
        bz = t[0, 2] * nx + t[1, 2] * ny + t[2, 2] * nz
        scaled = 1.0 / np.sqrt(bx * bx + by * by + bz * bz)
        nx, ny, nz = bx * scaled, by * scaled, bz * scaled
        if seen.role[instance] == BY_HALVES and pz > seen.middle[instance, 2]:
            found += CORNERS
    elif _in_space(seen, instance, m):
        kind = _kind(px, py, window, True)
        found = _number_of(cell_map, volume_key(*_sunk(seen, instance, px, py, pz), kind, scale))
    else:
        kind = _kind(px, py, window, False)
        key, fx, fy = facet_cell(px, py, pz, nx, ny, nz, kind, scale)
        part[i, 0], part[i, 1] = np.uint8(255 * fx + 0.5), np.uint8(255 * fy + 0.5)
        found = _number_of(cell_map, key)
        if found < 0:
            return False
        cell[i] = found
        among, leaves = _blended(cells, found, part[i, 0], part[i, 1], views, past_leaves)
        view[i] = among
        if kind == FACET and nz > _UPWARD and among > _LEAST_SEEN:
            solids = view_of_solids(heights, px, py, pz, nx, ny, nz)
            if solids >= 0:  # the map of heights and what leaves leave bring it to the very place
                here[i] = min(solids * np.float32(max(leaves, _LEAST_LEFT)) / view[i], _MOST_HERE)
                view[i] = here[i] * view[i]
        return True
    if found < 0:
        return False
    found += (1 if nx < 0 else 0) + (2 if ny < 0 else 0) + (4 if nz < 0 else 0)
    level = nx * nx + nz * nz
    part[i, 0] = np.uint8(255 * nx * nx / level + 0.5) if level > 1e-9 else 0
    part[i, 1] = np.uint8(255 * ny * ny + 0.5)
    cell[i] = SPACE - found
    view[i] = blended_view(cells, found, part[i, 0], part[i, 1], views)
    return True


@nb.njit(cache=True, forceinline=True)
def _number_of(cell_map, key):
    """Number of the cell of a key; −1 if there is none."""
    slot = slot_of(cell_map.keys, key)
    return np.int64(cell_map.numbers[slot]) if cell_map.keys[slot] == key else np.int64(-1)


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
