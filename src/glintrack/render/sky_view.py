"""What each surface sees past buildings and trees: the sky patch by patch, and what stands before it.

Probes on the surfaces (`probe_map`) are found once, when a surface near them is first looked at, by rays into
every patch of the sky (`sky_patches`) and below the horizon. Each keeps which part of each patch is open, and
the irradiance that arrives from what its blocked rays end on, split by light and by class of material: lit by
the sun, by the sky, and by what stands around. A surface takes the four around it, bilinearly, without those
that see no sky at all, which are most likely inside a building. Where the four are not of one mind, beside
walls and under crowns, it asks a finer lattice. What moves is not among what stands.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numba as nb
import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.arrays import Array
from glintrack.parallel import over_rows
from glintrack.render.bounce import BOUNCES, Met, bounce_light
from glintrack.render.probe_map import FACET, FINE, LEAF, MOVING, corner_keys, empty_map, places_of, slot_of
from glintrack.render.shading.normals import NORMAL_NODES, node_normals, square_cell
from glintrack.render.sky_patches import PATCHES, even_irradiance, patch_rays

_CAPACITY = 1 << 21  # slots of the map: 25 MB
MOST_PROBES = 1_000_000  # 42 bytes each; more are wanted in one frame, and the lattice is coarsened
_COARSER = 1.5
_OF_ONE_MIND = 0.1  # sky views of four probes that differ by less are not looked at more closely
_LIFT_M = 0.25  # off the facet: over kerbs, and over the rounding of the third coordinate
_BATCH = 2048  # probes at a time
BOUNCE_UNIT = 2.0 / 65535  # of `Seen.bounced`: irradiance over that of the light itself [1]
Follow = Callable[[Array, Array], Met]


@dataclass(frozen=True)
class Seen:
    """What each ray's surface sees of sky and surroundings; see `Hits` for the fields."""

    sky_patches: Int[Array, "ray patch"]
    bounced: Int[Array, "ray bounce"]
    sky_view: Float[Array, "ray"]


class SkyProbes:
    """Sky and surroundings of a scene that stands still under one sun, found where asked for and kept.

    Parameters
    ----------
    box
        Corners of the box that holds all that rises over the ground: beyond it the whole sky is seen. [m]
    """

    def __init__(self, box: tuple[Array, Array]):
        self._box = np.stack(box).astype(float)
        self._sun = np.zeros(3)
        self._scale = 1.0
        self._clear()

    @property
    def step_m(self) -> float:
        """Of the lattice on surfaces that stand. [m]"""
        return 2.0 * self._scale

    @property
    def count(self) -> int:
        """How many probes are known."""
        return self._known

    def toward(self, sun: Float[Array, "3"]) -> "SkyProbes":
        """The probes under this sun: those of another are forgotten."""
        sun = np.asarray(sun, float)
        if not np.array_equal(sun, self._sun):
            self._sun, self._scale = sun, 1.0
            self._rays = patch_rays(sun)
            self._open = even_irradiance(node_normals(), sun).astype(np.float32)
            self._clear()
        return self

    def look(
        self,
        points: Float[Array, "ray 3"],
        normals: Float[Array, "ray 3"],
        material: Int[Array, "ray"],
        moving: Bool[Array, "ray"],
        sheets: Bool[Array, "material"],
        follow: Follow,
        oversampling: int = 1,
    ) -> Seen:
        """Sky patches, bounced light and sky view of surfaces.

        Rays that follow each other within an element and meet the same facet share one look-up: an element is
        narrower than a step of the lattice.

        Parameters
        ----------
        points, normals, material
            Of the surfaces. [m, 1]
        moving
            Those of vehicles that move.
        sheets
            Materials of leaf cards.
        follow
            What rays meet that start at points in directions, of what stands still.
        oversampling
            Rays along each side of an element.
        """
        count = len(points)
        patches, bounced = np.empty((count, PATCHES), np.uint8), np.empty((count, BOUNCES), np.uint16)
        view, unknown = np.empty(count, np.float32), np.zeros(count, np.bool_)
        kinds = np.where(moving, np.int8(MOVING), np.int8(FACET))
        if sheets.size:
            kinds[(material >= 0) & sheets[material]] = LEAF
        while True:
            rays = points, normals, material, kinds, oversampling, self._box, self._scale
            known = self._map, self._patches, self._bounced, self._views, self._open
            over_rows(_look_up, count, *rays, known, patches, bounced, view, unknown, least=1024)
            if not unknown.any():
                return Seen(patches, bounced, view)
            self._find(np.flatnonzero(unknown), points, normals, kinds, follow)
            unknown[:] = False
            kinds[kinds == FINE] = FACET

    def _clear(self) -> None:
        self._map, self._known = empty_map(_CAPACITY), 0
        self._patches, self._bounced = np.zeros((0, PATCHES), np.uint8), np.zeros((0, BOUNCES), np.uint16)
        self._views = np.zeros(0, np.float32)

    def _find(self, rays: Array, points: Array, normals: Array, kinds: Array, follow: Follow) -> None:
        """Find the probes that some rays lack; where a frame wants too many, on a coarser lattice."""
        room = MOST_PROBES - self._known
        wanted = np.empty(min(room, 4 * len(rays)), np.int64)
        used = _add_wanted(rays, points, normals, kinds, self._scale, self._map, self._known, wanted)
        if used > len(wanted):
            if self._known == 0 or room == MOST_PROBES:
                self._scale *= _COARSER
            self._clear()
            return
        places = places_of(wanted[:used], self._scale, _LIFT_M)
        patches, bounced = np.empty((used, PATCHES), np.uint8), np.empty((used, BOUNCES), np.uint16)
        for k in range(0, used, _BATCH):
            part = slice(k, min(k + _BATCH, used))
            self._probe(places.centre[part], places.facing[part], follow, patches[part], bounced[part])
        self._patches = np.concatenate([self._patches, patches])
        self._bounced = np.concatenate([self._bounced, bounced])
        even = self._open[(NORMAL_NODES**2) // 2]
        self._views = np.concatenate([self._views, (patches @ even / (255 * even.sum())).astype(np.float32)])
        self._known += used

    def _probe(self, centre: Array, facing: Array, follow: Follow, patches: Array, bounced: Array) -> None:
        rays, count = self._rays, len(self._rays.direction)
        met = follow(np.repeat(centre, count, axis=0), np.tile(rays.direction, (len(centre), 1)))
        up = rays.patch >= 0
        free = met.material.reshape(-1, count)[:, up] < 0
        share = np.zeros((int(up.sum()), PATCHES))
        share[np.arange(len(share)), rays.patch[up]] = 1 / rays.count[rays.patch[up]]
        patches[:] = np.rint(255 * (free @ share))
        even = self._open[(NORMAL_NODES**2) // 2]
        view = (patches @ even / (255 * even.sum())).astype(np.float32)
        light = np.empty((len(centre), BOUNCES), np.float32)
        weight = rays.direction, rays.solid_angle
        over_rows(bounce_light, len(centre), *weight, facing, view, met, light)
        bounced[:] = np.minimum(np.rint(light / BOUNCE_UNIT), 65535)


@nb.njit(nogil=True, cache=True)
def _add_wanted(rays, points, normals, kinds, scale, known, first, wanted):
    """Give every probe that some rays lack a row; returns how many there are, or one more than fit."""
    keys, rows = known
    corners, parts, used = np.empty(4, np.int64), np.empty(2), 0
    for ray in rays:
        n, p = normals[ray], points[ray]
        corner_keys(
            float(p[0]), float(p[1]), float(p[2]), float(n[0]), float(n[1]), float(n[2]), kinds[ray], scale,
            corners, parts,
        )  # fmt: skip
        for key in corners:
            slot = slot_of(keys, key)
            if keys[slot] == key:
                continue
            if used == wanted.size:
                return used + 1
            keys[slot], rows[slot] = key, first + used
            wanted[used] = key
            used += 1
    return used


@nb.njit(nogil=True, cache=True)
def _look_up(
    start, stop, points, normals, material, kinds, oversampling, box, scale, known, patches, bounced, view,
    unknown,
):  # fmt: skip
    (keys, rows), probe_patches, probe_bounced, views, open_sky = known
    corners, parts, weight = np.empty(4, np.int64), np.empty(2), np.empty(4, np.float32)
    row, kept = np.empty((2, 4), np.int64), np.full((2, 4), -1, np.int64)
    for i in range(start, stop):
        if i > start and i % oversampling != 0 and material[i] == material[i - 1]:
            same = normals[i, 0] == normals[i - 1, 0] and normals[i, 1] == normals[i - 1, 1]
            if same and normals[i, 2] == normals[i - 1, 2] and not unknown[i - 1]:
                patches[i], bounced[i], view[i] = patches[i - 1], bounced[i - 1], view[i - 1]
                continue
        px, py, pz = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        inside = box[0, 0] <= px <= box[1, 0] and box[0, 1] <= py <= box[1, 1]
        if material[i] < 0 or not inside or pz > box[1, 2]:
            patches[i], bounced[i], view[i] = 255, 0, 1.0
            continue
        nx, ny, nz = float(normals[i, 0]), float(normals[i, 1]), float(normals[i, 2])
        kind, level = kinds[i], 0
        corner_keys(px, py, pz, nx, ny, nz, kind, scale, corners, parts)
        missing = _find_rows(corners, keys, rows, row[0], kept[0])
        if not missing and kind == FACET and _differ(row[0], views):
            kind, level = FINE, 1
            corner_keys(px, py, pz, nx, ny, nz, kind, scale, corners, parts)
            missing = _find_rows(corners, keys, rows, row[1], kept[1])
        if missing:
            unknown[i], kinds[i] = True, kind
            continue
        _blend(row[level], parts, weight, probe_patches, probe_bounced, patches[i], bounced[i])
        a, b, fx, fy = square_cell(nx, ny, nz, 1)
        seen, whole = 0.0, 0.0
        at = (a + (1 if fx > 0.5 else 0)) * NORMAL_NODES + b + (1 if fy > 0.5 else 0)
        for k in range(PATCHES):
            whole += open_sky[at, k]
            seen += open_sky[at, k] * patches[i, k]
        view[i] = seen / (255.0 * whole) if whole > 1e-6 else 0.0


@nb.njit(cache=True, forceinline=True)
def _find_rows(corners, keys, rows, row, kept):
    """Rows of four probes, those of the last call kept; whether one of them is not known."""
    missing = False
    for c in range(4):
        if corners[c] != kept[c]:
            kept[c] = corners[c]
            slot = slot_of(keys, corners[c])
            row[c] = rows[slot] if keys[slot] == corners[c] else -1
        missing |= row[c] < 0
    return missing


@nb.njit(cache=True, forceinline=True)
def _differ(row, views):
    """Whether what four probes see of the sky differs, or one of them sees none."""
    least, most = 1.0, 0.0
    for c in range(4):
        least, most = min(least, views[row[c]]), max(most, views[row[c]])
    return most - least > _OF_ONE_MIND or (least == 0.0 and most > 0.0)


@nb.njit(cache=True, forceinline=True)
def _blend(row, parts, weight, probe_patches, probe_bounced, patches, bounced):
    """Bilinear mean of four probes without those that see no sky; of all four if none does."""
    fx, fy, total = parts[0], parts[1], np.float32(0.0)
    for c in range(4):
        across, along = fx if c & 1 else 1 - fx, fy if c >> 1 else 1 - fy
        some = False
        for k in range(PATCHES):
            some |= probe_patches[row[c], k] > 0
        weight[c] = max(across * along, 1e-3) if some else 0.0
        total += weight[c]
    if total == 0:
        for c in range(4):
            weight[c] = 0.25
        total = np.float32(1.0)
    inverse = np.float32(1.0) / total
    for c in range(4):
        weight[c] *= inverse
    half = np.float32(0.5)
    for k in range(PATCHES):
        patches[k] = np.uint8(
            weight[0] * probe_patches[row[0], k]
            + weight[1] * probe_patches[row[1], k]
            + weight[2] * probe_patches[row[2], k]
            + weight[3] * probe_patches[row[3], k]
            + half
        )
    for k in range(BOUNCES):
        bounced[k] = np.uint16(
            weight[0] * probe_bounced[row[0], k]
            + weight[1] * probe_bounced[row[1], k]
            + weight[2] * probe_bounced[row[2], k]
            + weight[3] * probe_bounced[row[3], k]
            + half
        )
