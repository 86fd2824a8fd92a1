"""Heights of the fixed scene's solids, and the sky view factor past their horizon at each cell.

A probe's few rays are noisy, and objects smaller than the lattice of probes (a parked car, a parapet) are
between them. The horizon of a map of heights has no noise and is fine, but has no crowns and nothing under
roofs. Both are combined: V = R T, with R the sky view factor past the map's horizon at the very place, and T
the transmittance of leaves for the rest of the sky, from the probes.

Horizons are found along lines of cells in even azimuths. Each line holds the convex hull of the cells
before (Timonen and Westerholm, "Scalable Height Field Self-Shadowing", Computer Graphics Forum 29, 2010).
Above a horizon of tangent t in azimuth φ a facet of normal n gets

    ∫ cos θ dω = s [½π − atan t − t/(1 + t²)] + n_z/(1 + t²),    s = n_x sin φ + n_y cos φ,

times ½ dφ; R is that over the same above the facet's own plane and the level.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.scene import Mesh, Snapshot

CELL_M = 0.33
MAX_CELLS = 6_000_000  # for more, cells are larger
AZIMUTHS = 12
MARGIN_M = 40.0  # around the window: part of the horizon
UNKNOWN = -1.0  # R of a place that the map does not have: under a roof, on a wall, beyond
BLOCK = 16  # cells
RISE_UNIT, VIEW_UNIT = 1 / 1024, 1 / 32767
_NOTHING_M = -1e4
_MAX_STEPS, _STEP_M = 32000, 1e-3  # of heights from their middle, and the least
_FIRST = 0.37  # azimuth of the first line, in steps: off the axes of streets
_NEARER = 0.5  # of a cell: edges are between cells
_LEVEL = 0.02  # square of the slope of cells that are taken as level
_SAME_M, _SAME_SLOPE = 0.06, 0.2  # of a cell and a place on the same facet
_MIN_WEIGHT = 1e-3


class SolidHeights(NamedTuple):
    """A map of heights, rows from south to north.

    Parameters
    ----------
    cells
        Of the highest surface without holes at each cell's centre: height over ``middle_m`` in units of
        ``step_m``, rise to the east and to the north in units of `RISE_UNIT`, and sky view factor past the
        horizon in units of `VIEW_UNIT`.
    tops
        Height of the highest cell of each block of `BLOCK` × `BLOCK`, in the same units.
    corner
        East and north of the map's corner. [m]
    cell_m
        Side of a cell. [m]
    middle_m, step_m
        Of heights. [m]
    sheets
        Materials of leaf cards, which are not in the map.
    """

    cells: Int[Array, "row column 4"]
    tops: Int[Array, "block_row block_column"]
    corner: Float[Array, "2"]
    cell_m: float
    middle_m: float
    step_m: float
    sheets: Bool[Array, "material"]


def no_heights() -> SolidHeights:
    """Return a map without cells."""
    return SolidHeights(
        cells=np.zeros((0, 0, 4), np.int16),
        tops=np.zeros((0, 0), np.int16),
        corner=np.zeros(2),
        cell_m=CELL_M,
        middle_m=0.0,
        step_m=_STEP_M,
        sheets=np.zeros(0, np.bool_),
    )


def solid_heights(
    snapshot: Snapshot, sheets: Bool[Array, "material"], window: tuple[float, float, float, float]
) -> SolidHeights:
    """Map the fixed scene, without materials of ``sheets``, in a window (west, south, east, north) [m]."""
    low = np.array(window[:2]) - MARGIN_M
    size = np.maximum(np.array(window[2:]) + MARGIN_M - low, 0.0)
    cell_m = max(CELL_M, math.sqrt(float(size.prod()) / MAX_CELLS))
    columns, rows = np.ceil(size / cell_m).astype(int)
    drawn = np.zeros((rows, columns, 4), np.float32)
    heights = drawn[..., 0]
    heights[:] = _NOTHING_M
    _draw(snapshot.static.vertices, _solid(snapshot.static, 0, sheets), np.eye(3, 4), low, cell_m, drawn)
    which = np.stack([snapshot.model[: snapshot.fixed], snapshot.paint[: snapshot.fixed]], axis=1)
    for model, paint in np.unique(which, axis=0):
        mesh = snapshot.models[model]
        faces = _solid(mesh, int(paint), sheets)
        for k in np.flatnonzero((which == (model, paint)).all(axis=1)):
            _draw(mesh.vertices, faces, np.asarray(snapshot.transforms[k], float), low, cell_m, drawn)
    toward = _add_sky_view(drawn, cell_m)
    lowest = heights.min(initial=np.inf, where=heights > _NOTHING_M)
    between = heights.max(initial=_NOTHING_M) - lowest
    known = (lowest + 0.5 * between, max(between / (2 * _MAX_STEPS), _STEP_M)) if between >= 0 else (0, 1)
    cells, (middle_m, step_m) = np.empty((rows, columns, 4), np.int16), known
    over_rows(_pack, rows, toward, np.array(known, float), drawn, cells)
    by_row = np.maximum.reduceat(cells[..., 0], np.arange(0, rows, BLOCK), axis=0)
    return SolidHeights(
        cells=cells,
        tops=np.maximum.reduceat(by_row, np.arange(0, columns, BLOCK), axis=1),
        corner=low,
        cell_m=cell_m,
        middle_m=float(middle_m),
        step_m=float(step_m),
        sheets=sheets,
    )


def _solid(mesh: Mesh, paint: int, sheets: Array) -> Int[Array, "face 3"]:
    """Faces without holes."""
    material = np.where(mesh.material < 0, paint, mesh.material)
    return np.ascontiguousarray(mesh.faces[~sheets[material]] if len(sheets) else mesh.faces)


@nb.njit(cache=True)
def _draw(vertices, faces, transform, low, cell_m, cells):
    """Raise the cells with centres under faces to those."""
    v = np.empty((3, 3))
    for f in range(len(faces)):
        for c in range(3):
            p = vertices[faces[f, c]]
            for k in range(3):
                t = transform[k]
                v[c, k] = t[0] * p[0] + t[1] * p[1] + t[2] * p[2] + t[3]
            v[c, 0] = (v[c, 0] - low[0]) / cell_m - 0.5
            v[c, 1] = (v[c, 1] - low[1]) / cell_m - 0.5
        ax, ay, az = v[1, 0] - v[0, 0], v[1, 1] - v[0, 1], v[1, 2] - v[0, 2]
        bx, by, bz = v[2, 0] - v[0, 0], v[2, 1] - v[0, 1], v[2, 2] - v[0, 2]
        area = ax * by - bx * ay
        if abs(area) < 1e-9:  # upright
            continue
        rise_x, rise_y = (by * az - ay * bz) / area, (ax * bz - bx * az) / area
        first, last = max(math.ceil(v[:, 0].min()), 0), min(math.floor(v[:, 0].max()), cells.shape[1] - 1)
        low_row, top = max(math.ceil(v[:, 1].min()), 0), min(math.floor(v[:, 1].max()), cells.shape[0] - 1)
        for row in range(low_row, top + 1):
            for column in range(first, last + 1):
                x, y = column - v[0, 0], row - v[0, 1]
                a, b = (x * by - y * bx) / area, (y * ax - x * ay) / area
                if a >= -1e-9 and b >= -1e-9 and a + b <= 1 + 1e-9:
                    z = v[0, 2] + rise_x * x + rise_y * y
                    if z > cells[row, column, 0]:
                        cells[row, column, 0] = z
                        cells[row, column, 1], cells[row, column, 2] = rise_x / cell_m, rise_y / cell_m


def _add_sky_view(cells: Float[Array, "row column 4"], cell_m: float) -> Float[Array, "azimuth 2"]:
    """Add every cell's light past the horizon of the others, over n_z; return the azimuths."""
    across = np.ascontiguousarray(cells.transpose(1, 0, 2)[..., [0, 2, 1, 3]])
    azimuths = 2 * math.pi * (np.arange(AZIMUTHS) + _FIRST) / AZIMUTHS
    toward = np.stack([np.sin(azimuths), np.cos(azimuths)], axis=1)
    for east, north in toward.tolist():
        turned = abs(north) > abs(east)
        along, aside = (north, east) if turned else (east, north)
        on, shift = across if turned else cells, aside / abs(along)
        rows, columns = on.shape[:2]
        reach = shift * (columns - 1)
        first, last = -math.ceil(max(reach, 0.0)) - 1, rows + math.ceil(max(-reach, 0.0)) + 1
        over_rows(_sweep, last - first, first, along, aside, shift, cell_m, on, least=64)
    cells[..., 3] += across[..., 3].T
    return toward


@nb.njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _sweep(start, stop, first, along, aside, shift, cell_m, cells):
    """Add each cell's light from behind, past its horizon and its own plane, over n_z, to its last value."""
    rows, columns = cells.shape[:2]
    at, hull = np.empty(columns + 1, np.float32), np.empty(columns + 1, np.float32)
    step, nearer = np.float32(cell_m * math.sqrt(1.0 + shift * shift)), np.float32(_NEARER * cell_m)
    zero, nothing, cell = np.float32(0.0), np.float32(_NOTHING_M), np.float32(cell_m)
    for number in range(first + start, first + stop):
        begin, end = 0, columns  # of the columns in which the line may lie within the rows
        if abs(shift) >= 1e-9:
            one, other = (-0.5 - number) / shift, (rows - 0.5 - number) / shift
            begin, end = max(int(min(one, other)) - 1, 0), min(int(max(one, other)) + 2, columns)
        top, d1, z1, d2, z2 = 0, -cell, nothing, zero, zero  # the last of the hull, and the one before that
        for k in range(begin, end):
            place = number + shift * k
            row = math.floor(place + 0.5)
            if row < 0 or row >= rows:
                continue
            column = k if along > 0 else columns - 1 - k
            rise_x, rise_y = cells[row, column, 1], cells[row, column, 2]
            z, d = cells[row, column, 0] + rise_y * (cell * np.float32(place - row)), np.float32(k) * step
            while top >= 2 and (z2 - z) * (d - d1) >= (z1 - z) * (d - d2):
                top -= 1
                before = max(top - 2, 0)  # a single one has none, and none is used
                d1, z1, d2, z2 = d2, z2, at[before], hull[before]
            above = max(z1 - z, zero)
            if rise_x * rise_x + rise_y * rise_y < _LEVEL:
                away = d - d1 - nearer
                cells[row, column, 3] += away * away / (away * away + above * above)
            else:
                toward = rise_x * along + rise_y * aside  # the normal's part backward, over n_z
                cells[row, column, 3] += _above(max(above / (d - d1), -toward, zero), toward)
            at[top], hull[top] = d, z
            d2, z2, d1, z1 = d1, z1, d, z
            top += 1


@nb.njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _pack(start, stop, toward, scale, drawn, cells):
    """Write `SolidHeights.cells`: light is divided by that past a cell's own plane alone."""
    for row in range(start, stop):
        for column in range(cells.shape[1]):
            rise_x, rise_y = drawn[row, column, 1], drawn[row, column, 2]
            whole = float(len(toward))
            if rise_x * rise_x + rise_y * rise_y >= _LEVEL:
                whole = 0.0
                for k in range(len(toward)):
                    facing = rise_x * toward[k, 0] + rise_y * toward[k, 1]
                    whole += _above(max(-facing, 0.0), facing)
            steps = (drawn[row, column, 0] - scale[0]) / scale[1]
            cells[row, column, 0] = round(max(steps, -_MAX_STEPS - 500.0))  # the last for nothing
            cells[row, column, 1] = round(min(max(rise_x / RISE_UNIT, -32767.0), 32767.0))
            cells[row, column, 2] = round(min(max(rise_y / RISE_UNIT, -32767.0), 32767.0))
            cells[row, column, 3] = round(min(drawn[row, column, 3] / whole, 1.0) / VIEW_UNIT)


@nb.njit(cache=True, fastmath=True, forceinline=True)
def _above(tangent, toward):
    """Light above a horizon, over n_z."""
    if tangent == 0:
        return toward * (0.5 * math.pi) + 1.0
    cosine2 = 1.0 / (1.0 + tangent * tangent)
    return toward * (0.5 * math.pi - math.atan(tangent) - tangent * cosine2) + cosine2


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def view_of_solids(heights, px, py, pz, nx, ny, nz):
    """R of a place on a facet, between the cells around it that are of that facet; `UNKNOWN` if none is."""
    cells, cell_m = heights.cells, np.float32(heights.cell_m)
    x = (px - heights.corner[0]) / heights.cell_m - 0.5
    y = (py - heights.corner[1]) / heights.cell_m - 0.5
    if not (0.0 <= x < cells.shape[1] - 1 and 0.0 <= y < cells.shape[0] - 1):
        return UNKNOWN
    column, row = int(x), int(y)
    fx, fy, one, least = np.float32(x - column), np.float32(y - row), np.float32(1.0), np.float32(_MIN_WEIGHT)
    gx, gy, z, level = one - fx, one - fy, np.float32(pz - heights.middle_m), np.float32(1.0 / nz)
    rises, step_m = (-np.float32(nx) * level, -np.float32(ny) * level), np.float32(heights.step_m)
    place = fx * cell_m, fy * cell_m, z, *rises, cell_m, step_m
    total = seen = np.float32(0.0)
    for along in range(2):
        for across in range(2):
            cell = cells[row + along, column + across]
            if _is_facet(cell, across, along, place):
                weight = max((fx if across else gx) * (fy if along else gy), least)
                total, seen = total + weight, seen + weight * cell[3]
    return seen / total * VIEW_UNIT if total > 0 else UNKNOWN


@nb.njit(cache=True, forceinline=True)
def _is_facet(cell, across, along, place):
    """Return True if a cell, offset to the east and north, is of the facet of a place."""
    x, y, z, rise_x, rise_y, cell_m, step_m = place
    east, north = cell[1] * np.float32(RISE_UNIT), cell[2] * np.float32(RISE_UNIT)
    off = cell[0] * step_m - z + east * (x - across * cell_m) + north * (y - along * cell_m)
    return abs(off) < _SAME_M and abs(east - rise_x) + abs(north - rise_y) < _SAME_SLOPE


def find_leaf_occlusion(
    heights: SolidHeights,
    material: Int[Array, "ray"],
    point: Float[Array, "ray 3"],
    direction: Float[Array, "ray 3"],
) -> Bool[Array, "ray"]:
    """Mask of the rays that end on a leaf and would reach the sky past all solids of the map."""
    out = np.zeros(len(material), np.bool_)
    if heights.cells.size and heights.sheets.any():
        over_rows(_go_past_leaves, len(out), heights, material, point, direction, out, least=1024)
    return out


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _go_past_leaves(start, stop, heights, material, point, direction, out):
    """Follow rays from leaves over the map, a cell at a time, or past a block where nothing is as high."""
    cells, tops, cell_m = heights.cells, heights.tops, heights.cell_m
    for ray in range(start, stop):
        m, d = material[ray], direction[ray]
        if m < 0 or m >= heights.sheets.size or not heights.sheets[m] or d[2] <= 0:
            continue
        step = cell_m / max(math.hypot(d[0], d[1]), 1e-3)
        x, y = (point[ray, 0] - heights.corner[0]) / cell_m, (point[ray, 1] - heights.corner[1]) / cell_m
        z, free = (point[ray, 2] - heights.middle_m) / heights.step_m, True
        dx, dy, dz = d[0] * step / cell_m, d[1] * step / cell_m, d[2] * step / heights.step_m
        while free and z <= _MAX_STEPS:
            x, y, z = x + dx, y + dy, z + dz
            if not (0 <= x < cells.shape[1] and 0 <= y < cells.shape[0]):
                break
            column, row = int(x), int(y)
            if tops[row // BLOCK, column // BLOCK] <= z:
                left = min(_block_steps(x, dx), _block_steps(y, dy))
                x, y, z = x + left * dx, y + left * dy, z + left * dz
            else:
                free = cells[row, column, 0] <= z
        out[ray] = free


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _block_steps(x, dx):
    """Count the whole steps within a block along one side."""
    before = x - int(x) // BLOCK * BLOCK
    return float(int(min((BLOCK - before if dx > 0 else before) / max(abs(dx), 1e-6), 1e6)))
