"""Kernels of `light_buffer`: which faces reach over which cell, and what light a point gets past them.

A record holds a face as two planes of barycentric coordinates and one of height toward the sun over its
block, the part of it that is holes, and its highest corner: u = r₀x + r₁y + r₂, v = r₃x + r₄y + r₅,
h = r₆x + r₇y + r₈, gap r₉, top r₁₀. Coordinates start at the block's middle: single precision is a few µm.
"""

import numba as nb
import numpy as np

from glintrack.render.rays.foliage import LEAST_LIGHT

UNKNOWN, WANTED = -1, -2  # of a block's index
BLOCK_CELLS = 32  # along a block's side
RECORD_WORDS = 12  # three quarters of a cache line
_TILE = 16  # points in a square of so many read the same lists
_WIDER_M = 1e-3  # faces count for the cells that they miss by less
_ABOVE_M = 1e-4  # a cell's top lies above its faces by this, for what single precision rounds off
_double = np.float64  # in compiled code `float` leaves a float32 as it is


@nb.njit(nogil=True, cache=True)
def find_light(start, stop, points, wanted, width, frame, lists, moving, light, below, missing):
    """Light at the points of some rows of ``width``; see `LightBuffer.light`.

    Points that do not clear their cell's top are kept for a second loop: the first waits less for memory.
    """
    heads, entries, records = lists[1], lists[3], lists[4]
    kept_index, kept_head = (
        np.empty((stop - start) * _TILE, np.int64),
        np.empty((stop - start) * _TILE, np.int64),
    )
    kept_place = np.empty((kept_index.size, 3), np.float32)
    kept = kept_index, kept_head, kept_place
    for first in range(0, width, _TILE):
        count = 0
        for row in range(start, stop):
            begin, end = row * width + first, min(row * width + min(first + _TILE, width), wanted.size)
            count = _find_cells(
                begin, end, points, wanted, frame, lists, moving, light, below, missing, kept, count
            )
        for k in range(count):
            i, head = kept_index[k], kept_head[k]
            light[i] = _past(
                entries,
                heads[head],
                heads[head + 1],
                records,
                kept_place[k, 0],
                kept_place[k, 1],
                kept_place[k, 2],
            )


@nb.njit(cache=True, fastmath={"contract"})
def _find_cells(begin, end, points, wanted, frame, lists, moving, light, below, missing, kept, count):
    """Light at points that clear their cell's top; the others are added to the ``count`` that are kept."""
    axes, origin, block_m, index = frame
    moving_start, moving_list, boxes = moving
    first_head, _, tops, _, _ = lists
    kept_index, kept_head, kept_place = kept
    inverse, half, cell = 1.0 / block_m, 0.5 * block_m, BLOCK_CELLS / block_m
    columns, rows, last = index.shape[0], index.shape[1], BLOCK_CELLS - 1
    for i in range(begin, end):
        light[i], below[i] = 0.0, False
        if not wanted[i]:
            continue
        px, py, pz = _double(points[i, 0]), _double(points[i, 1]), _double(points[i, 2])
        x = axes[0, 0] * px + axes[0, 1] * py + axes[0, 2] * pz - origin[0]
        y = axes[1, 0] * px + axes[1, 1] * py + axes[1, 2] * pz - origin[1]
        height = np.float32(axes[2, 0] * px + axes[2, 1] * py + axes[2, 2] * pz)
        a, b = np.int64(np.floor(x * inverse)), np.int64(np.floor(y * inverse))
        near_a, near_b = min(max(a, 0), columns - 1), min(max(b, 0), rows - 1)
        near = near_a * rows + near_b
        if moving_start[near] < moving_start[near + 1]:
            below[i] = _is_below(x, y, height, near, moving_start, moving_list, boxes)
        light[i] = 1.0
        if a != near_a or b != near_b:
            continue  # nothing that stands reaches there
        block = index[near_a, near_b]
        if block < 0:
            index[near_a, near_b] = WANTED
            missing[0] = 1
            continue
        x -= a * block_m
        y -= b * block_m
        at = first_head[block] + min(int(x * cell), last) * BLOCK_CELLS + min(int(y * cell), last)
        u, v = np.float32(x - half), np.float32(y - half)
        if tops[at, 0] * u + tops[at, 1] * v + tops[at, 2] > height:
            kept_index[count], kept_head[count] = i, at
            kept_place[count, 0], kept_place[count, 1], kept_place[count, 2] = u, v, height
            count += 1
    return count


@nb.njit(cache=True, forceinline=True)
def _is_below(x, y, height, block, starts, listed, boxes):
    """Whether a point may lie under something that moves."""
    for k in range(starts[block], starts[block + 1]):
        box = listed[k]
        if boxes[box, 0] <= x <= boxes[box, 2] and boxes[box, 1] <= y <= boxes[box, 3]:
            if height < boxes[box, 4]:
                return True
    return False


@nb.njit(cache=True, fastmath={"contract"}, forceinline=True)
def _past(entries, start, stop, records, x, y, height):
    """Light past the faces of a list, highest first, that lie above a point."""
    light, one, least = np.float32(1.0), np.float32(1.0), np.float32(LEAST_LIGHT)
    for k in range(np.uint32(start), np.uint32(stop)):
        r = np.uint32(entries[k])  # unsigned: an index that may be negative costs as much as the arithmetic
        if records[r, 10] <= height:
            break
        u = records[r, 0] * x + records[r, 1] * y + records[r, 2]
        v = records[r, 3] * x + records[r, 4] * y + records[r, 5]
        above = records[r, 6] * x + records[r, 7] * y + records[r, 8] - height
        if min(min(u, v), min(one - (u + v), above)) >= 0:
            light *= records[r, 9]
            if light < least:
                return np.float32(0.0)
    return light


@nb.njit(nogil=True, cache=True)
def list_boxes(first, last, shape):
    """For each block where its list starts, and the lists: boxes that reach from ``first`` to ``last``."""
    starts = np.zeros(shape[0] * shape[1] + 1, np.int64)
    for k in range(first.shape[0]):
        for a in range(first[k, 0], last[k, 0] + 1):
            for b in range(first[k, 1], last[k, 1] + 1):
                starts[a * shape[1] + b + 1] += 1
    for block in range(starts.size - 1):
        starts[block + 1] += starts[block]
    cursor, listed = starts.copy(), np.empty(starts[-1], np.int64)
    for k in range(first.shape[0]):
        for a in range(first[k, 0], last[k, 0] + 1):
            for b in range(first[k, 1], last[k, 1] + 1):
                listed[cursor[a * shape[1] + b]] = k
                cursor[a * shape[1] + b] += 1
    return starts, listed


@nb.njit(nogil=True, cache=True)
def count_cells(start, stop, wanted, frame, scene, lists, counts, records):
    """Faces over each cell of wanted blocks, and records of each block."""
    nothing = np.empty((0, RECORD_WORDS), np.float32), np.empty(0, np.int32)
    for k in range(start, stop):
        records[k] = _cover(wanted[k, 0], wanted[k, 1], frame, scene, lists, counts[k], 0, nothing)


@nb.njit(nogil=True, cache=True)
def fill_cells(start, stop, wanted, frame, scene, lists, counts, heads_at, entries_at, records_at, out):
    """Write what `count_cells` counted; ``out`` holds heads, tops, entries and records of all blocks."""
    heads, tops, entries, records = out
    for k in range(start, stop):
        cursor, at, first = counts[k], entries_at[k], heads_at[k]
        for cell in range(cursor.size):
            heads[first + cell] = at
            count = cursor[cell]
            cursor[cell] = at
            at += count
        heads[first + cursor.size] = at
        base = records_at[k]
        used = _cover(wanted[k, 0], wanted[k, 1], frame, scene, lists, cursor, base, (records, entries))
        for cell in range(cursor.size):
            start_at, stop_at = heads[first + cell], heads[first + cell + 1]
            _sort(entries, start_at, stop_at, records)
            _set_top(cell, frame[2], entries[start_at:stop_at], records, tops[first + cell])
        _gather(entries[entries_at[k] : at], records[base : base + used], base)


@nb.njit(cache=True)
def _gather(entries, records, base):
    """Put a block's records in the order in which its cells list them: those of one cell lie together."""
    before, place = records.copy(), np.full(records.shape[0], -1, np.int64)
    used = 0
    for k in range(entries.size):
        old = entries[k] - base
        if place[old] < 0:
            place[old] = used
            records[used] = before[old]
            used += 1
        entries[k] = base + place[old]


@nb.njit(cache=True)
def _set_top(cell, block_m, listed, records, top):
    """A plane that no face of a cell rises above, as low as it gets with one of three faces' slopes."""
    side = block_m / BLOCK_CELLS
    x, y = cell // BLOCK_CELLS * side - 0.5 * block_m, cell % BLOCK_CELLS * side - 0.5 * block_m
    top[0], top[1], top[2] = 0.0, 0.0, -np.inf
    least = np.inf
    for candidate in range(min(listed.size, 3)):
        gx, gy = records[listed[candidate], 6], records[listed[candidate], 7]
        lowest = gx * x + gy * y + (min(gx, 0.0) + min(gy, 0.0)) * side  # the slope's own, over the cell
        shift = -np.inf
        for k in listed:
            ex, ey = records[k, 6] - gx, records[k, 7] - gy
            high = ex * x + ey * y + (max(ex, 0.0) + max(ey, 0.0)) * side + records[k, 8]
            shift = max(shift, min(high, records[k, 10] - lowest))
        middle = shift + gx * (x + 0.5 * side) + gy * (y + 0.5 * side)
        if middle < least:
            least = middle
            top[0], top[1], top[2] = gx, gy, shift + _ABOVE_M


@nb.njit(cache=True)
def _sort(entries, start, stop, records):
    """Highest first."""
    for k in range(start + 1, stop):
        entry, place = entries[k], k
        while place > start and records[entries[place - 1], 10] < records[entry, 10]:
            entries[place] = entries[place - 1]
            place -= 1
        entries[place] = entry


@nb.njit(cache=True)
def _cover(column, row, frame, scene, lists, cells, first_record, out):
    """Go over the faces of a block: count those of each cell, or write them where ``cells`` points to.

    Returns the number of records.
    """
    axes, origin, block_m, rows = frame
    mesh_start, transforms, meshes = scene[3:]
    (static_start, static_list), (instance_start, instance_list) = lists
    block = column * rows + row
    shift = np.array([origin[0] + (column + 0.5) * block_m, origin[1] + (row + 0.5) * block_m, 0.0])
    room = np.empty((3, 3)), np.empty((3, 3))
    placed, used = np.empty((3, 4)), first_record
    placed[:, :3], placed[:, 3] = axes, -shift
    for k in range(static_start[block], static_start[block + 1]):
        used += _cover_face(static_list[k], placed, scene, block_m, room, cells, used, out)
    for k in range(instance_start[block], instance_start[block + 1]):
        instance = instance_list[k]
        for i in range(3):
            for j in range(4):
                placed[i, j] = -shift[i] if j == 3 else 0.0
                for c in range(3):
                    placed[i, j] += axes[i, c] * transforms[instance, c, j]
        for face in range(mesh_start[meshes[instance]], mesh_start[meshes[instance] + 1]):
            used += _cover_face(face, placed, scene, block_m, room, cells, used, out)
    return used - first_record


@nb.njit(cache=True)
def _cover_face(face, placed, scene, block_m, room, cells, record, out):
    """Count or write one face in the cells of a block that it reaches over; whether there are any."""
    vertices, corners, gaps = scene[:3]
    flat, edges = room
    half, cell_m = 0.5 * block_m, block_m / BLOCK_CELLS
    for c in range(3):
        _see(vertices[corners[face, c]], placed, flat[c])
    first_x, last_x = _reach(flat[:, 0], half, cell_m)
    first_y, last_y = _reach(flat[:, 1], half, cell_m)
    if first_x > last_x or first_y > last_y or not _set_edges(flat, edges):
        return 0
    records, entries = out
    found = 0
    for a in range(first_x, last_x + 1):
        for b in range(first_y, last_y + 1):
            if _touches(edges, a * cell_m - half, b * cell_m - half, cell_m):
                found = 1
                at = cells[a * BLOCK_CELLS + b]
                cells[a * BLOCK_CELLS + b] = at + 1
                if entries.size > 0:
                    entries[at] = record
    if found and entries.size > 0:
        _set_record(flat, gaps[face], records[record])
    return found


@nb.njit(cache=True, forceinline=True)
def _see(point, placed, out):
    """A point along the sun's axes, from the block's middle."""
    px, py, pz = _double(point[0]), _double(point[1]), _double(point[2])
    for i in range(3):
        out[i] = placed[i, 0] * px + placed[i, 1] * py + placed[i, 2] * pz + placed[i, 3]


@nb.njit(cache=True)
def _reach(ends, half, cell_m):
    """First and last cell of a block along one axis that corners reach over."""
    low = (min(min(ends[0], ends[1]), ends[2]) - _WIDER_M + half) / cell_m
    high = (max(max(ends[0], ends[1]), ends[2]) + _WIDER_M + half) / cell_m
    return int(max(np.floor(low), 0.0)), int(min(np.floor(high), BLOCK_CELLS - 1.0))


@nb.njit(cache=True)
def _set_edges(flat, edges):
    """Lines along a face's edges, x and y parts and shift, positive inside; whether it has any area."""
    area = (flat[1, 0] - flat[0, 0]) * (flat[2, 1] - flat[0, 1])
    area -= (flat[2, 0] - flat[0, 0]) * (flat[1, 1] - flat[0, 1])
    if area == 0:
        return False
    sign = 1.0 if area > 0 else -1.0
    for k in range(3):
        a, b = flat[k], flat[(k + 1) % 3]
        x, y = -sign * (b[1] - a[1]), sign * (b[0] - a[0])
        edges[k, 0], edges[k, 1] = x, y
        edges[k, 2] = -(x * a[0] + y * a[1]) + _WIDER_M * (abs(x) + abs(y))
    return True


@nb.njit(cache=True, forceinline=True)
def _touches(edges, x, y, side):
    """Whether no edge has a square wholly on its outer side."""
    for k in range(3):
        far = max(edges[k, 0], 0.0) + max(edges[k, 1], 0.0)
        if edges[k, 0] * x + edges[k, 1] * y + far * side + edges[k, 2] < 0:
            return False
    return True


@nb.njit(cache=True)
def _set_record(flat, gap, record):
    """Planes of a face's barycentric coordinates and of its height over the block's middle."""
    ax, ay = flat[0, 0], flat[0, 1]
    ex, ey, fx, fy = flat[1, 0] - ax, flat[1, 1] - ay, flat[2, 0] - ax, flat[2, 1] - ay
    inverse = 1.0 / (ex * fy - fx * ey)
    ux, uy, vx, vy = fy * inverse, -fx * inverse, -ey * inverse, ex * inverse
    e, f = flat[1, 2] - flat[0, 2], flat[2, 2] - flat[0, 2]
    record[0], record[1], record[2] = ux, uy, -(ux * ax + uy * ay)
    record[3], record[4], record[5] = vx, vy, -(vx * ax + vy * ay)
    hx, hy = e * ux + f * vx, e * uy + f * vy
    record[6], record[7], record[8] = hx, hy, flat[0, 2] - (hx * ax + hy * ay)
    record[9] = gap
    record[10] = max(max(flat[0, 2], flat[1, 2]), flat[2, 2])


@nb.njit(nogil=True, cache=True)
def bound_faces(vertices, corners, axes, low, high):
    """Boxes of faces along the sun's axes."""
    placed = np.zeros((3, 4))
    placed[:, :3] = axes
    seen = np.empty(3)
    for face in range(low.shape[0]):
        low[face], high[face] = np.inf, -np.inf
        for c in range(3):
            _see(vertices[corners[face, c]], placed, seen)
            for i in range(3):
                low[face, i], high[face, i] = min(low[face, i], seen[i]), max(high[face, i], seen[i])
