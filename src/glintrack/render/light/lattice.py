"""Places of probes: a sparse lattice of any extent, addressed by hash, on the surfaces in view.

A facet uses the four lattice points around it, projected onto its own plane along the axis nearest to its
normal, so that a probe stands on the surface. Trees and hedges use the nearest point in space. The key of a
probe holds its kind, the node of its normal (`sky`) and its place in steps of the lattice. The key of a cell
is mixed from those of its four probes, so that the result does not depend on the order of look-ups. Beyond
the scene's window, with only the margin's houses and trees, steps are twice as long.
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
    """Centre [m], node of the normal, kind, and number of the set of directions of probes."""

    centre: Float[Array, "probe 3"]
    facing: Int[Array, "probe"]
    kind: Int[Array, "probe"]
    set: Int[Array, "probe"]


def empty_map(capacity: int) -> ProbeMap:
    """Allocate a map without probes."""
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
    """Node of `node_normals` next to a unit vector; the level node for nearly level facets."""
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
    """Key of the probe in space that is nearest to a point."""
    step, rise = STEPS_M[kind] * scale, RISE_M[kind] * scale
    a, b = math.floor(px / step - _SHIFT[0] + 0.5), math.floor(py / step - _SHIFT[1] + 0.5)
    return _key(kind, 0, a, b, math.floor(pz / rise - _SHIFT[2] + 0.5))


@nb.njit(cache=True, forceinline=True)
def facet_corners(px, py, pz, nx, ny, nz, kind, scale):
    """Keys of the four probes around a point of a facet, and its place between them (0 to 1)."""
    facing = node_of_normal(nx, ny, nz)
    u, v, w, nu, nv, nw = px, py, pz, nx, ny, nz
    if _MAIN_AXIS[facing] == 0:
        u, v, w, nu, nv, nw = py, pz, px, ny, nz, nx
    elif _MAIN_AXIS[facing] == 1:
        u, v, w, nu, nv, nw = pz, px, py, nz, nx, ny
    step, rise = STEPS_M[kind] * scale, RISE_M[kind] * scale
    x, y = u / step - _SHIFT[0], v / step - _SHIFT[1]
    i, j = math.floor(x), math.floor(y)
    place = u, v, w, nu, nv, nw
    corners = (
        _corner(kind, facing, i, j, place, step, rise),
        _corner(kind, facing, i + 1, j, place, step, rise),
        _corner(kind, facing, i, j + 1, place, step, rise),
        _corner(kind, facing, i + 1, j + 1, place, step, rise),
    )
    return corners, x - i, y - j


@nb.njit(cache=True)
def facet_cell(px, py, pz, nx, ny, nz, kind, scale):
    """Key of the cell around a point of a facet, by all its four probes, and its place there (0 to 1)."""
    corners, fx, fy = facet_corners(px, py, pz, nx, ny, nz, kind, scale)
    key = np.uint64(0)
    for corner in corners:
        key = (key ^ np.uint64(corner)) * _MIXED_BY
        key ^= key >> np.uint64(29)
    return np.int64(key | _MARK), fx, fy


@nb.njit(cache=True, forceinline=True)
def _corner(kind, facing, a, b, place, step, rise):
    """Key of a lattice point on a facet's plane."""
    u, v, w, nu, nv, nw = place
    height = w - (nu * ((a + _SHIFT[0]) * step - u) + nv * ((b + _SHIFT[1]) * step - v)) / nw
    return _key(kind, facing, a, b, math.floor(height / rise - _SHIFT[2] + 0.5))


def places_of(keys: Int[Array, "probe"], scale: float) -> ProbePlaces:
    """Find the places of the probes of some keys, lifted off their facets."""
    mask = (1 << _BITS) - 1
    place = np.stack([((keys >> (_BITS * k)) & mask) - _HALF for k in (2, 1, 0)], axis=1)
    facing = (keys >> (3 * _BITS)) & ((1 << _CLASS_BITS) - 1)
    kind = keys >> (3 * _BITS + _CLASS_BITS)
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
SPACE = -2  # cells of points in space are counted down from here
AS_FACETS, IN_SPACE, BY_SIDES, BY_HALVES = range(4)  # roles of instances: as facets, trees, vehicles
LONG_M = 7.0  # shortest vehicle with an upper and a lower half of its sides
CORNERS = 8  # cells of a point in space, by the signs of a normal's components
_SUNK_M = 0.6  # into a crown
_UPWARD = 0.5  # upward component of normals with a sky view in the map of heights
_MIN_VIEW, _MAX_HERE = 0.02, 4.0  # sky view of probes, and that of a place over theirs
_MIN_PAST_LEAVES = 1e-6


@nb.njit(cache=True, forceinline=True)
def _in_space(role, sheets, instance, material):
    """Return True if a surface uses probes in space: trees, hedges, and every leaf card."""
    if instance >= 0 and role[instance] != AS_FACETS:
        return role[instance] == IN_SPACE
    return material >= 0 and material < sheets.size and sheets[material]


@nb.njit(cache=True, forceinline=True)
def _sunk(middle, instance, px, py, pz):
    """Move a point of a crown into it: its visible outside has leaves around."""
    if instance < 0:
        return px, py, pz
    mx, my, mz = middle[instance, 0] - px, middle[instance, 1] - py, middle[instance, 2] - pz
    length = np.sqrt(mx * mx + my * my + mz * mz)
    step = min(_SUNK_M, length) / max(length, 1e-9)
    return px + step * mx, py + step * my, pz + step * mz


@nb.njit(cache=True)
def _kind(px, py, window, volume):
    inside = window[0] <= px <= window[2] and window[1] <= py <= window[3]
    return (VOLUME if volume else FACET) + (0 if inside else 1)


@nb.njit(cache=True)
def add_wanted(rays, seen, where, known, counts, wanted, first_row, new_cells):
    """Assign numbers to every cell and probe that some rays lack.

    Return the number of new probes (−1: more than there is room for), and the next cell and row.
    """
    _, window, scale = where
    cell_map, row_map = known
    rows, first_cell, most = counts
    used, cells = 0, first_cell
    for ray in rays:
        p, n, instance = seen.point[ray], seen.normal[ray], seen.instance[ray]
        px, py, pz = float(p[0]), float(p[1]), float(p[2])
        nx, ny, nz = float(n[0]), float(n[1]), float(n[2])
        volume = _in_space(seen.role, seen.sheets, instance, seen.material[ray])
        kind = _kind(px, py, window, volume)
        if volume:
            key = volume_key(*_sunk(seen.middle, instance, px, py, pz), kind, scale)
        else:
            key = facet_cell(px, py, pz, nx, ny, nz, kind, scale)[0]
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
        corners = facet_corners(px, py, pz, nx, ny, nz, kind, scale)[0]
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
    """Write the eight cells of a point with probes of `AXES` from row ``first`` on; the last if ``down``."""
    for k in range(CORNERS):
        x, y = first + (2 if k & 1 else 1), first + (4 if k & 2 else 3)
        z = first if not k & 4 else (first + 5 if down else x)
        cells[k, 0], cells[k, 1], cells[k, 2], cells[k, 3] = z, x, y, y


@nb.njit(nogil=True, cache=True, error_model="numpy")
def look_up(start, stop, rays, seen, where, known, heights, found, unknown):
    """Look up the cells of surfaces, their places in these, and their sky view; mark the ``unknown`` ones.

    The loop hands on single arrays, for the reason of `pixels.shade_pixels`.
    """
    (box, window, scale), (cell_map, cells, views, past_leaves) = where, known
    point, normal, material, instances, role, body, sheets, transforms, middle = seen
    cell, part, view, here = found
    keys, numbers = cell_map
    for k in range(start, stop):
        i = rays[k]
        m, instance = material[i], instances[i]
        nx, ny, nz = float(normal[i, 0]), float(normal[i, 1]), float(normal[i, 2])
        px, py, pz = float(point[i, 0]), float(point[i, 1]), float(point[i, 2])
        cell[i], part[i, 0], part[i, 1], view[i], here[i] = OPEN, 0, 0, 1.0, 1.0
        inside = box[0, 0] <= px <= box[1, 0] and box[0, 1] <= py <= box[1, 1]
        if m < 0 or not inside or pz > box[1, 2]:
            continue
        if instance >= 0 and role[instance] >= BY_SIDES:  # by its own axes
            at = np.int64(body[instance])
            if at < 0:
                continue
            nx, ny, nz = _on_axes(transforms, instance, nx, ny, nz)
            if role[instance] == BY_HALVES and pz > middle[instance, 2]:
                at += CORNERS
        elif _in_space(role, sheets, instance, m):
            kind = _kind(px, py, window, True)
            at = _number_of(keys, numbers, volume_key(*_sunk(middle, instance, px, py, pz), kind, scale))
        else:
            kind = _kind(px, py, window, False)
            key, fx, fy = facet_cell(px, py, pz, nx, ny, nz, kind, scale)
            part[i, 0], part[i, 1] = np.uint8(255 * fx + 0.5), np.uint8(255 * fy + 0.5)
            at = _number_of(keys, numbers, key)
            unknown[k] = at < 0
            if at < 0:
                continue
            cell[i] = at
            view[i], leaves = _blend(cells, at, part[i, 0], part[i, 1], views, past_leaves)
            if kind == FACET and nz > _UPWARD and view[i] > _MIN_VIEW:
                solids = view_of_solids(heights, px, py, pz, nx, ny, nz)
                if solids >= 0:  # the map of heights and what leaves leave bring it to the very place
                    here[i] = min(solids * np.float32(max(leaves, _MIN_PAST_LEAVES)) / view[i], _MAX_HERE)
                    view[i] = here[i] * view[i]
            continue
        unknown[k] = at < 0
        if at < 0:
            continue
        at += (1 if nx < 0 else 0) + (2 if ny < 0 else 0) + (4 if nz < 0 else 0)
        level = nx * nx + nz * nz
        part[i, 0] = np.uint8(255 * nx * nx / level + 0.5) if level > 1e-9 else 0
        part[i, 1] = np.uint8(255 * ny * ny + 0.5)
        cell[i] = SPACE - at
        view[i] = _blend(cells, at, part[i, 0], part[i, 1], views, views)[0]


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _on_axes(transforms, instance, x, y, z):
    """Components of a unit vector along the axes of an instance."""
    bx = transforms[instance, 0, 0] * x + transforms[instance, 1, 0] * y + transforms[instance, 2, 0] * z
    by = transforms[instance, 0, 1] * x + transforms[instance, 1, 1] * y + transforms[instance, 2, 1] * z
    bz = transforms[instance, 0, 2] * x + transforms[instance, 1, 2] * y + transforms[instance, 2, 2] * z
    scaled = 1.0 / np.sqrt(bx * bx + by * by + bz * bz)
    return bx * scaled, by * scaled, bz * scaled


@nb.njit(cache=True, forceinline=True)
def _number_of(keys, numbers, key):
    """Find the number of a key's cell; −1 for none."""
    slot = slot_of(keys, key)
    return np.int64(numbers[slot]) if keys[slot] == key else np.int64(-1)


@nb.njit(cache=True, forceinline=True)
def _blend(cells, cell, across, along, views, values):
    """Sky view factor and another value of a place in a cell, from the probes that light reaches; else 0."""
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
