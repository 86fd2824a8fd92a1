"""Sky view factor of each surface among buildings and trees, from probes on a lattice.

A probe holds the sky view of five facets at its place: level, and upright facing east, west, north and south.
They are found once, by rays in an even spread of directions, when a surface near the probe is first looked
at; what moves casts no such shade. A surface takes the mean of the probes around it that lie before its
facet, and of their facets by the squares of its normal's components (the ambient cube of McTaggart,
"Half-Life 2 / Valve Source Shading", GDC 2004), over the same mean for an endless slope of its tilt.
"""

import math
from functools import lru_cache

import numba as nb
import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.arrays import Array
from glintrack.parallel import over_rows
from glintrack.render.rays.tracer_protocol import Tracer

CELL_M = 2.0  # of the lattice; larger where a scene would need more than `_MOST_CELLS`
_MOST_CELLS = 16_000_000
_DIRECTIONS = 64
_LIFT = 0.35  # of a cell, off the facet: the probes taken are those before it
_BEFORE_M = 0.02  # a probe nearer to the facet's plane than this, or behind it, is not taken
_UNKNOWN, _WANTED = -1, -2  # of the lattice's index
_NORMALS = 64  # cells along the table of slopes: a step of the normal of three degrees
_BATCH = 4096  # probes at a time: sixteen megabytes of rays
_MARGIN_CELLS = 2
_OFFSET = (0.31, 0.43, 0.63)  # of a cell: level ground and walls on whole metres lie between probes


class SkyProbes:
    """Sky view of a scene that stands still, found where it is asked for and kept.

    Parameters
    ----------
    rays
        The intersector.
    low_m, high_m
        Corners of the box that holds all that stands still. [m]
    """

    def __init__(self, rays: Tracer, low_m: Float[Array, "3"], high_m: Float[Array, "3"]):
        self._rays = rays
        extent = np.maximum(np.asarray(high_m, float) - low_m, 0)
        self._cell_m = CELL_M
        while np.prod(self._shape(extent).astype(float)) > _MOST_CELLS:
            self._cell_m *= 1.1
        self._origin = np.asarray(low_m, float) + (np.array(_OFFSET) - _MARGIN_CELLS) * self._cell_m
        self._index = np.full(self._shape(extent), _UNKNOWN, np.int32)
        self._values = np.zeros((0, 5), np.float32)
        self._open = _open_slopes()

    def view(
        self,
        points: Float[Array, "ray 3"],
        normals: Float[Array, "ray 3"],
        material: Int[Array, "ray"],
        sheets: Bool[Array, "material"] | None = None,
    ) -> tuple[Float[Array, "ray"], Float[Array, "ray"]]:
        """`Hits.sky_view`, 1 beyond the lattice and for what is sky itself, and `Hits.sky_behind`. [1]"""
        front, behind = np.empty(len(points), np.float32), np.empty(len(points), np.float32)
        sheets = np.zeros(0, np.bool_) if sheets is None else sheets
        missing = np.zeros(1, np.int8)
        for _ in range(2):  # the first look may find probes missing
            lattice = (self._index, self._values, self._origin, self._cell_m, self._open)
            rays = points, normals, material
            over_rows(_look_up, len(points), *rays, lattice, sheets, front, behind, missing, least=1024)
            if not missing[0]:
                break
            missing[0] = 0
            self._fill()
        return front, behind

    def _shape(self, extent_m: Array) -> Array:
        return np.ceil(extent_m / self._cell_m).astype(int) + 2 * _MARGIN_CELLS

    def _fill(self) -> None:
        """Find the probes that are wanted."""
        wanted = _find_wanted(self._index.ravel())
        known = len(self._values)
        place = np.stack(np.unravel_index(wanted, self._index.shape), axis=1)
        centres = (self._origin + place * self._cell_m).astype(np.float32)
        directions = even_directions(_DIRECTIONS)
        weights = _facet_weights(directions)
        found = [
            self._probe(centres[k : k + _BATCH], directions, weights) for k in range(0, len(wanted), _BATCH)
        ]
        self._values = np.concatenate([self._values, *found])
        self._index.flat[wanted] = known + np.arange(len(wanted))

    def _probe(self, centres: Array, directions: Array, weights: Array) -> Float[Array, "probe 5"]:
        count = len(directions)
        light = self._rays.transmitted(
            np.repeat(centres, count, axis=0),
            np.tile(directions, (len(centres), 1)),
            np.ones(len(centres) * count, np.bool_),
            past="still",
        )
        return light.reshape(-1, count) @ weights


def even_directions(count: int) -> Float[Array, "direction 3"]:
    """Unit vectors spread evenly over the upper hemisphere, neighbours near each other in the list. [1]

    References
    ----------
    The Fibonacci spiral: Marques et al., "Spherical Fibonacci Point Sets for Illumination Integrals",
    Computer Graphics Forum 32 (2013).
    """
    k = np.arange(count)
    up = (k + 0.5) / count
    azimuth = 2 * math.pi * np.mod(k * (math.sqrt(5) - 1) / 2, 1)
    across = np.sqrt(1 - up * up)
    directions = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), up], axis=1)
    sector = np.lexsort((up, np.floor(azimuth / (math.pi / 2))))  # rays of a packet stay together
    return np.ascontiguousarray(directions[sector], np.float32)


def _facet_weights(directions: Float[Array, "direction 3"]) -> Float[Array, "direction 5"]:
    """What each direction counts for each facet; the sum over an open sky is 1."""
    facets = np.array([[0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], float)
    cosine = np.maximum(directions @ facets.T, 0)
    return (cosine / cosine.sum(axis=0)).astype(np.float32)


@lru_cache(maxsize=1)
def _open_slopes() -> Float[Array, "east north"]:
    """What `_look_up` sums over the facets of a probe on an endless slope, by the slope's normal.

    Normals are laid out as a square by the octahedron map (Meyer et al., "On Floating-Point Normal Vectors",
    EGSR 2010), each cell holding the value at its centre. Treat it as read-only.
    """
    directions = even_directions(8 * _DIRECTIONS).astype(float)
    centre = (np.arange(_NORMALS) + 0.5) / _NORMALS * 2 - 1
    a, b = (side.ravel() for side in np.meshgrid(centre, centre, indexing="ij"))
    up = 1 - np.abs(a) - np.abs(b)
    below = up < 0
    east = np.where(below, np.copysign(1 - np.abs(b), a), a)
    north = np.where(below, np.copysign(1 - np.abs(a), b), b)
    normals = np.stack([east, north, up], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    facets = (normals @ directions.T > 0) @ _facet_weights(directions)  # (normal, 5)
    squares = normals**2
    side_east = np.where(normals[:, 0] > 0, facets[:, 1], facets[:, 2])
    side_north = np.where(normals[:, 1] > 0, facets[:, 3], facets[:, 4])
    level = np.where(normals[:, 2] > 0, squares[:, 2], 0) * facets[:, 0]
    total = level + 0.5 * (squares[:, 0] * side_east + squares[:, 1] * side_north)
    return np.maximum(total, 1e-6).reshape(_NORMALS, _NORMALS).astype(np.float32)


@nb.njit(nogil=True, cache=True)
def _find_wanted(index):
    """Places of the probes to find, without a mask as large as the lattice."""
    count = 0
    for k in range(index.size):
        count += index[k] == _WANTED
    wanted, used = np.empty(count, np.int64), 0
    for k in range(index.size):
        if index[k] == _WANTED:
            wanted[used] = k
            used += 1
    return wanted


@nb.njit(nogil=True, cache=True)
def _slope_cell(nx, ny, nz):
    """Where `_open_slopes` holds a normal."""
    scale = 1.0 / (abs(nx) + abs(ny) + abs(nz))
    a, b = nx * scale, ny * scale
    if nz < 0:
        a, b = math.copysign(1 - abs(b), a), math.copysign(1 - abs(a), b)
    last = _NORMALS - 1
    return min(int((a + 1) * 0.5 * _NORMALS), last), min(int((b + 1) * 0.5 * _NORMALS), last)


@nb.njit(nogil=True, cache=True)
def _look_up(start, stop, points, normals, material, lattice, sheets, front, behind, missing):
    index, values, origin, step, slopes = lattice
    place = origin[0], origin[1], origin[2], step, 1.0 / step
    around, cell = np.empty((2, 8)), np.full(7, -1.0)  # the probes around the last ray, and which they are
    for i in range(start, stop):
        nx, ny, nz = float(normals[i, 0]), float(normals[i, 1]), float(normals[i, 2])
        front[i], behind[i] = 1.0, 0.0
        if material[i] < 0:
            continue
        px, py, pz = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        point, normal, back = (px, py, pz), (nx, ny, nz), (-nx, -ny, -nz)
        front[i] = _facet_view(point, normal, index, values, place, slopes, around, cell, missing)
        if material[i] < sheets.size and sheets[material[i]]:
            behind[i] = _facet_view(point, back, index, values, place, slopes, around, cell, missing)


@nb.njit(cache=True, fastmath=True, forceinline=True)
def _facet_view(point, normal, index, values, place, slopes, around, cell, missing):
    """Sky view of one facet from the probes around it; those that are not known are marked as wanted.

    ``around`` keeps for each of them what it says of the facet and how far it lies before the first, ``cell``
    which they are and the open facet's value.
    """
    (px, py, pz), (nx, ny, nz) = point, normal
    west, south, low, step, inverse = place
    rx, ry, rz = (px - west) * inverse, (py - south) * inverse, (pz - low) * inverse
    x, y, z = rx + _LIFT * nx, ry + _LIFT * ny, rz + _LIFT * nz
    if not (0 <= x < index.shape[0] - 1 and 0 <= y < index.shape[1] - 1 and 0 <= z < index.shape[2] - 1):
        return 1.0
    a, b, c = int(x), int(y), int(z)
    if cell[0] != a or cell[1] != b or cell[2] != c or cell[3] != nx or cell[4] != ny or cell[5] != nz:
        cell[0], cell[1], cell[2], cell[3], cell[4], cell[5] = a, b, c, nx, ny, nz
        column, row = _slope_cell(nx, ny, nz)
        cell[6] = slopes[column, row]
        # a level facet gets the whole open sky, an upright one half of it, one that faces down none
        level, east, north = nz * nz if nz > 0 else 0.0, 0.5 * nx * nx, 0.5 * ny * ny
        column_x, column_y = 1 if nx > 0 else 2, 3 if ny > 0 else 4
        for corner in range(8):
            right, ahead, up = corner & 1, corner >> 1 & 1, corner >> 2
            around[1, corner] = step * (right * nx + ahead * ny + up * nz)
            k = index[a + right, b + ahead, c + up]
            around[0, corner] = -1.0
            if k >= 0:
                around[0, corner] = (
                    level * values[k, 0] + east * values[k, column_x] + north * values[k, column_y]
                )
    fx, fy, fz = x - a, y - b, z - c
    first = ((a - rx) * nx + (b - ry) * ny + (c - rz) * nz) * step
    total, seen, unknown = 0.0, 0.0, 0
    for corner in range(8):
        right, ahead, up = float(corner & 1), float(corner >> 1 & 1), float(corner >> 2)
        before, here = first + around[1, corner], around[0, corner]
        weight = (1 - right + (2 * right - 1) * fx) * (1 - ahead + (2 * ahead - 1) * fy)
        weight *= (1 - up + (2 * up - 1) * fz) * min(before * inverse, 0.25)
        # a probe without any sky is most likely inside a building
        weight = weight if before >= _BEFORE_M and here > 0 else 0.0
        total += weight
        seen += weight * here
        unknown += 1 if before >= _BEFORE_M and here < 0 else 0
    if unknown > 0:
        missing[0] = 1
        for corner in range(8):
            if first + around[1, corner] >= _BEFORE_M and around[0, corner] < 0:
                index[a + (corner & 1), b + (corner >> 1 & 1), c + (corner >> 2)] = _WANTED
    return min(seen / (total * cell[6]), 1.0) if total > 0 else 0.0
