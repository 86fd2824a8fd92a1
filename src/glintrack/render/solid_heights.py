"""Heights of all that stands and has no holes, and how much sky their horizon leaves at each cell.

A probe's few rays are noisy, and what is smaller than the lattice of probes (a parked car, a parapet) lies
between them. The horizon of a map of heights has no noise and is fine, but knows no crowns, nor what lies
under a roof. So the two share the work: V = R T, R the sky view factor past the map's horizon at the very
place, T which part of the sky that solids leave the leaves leave, from the probes.

Horizons are found along lines of cells in even azimuths, each line keeping the convex hull of what it passed
(Timonen and Westerholm, "Scalable Height Field Self-Shadowing", Computer Graphics Forum 29, 2010). Above a
horizon of tangent t in azimuth φ a facet of normal n gets

    ∫ cos θ dω = s [½π − atan t − t/(1 + t²)] + n_z/(1 + t²),    s = n_x sin φ + n_y cos φ,

times ½ dφ; R is that over the same above the facet's own plane and the level.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.arrays import Array
from glintrack.kernels.parts import kernel_part
from glintrack.parallel import over_rows
from glintrack.scene import Mesh, Snapshot

CELL_M = 0.33
MOST_CELLS = 6_000_000  # more, and cells are larger
AZIMUTHS = 12
MARGIN_M = 40.0  # around the window: what stands there counts as horizon
UNKNOWN = -1.0  # R of a place that the map does not have: under a roof, on a wall, beyond
_NOTHING_M = -1e4
_FIRST = 0.37  # azimuth of the first line, in steps: off the axes of streets
_NEARER = 0.5  # of a cell: the edge of what rises lies between cells
_LEVEL = 0.02  # square of the slope of cells that are taken as level
_SAME_M, _SAME_SLOPE = 0.06, 0.2  # of a cell and a place on the same facet
_LEAST = 1e-3


class SolidHeights(NamedTuple):
    """A map of heights, rows from south to north.

    Parameters
    ----------
    cells
        Of the highest surface without holes at each cell's centre: height [m], rise to the east and to the
        north [1], and sky view factor past the horizon [1].
    corner
        East and north of the map's corner. [m]
    cell_m
        Side of a cell. [m]
    highest
        Of all cells. [m]
    sheets
        Materials of leaf cards, which the map leaves out.
    """

    cells: Float[Array, "row column 4"]
    corner: Float[Array, "2"]
    cell_m: float
    highest: float
    sheets: Bool[Array, "material"]


def no_heights() -> SolidHeights:
    """A map that knows no place."""
    none = np.zeros((0, 0, 4), np.float32)
    return SolidHeights(none, np.zeros(2), CELL_M, _NOTHING_M, np.zeros(0, np.bool_))


def solid_heights(
    snapshot: Snapshot, sheets: Bool[Array, "material"], window: tuple[float, float, float, float]
) -> SolidHeights:
    """The map of what stands still in a window and around it.

    Parameters
    ----------
    snapshot
        The scene; what moves is left out.
    sheets
        Materials with holes, which are left out.
    window
        West, south, east, north. [m]
    """
    low = np.array(window[:2]) - MARGIN_M
    size = np.maximum(np.array(window[2:]) + MARGIN_M - low, 0.0)
    cell_m = max(CELL_M, math.sqrt(float(size.prod()) / MOST_CELLS))
    columns, rows = np.ceil(size / cell_m).astype(int)
    height, slope = np.full((rows, columns), _NOTHING_M, np.float32), np.zeros((rows, columns, 2), np.float32)
    _draw(
        snapshot.static.vertices, _solid(snapshot.static, 0, sheets), np.eye(3, 4), low, cell_m, height, slope
    )
    fixed = slice(0, snapshot.fixed)
    which = np.stack([snapshot.model[fixed], snapshot.paint[fixed]], axis=1)
    for model, paint in np.unique(which, axis=0):
        mesh = snapshot.models[model]
        faces = _solid(mesh, int(paint), sheets)
        for k in np.flatnonzero((which == (model, paint)).all(axis=1)):
            transform = np.asarray(snapshot.transforms[k], float)
            _draw(mesh.vertices, faces, transform, low, cell_m, height, slope)
    cells = np.dstack([height, slope, _sky_view(height, slope, cell_m)])
    return SolidHeights(cells, low, cell_m, float(height.max(initial=_NOTHING_M)), sheets)


def _solid(mesh: Mesh, paint: int, sheets: Array) -> Int[Array, "face 3"]:
    """Faces without holes."""
    material = np.where(mesh.material < 0, paint, mesh.material)
    return np.ascontiguousarray(mesh.faces[~sheets[material]] if len(sheets) else mesh.faces)


@nb.njit(cache=True)
def _draw(vertices, faces, transform, low, cell_m, height, slope):
    """Raise cells whose centres lie under faces to them."""
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
        first, last = max(math.ceil(v[:, 0].min()), 0), min(math.floor(v[:, 0].max()), height.shape[1] - 1)
        for row in range(
            max(math.ceil(v[:, 1].min()), 0), min(math.floor(v[:, 1].max()), height.shape[0] - 1) + 1
        ):
            for column in range(first, last + 1):
                x, y = column - v[0, 0], row - v[0, 1]
                a, b = (x * by - y * bx) / area, (y * ax - x * ay) / area
                if a >= -1e-9 and b >= -1e-9 and a + b <= 1 + 1e-9:
                    z = v[0, 2] + rise_x * x + rise_y * y
                    if z > height[row, column]:
                        height[row, column] = z
                        slope[row, column, 0], slope[row, column, 1] = rise_x / cell_m, rise_y / cell_m


def _sky_view(height: Array, slope: Array, cell_m: float) -> Float[Array, "row column"]:
    """Sky view factor of every cell past the horizon of the others."""
    across = np.ascontiguousarray(height.T), np.ascontiguousarray(slope.transpose(1, 0, 2)[..., ::-1])
    seen = [np.zeros((*one.shape, 2), np.float32) for one in (height, across[0])]
    for k in range(AZIMUTHS):
        azimuth = 2 * math.pi * (k + _FIRST) / AZIMUTHS
        east, north = math.sin(azimuth), math.cos(azimuth)
        turned = abs(north) > abs(east)
        along, aside = (north, east) if turned else (east, north)
        on = across if turned else (height, slope)
        shift = aside / abs(along)
        rows, columns = on[0].shape
        reach = shift * (columns - 1)
        first, last = -math.ceil(max(reach, 0.0)) - 1, rows + math.ceil(max(-reach, 0.0)) + 1
        line = along, aside, shift, cell_m
        over_rows(_sweep, last - first, first, line, *on, seen[turned], least=64)
    both = seen[0] + seen[1].transpose(1, 0, 2)
    return np.divide(
        both[..., 0], both[..., 1], out=np.ones(height.shape, np.float32), where=both[..., 1] > 0
    )


@nb.njit(nogil=True, cache=True, fastmath=True)
def _sweep(start, stop, first, line, height, slope, seen):
    """Add to ``seen`` what every cell gets from behind, past its horizon and past its own plane."""
    along, aside, shift, cell_m = line
    rows, columns = height.shape
    at, hull = np.empty(columns, np.float32), np.empty(columns, np.float32)
    step, nearer = cell_m * math.sqrt(1.0 + shift * shift), np.float32(_NEARER * cell_m)
    for number in range(first + start, first + stop):
        top = 0
        for k in range(columns):
            place = number + shift * k
            row = math.floor(place + 0.5)
            if row < 0 or row >= rows:
                continue
            column = k if along > 0 else columns - 1 - k
            rise_x, rise_y = slope[row, column, 0], slope[row, column, 1]
            z = height[row, column] + rise_y * np.float32(cell_m * (place - row))
            d = np.float32(k * step)
            while top >= 2 and (hull[top - 2] - z) * (d - at[top - 1]) >= (hull[top - 1] - z) * (
                d - at[top - 2]
            ):
                top -= 1
            tangent = np.float32(0.0)
            steep = rise_x * rise_x + rise_y * rise_y
            if top > 0 and hull[top - 1] > z:
                away = d - at[top - 1] - (nearer if steep < _LEVEL else np.float32(0.0))
                tangent = (hull[top - 1] - z) / away
            if steep < _LEVEL:
                seen[row, column, 0] += 1.0 / (1.0 + tangent * tangent)
                seen[row, column, 1] += 1.0
            else:
                toward = rise_x * along + rise_y * aside  # the normal's part backward, over n_z
                own = max(-toward, np.float32(0.0))
                seen[row, column, 0] += _above(max(tangent, own), toward)
                seen[row, column, 1] += _above(own, toward)
            at[top], hull[top] = d, z
            top += 1


@kernel_part(fastmath=True, forceinline=True)
def _above(tangent, toward):
    """Light above a horizon, over n_z."""
    cosine2 = 1.0 / (1.0 + tangent * tangent)
    return toward * (0.5 * math.pi - math.atan(tangent) - tangent * cosine2) + cosine2


@kernel_part()
def view_of_solids(heights, px, py, pz, nx, ny, nz):
    """R of a place on a facet, between the cells around it that are of that facet; `UNKNOWN` if none is."""
    rows, columns = heights.cells.shape[:2]
    x = (px - heights.corner[0]) / heights.cell_m - 0.5
    y = (py - heights.corner[1]) / heights.cell_m - 0.5
    if not (0.0 <= x < columns - 1 and 0.0 <= y < rows - 1):
        return UNKNOWN
    column, row = int(x), int(y)
    fx, fy, total, seen = x - column, y - row, 0.0, 0.0
    rise_x, rise_y = -nx / nz, -ny / nz
    for c in range(4):
        i, j = column + (c & 1), row + (c >> 1)
        east, north = heights.cells[j, i, 1], heights.cells[j, i, 2]
        off = heights.cells[j, i, 0] - pz + heights.cell_m * (east * (x - i) + north * (y - j))
        if abs(off) < _SAME_M and abs(east - rise_x) + abs(north - rise_y) < _SAME_SLOPE:
            weight = max((fx if c & 1 else 1 - fx) * (fy if c >> 1 else 1 - fy), _LEAST)
            total += weight
            seen += weight * heights.cells[j, i, 3]
    return seen / total if total > 0 else UNKNOWN


def hidden_by_leaves(
    heights: SolidHeights,
    material: Int[Array, "ray"],
    point: Float[Array, "ray 3"],
    direction: Float[Array, "ray 3"],
) -> Bool[Array, "ray"]:
    """Which rays end on a leaf and would reach the sky past all solids of the map."""
    out = np.zeros(len(material), np.bool_)
    if heights.cells.size and heights.sheets.any():
        over_rows(_go_past_leaves, len(out), heights, material, point, direction, out, least=1024)
    return out


@nb.njit(nogil=True, cache=True)
def _go_past_leaves(start, stop, heights, material, point, direction, out):
    """Follow rays from leaves over the map, a cell at a time."""
    rows, columns = heights.cells.shape[:2]
    for ray in range(start, stop):
        m, d = material[ray], direction[ray]
        if m < 0 or m >= heights.sheets.size or not heights.sheets[m] or d[2] <= 0:
            continue
        step = heights.cell_m / max(math.hypot(d[0], d[1]), 1e-3)
        x = (point[ray, 0] - heights.corner[0]) / heights.cell_m
        y = (point[ray, 1] - heights.corner[1]) / heights.cell_m
        z, free = point[ray, 2], True
        while free and z <= heights.highest:
            x += d[0] * step / heights.cell_m
            y += d[1] * step / heights.cell_m
            z += d[2] * step
            if not (0 <= x < columns and 0 <= y < rows):
                break
            free = heights.cells[int(y), int(x), 0] <= z
        out[ray] = free
