"""Light of sky and surroundings on every surface, stored at probes of the fixed scene.

Probes (`lattice`) are created once, when a surface near them is first seen, by rays into every patch of the
sky (`sky`) and below the horizon. Each stores the open part of each patch, and the irradiance from the
surfaces that its other rays meet (`gather`). None of it depends on wavelength. A facet interpolates
bilinearly between the four around it, without those in a building or under a car. The light of sky and
surroundings is then scaled with a map of heights at the very place (`solid_heights`). Trees and hedges have
probes in space, vehicles one on each side. Those are weighted with the squares of the normal's components
(the ambient cube of McTaggart, "Half-Life 2 / Valve Source Shading", GDC 2004).
"""

from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.render.light.gather import BOUNCES, Gathered, Met, Onward, gather_light, rays_onward
from glintrack.render.light.heights import SolidHeights, find_leaf_occlusion, no_heights
from glintrack.render.light.lattice import (
    CORNERS,
    LONG_M,
    VOLUME,
    add_wanted,
    empty_map,
    look_up,
    node_of_normal,
    places_of,
    space_cells,
)
from glintrack.render.light.sky import PATCHES, PatchRays, node_normals, patch_rays

BOUNCE_UNIT = 2.0 / 32767  # of `ProbeTable.bounced`: irradiance over that of the light itself [1]


class ProbeTable(NamedTuple):
    """Results of the probes; `Hits.light_cell` points into ``cells``.

    Parameters
    ----------
    cells
        The four probes of each cell. Points in space have eight cells each, the first at a multiple of eight,
        by the components of the normal that are negative (1 x, 2 y, 4 z): z, x, y and y again.
    facing
        Node of the normal that each probe faces (`sky.node_normals`).
    patches
        Open part of each patch of the sky. [1/255]
    bounced
        Irradiance from surfaces over that of their light, by light and class of material (`gather`), in
        units of `BOUNCE_UNIT`; no columns without known materials.
    view
        Sky view factor; negative of a probe in a building or under a car. [1]
    past_leaves
        Transmittance of leaves for the light of an even sky past solids. [1]
    """

    cells: Int[Array, "cell 4"]
    facing: Int[Array, "probe"]
    patches: Int[Array, "probe patch"]
    bounced: Int[Array, "probe bounce"]
    view: Float[Array, "probe"]
    past_leaves: Float[Array, "probe"]


def empty_table(bounces: int, rows: int = 0) -> ProbeTable:
    """Allocate a table without cells."""
    cells, facing = np.zeros((0, 4), np.int32), np.zeros(rows, np.int16)
    patches, bounced = np.zeros((rows, PATCHES), np.uint8), np.zeros((rows, bounces), np.int16)
    return ProbeTable(cells, facing, patches, bounced, *np.zeros((2, rows), np.float32))


def concatenate_tables(first: ProbeTable, second: ProbeTable) -> ProbeTable:
    """Concatenate tables; cells of the second already count probes from the end of the first."""
    return ProbeTable(*(np.concatenate(both) for both in zip(first, second, strict=True)))


MAX_PROBES = 700_000  # of a map of a million slots; for more the lattice is coarsened
AXES = np.array([[0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, -1]], float)
_CAPACITY = 1 << 20
_BATCH = 2048  # probes at a time
_SIDES = 4  # of a vehicle, those of `AXES` after the first
_OFF_BODY_M = 0.1  # of a vehicle's probes
_LEVELS, _LEVELS_OF_LONG = (0.45,), (0.35, 0.7)  # of a vehicle's height where its sides are probed
_PART_M = 3.0  # of a long vehicle's length with one of the averaged probes
_GRAZING = 0.03  # cosine from which a facet's rays go
Follow = Callable[[Array, Array], Met]


class LitSurfaces(NamedTuple):
    """Surfaces to be lit, and the scene's instances.

    Parameters
    ----------
    point, normal, material, instance
        See `SurfaceHits`.
    role, body, transforms, middle
        Of every instance: how it finds its probes, the first cell of those `BY_SIDES` (−1 for none), body
        frame to ENU, and the middle of its box.
    sheets
        Materials of leaf cards.
    """

    point: Float[Array, "ray 3"]
    normal: Float[Array, "ray 3"]
    material: Int[Array, "ray"]
    instance: Int[Array, "ray"]
    role: Int[Array, "instance"]
    body: Int[Array, "instance"]
    sheets: Bool[Array, "material"]
    transforms: Float[Array, "instance 3 4"]
    middle: Float[Array, "instance 3"]


class Bodies(NamedTuple):
    """Vehicles: body frame to ENU, and the box of each in its own frame, lower and upper corner. [m]"""

    transforms: Float[Array, "body 3 4"]
    boxes: Float[Array, "body 2 3"]


class Lookup(NamedTuple):
    """Cell that lights each surface, its place in that, and its sky view; see `Hits` for the fields."""

    cell: Int[Array, "ray"]
    part: Int[Array, "ray 2"]
    sky_view: Float[Array, "ray"]
    sky_here: Float[Array, "ray"]


class SceneProbes:
    """Probes of the fixed scene under one sun, created where needed.

    Parameters
    ----------
    box
        Corners of the box of all that rises over the ground. Beyond it the whole sky is open. [m]
    window
        West, south, east, north of the fine lattice; all of the box by default. [m]
    shares
        `gather.MaterialClasses.shares`; by default light from surfaces is not followed.
    heights
        Maker of the map of solid heights within the window, called at its first use.

    Attributes
    ----------
    scale
        Factor of the lattice's steps; more than 1 after too many probes were needed.
    """

    def __init__(
        self,
        box: tuple[Array, Array],
        window: tuple[float, float, float, float] | None = None,
        shares: Float[Array, "row class"] | None = None,
        heights: Callable[[], SolidHeights] = no_heights,
    ):
        self._box = np.stack(box).astype(float)
        self._window = np.array(window if window else (*self._box[0, :2], *self._box[1, :2]), float)
        self.shares = np.zeros((0, 0)) if shares is None else np.asarray(shares, float)
        self._sun, self._surroundings, self.scale = np.zeros(3), 0, 1.0
        self._standing: tuple[ProbeTable, Array] | None = None
        self._make_heights = heights
        self._clear()

    @cached_property
    def heights(self) -> SolidHeights:
        """The map of solid heights."""
        return self._make_heights()

    def toward(self, sun: Float[Array, "3"], surroundings: int) -> "SceneProbes":
        """Set the sun and the material of the ground beyond the edge; probes of others are deleted."""
        sun = np.asarray(sun, float)
        if not np.array_equal(sun, self._sun) or surroundings != self._surroundings:
            self._sun, self._surroundings, self.scale, self._standing = sun, surroundings, 1.0, None
            self.rays = patch_rays(sun)
            self._clear()
        return self

    def look(self, seen: LitSurfaces, follow: Follow) -> Lookup:
        """Find the cells that light surfaces; create those that do not exist.

        ``follow`` finds the surfaces that rays from points in directions meet in the fixed scene.
        """
        count = len(seen.point)
        views = np.empty((2, count), np.float32)
        found = Lookup(np.empty(count, np.int32), np.empty((count, 2), np.uint8), *views)
        every = rays = np.arange(count)
        while len(rays := self.look_up(seen, rays, self.table, found)):
            scale = self.scale
            self._create(rays, seen, follow)
            rays = rays if self.scale == scale else every  # on a coarser lattice all are found again
        return found

    def look_up(
        self, seen: LitSurfaces, rays: Int[Array, "chosen"], table: ProbeTable, found: Lookup
    ) -> Int[Array, "unknown"]:
        """Write the look-up of some surfaces to ``found``, and return those without a known cell."""
        unknown, where = np.zeros(len(rays), np.bool_), (self._box, self._window, self.scale)
        known = self._cell_map, table.cells, table.view, table.past_leaves
        over_rows(look_up, len(rays), rays, seen, where, known, self.heights, found, unknown, least=1024)
        return rays[unknown]

    def probe_standing(self, bodies: Bodies, follow: Follow) -> Int[Array, "body"]:
        """Probe the fixed vehicles, once and before any `look`; return the first cell of each."""
        if self._standing is None:
            self._standing = probe_bodies(bodies, self.rays, self.shares, follow, self._empty_table())
            self._clear()
        return self._standing[1]

    def _empty_table(self) -> ProbeTable:
        return empty_table(BOUNCES if self.shares.size else 0)

    def _clear(self) -> None:
        self._cell_map, self._row_map = empty_map(_CAPACITY), empty_map(_CAPACITY)
        self.table = self._empty_table() if self._standing is None else self._standing[0]

    def _create(self, rays: Array, seen: LitSurfaces, follow: Follow) -> None:
        """Create the probes that some rays lack; coarsen the lattice if there would be too many."""
        rows, cells = len(self.table.view), len(self.table.cells)
        cells += -cells % CORNERS
        wanted, first_row = np.empty(MAX_PROBES, np.int64), np.empty(MAX_PROBES, np.int64)
        new_cells = np.zeros((CORNERS * MAX_PROBES, 4), np.int32)
        maps, counts = (self._cell_map, self._row_map), (rows, cells, MAX_PROBES)
        where = self._box, self._window, self.scale
        used, made, last = add_wanted(rays, seen, where, maps, counts, wanted, first_row, new_cells)
        if used < 0:
            self.scale *= 2.0
            self._clear()
            return
        own = empty_table(self.table.bounced.shape[1], last - rows)
        places, normals = places_of(wanted[:used], self.scale), node_normals()
        fixed = self.rays, self.shares, follow, self.heights
        for volume in (False, True):
            mine = np.flatnonzero((places.kind >= VOLUME) == volume)
            for k in range(0, len(mine), _BATCH):
                some = mine[k : k + _BATCH]
                facing = np.tile(AXES, (len(some), 1, 1)) if volume else normals[places.facing[some], None]
                gathered = probe(places.centre[some], facing, places.set[some], *fixed)
                _write_rows(own, first_row[some] - rows, facing, gathered)
        padding = np.zeros((cells - len(self.table.cells), 4), np.int32)
        own = own._replace(cells=np.concatenate([padding, new_cells[: made - cells]]))
        self.table = concatenate_tables(self.table, own)


def _write_rows(table: ProbeTable, first: Int[Array, "probe"], facing: Array, found: Gathered) -> None:
    """Write the results of probes to the rows of a new table, those of each from ``first`` on."""
    for f in range(facing.shape[1]):
        rows = first + f
        table.facing[rows] = [node_of_normal(*normal) for normal in facing[:, f].tolist()]
        table.patches[rows] = found.patches
        table.bounced[rows] = np.clip(np.rint(found.bounced[:, f] / BOUNCE_UNIT), -32767, 32767)
        table.view[rows] = np.where(found.alive, found.sky_view[:, f], -1.0)
        table.past_leaves[rows] = found.past_leaves


def probe_bodies(
    bodies: Bodies, rays: PatchRays, shares: Array, follow: Follow, before: ProbeTable
) -> tuple[ProbeTable, Int[Array, "body"]]:
    """Probe the top and the sides of vehicles; rows and cells count from the end of ``before``.

    A vehicle has eight cells; a long one has eight more, of the upper half of its sides.
    """
    length = bodies.boxes[:, 1, 0] - bodies.boxes[:, 0, 0]
    parts = np.where(length > LONG_M, np.rint(length / _PART_M), 1).astype(int)
    table, starts = empty_table(before.bounced.shape[1]), np.zeros(len(length), np.int32)
    table = table._replace(cells=np.zeros((-len(before.cells) % CORNERS, 4), np.int32))
    for count in np.unique(parts).tolist():
        mine = np.flatnonzero(parts == count)
        levels = _LEVELS if count == 1 else _LEVELS_OF_LONG
        own = Bodies(bodies.transforms[mine], bodies.boxes[mine])
        first = len(before.view) + len(table.view)
        starts[mine] = len(before.cells) + len(table.cells) + CORNERS * len(levels) * np.arange(len(mine))
        table = concatenate_tables(table, _probe_alike(own, levels, count, rays, shares, follow, first))
    return table, starts


def _probe_alike(
    bodies: Bodies, levels: tuple[float, ...], parts: int, rays: PatchRays, shares: Array, follow: Follow,
    first: int,
) -> ProbeTable:  # fmt: skip
    """Probe vehicles of one kind, each side by ``parts`` along it; rows are counted from ``first`` on.

    Each of several parts sends the rays of two sets: few probes light a long side.
    """
    low, high = bodies.boxes[:, None, 0], bodies.boxes[:, None, 1]
    axes = np.concatenate([AXES[:1], np.tile(AXES[1 : 1 + _SIDES], (len(levels), 1))])
    height = np.repeat([1.0, *levels], [1, *len(levels) * [_SIDES]])
    centre = 0.5 * (low + high) + axes * (0.5 * (high - low) + _OFF_BODY_M)
    centre[..., 2] = low[..., 2] + height * (high - low)[..., 2] + _OFF_BODY_M * axes[:, 2]
    centre, along = np.repeat(centre[:, :, None], parts, axis=2), (np.arange(parts) + 0.5) / parts - 0.5
    centre[..., 0] += np.where(axes[:, :1] == 0, along * (high - low)[..., :1], 0.0)
    turn = bodies.transforms[:, :, :3]
    centre = np.einsum("kij,kapj->kapi", turn, centre) + bodies.transforms[:, None, None, :, 3]
    facing = np.einsum("kij,aj->kai", turn, axes).reshape(-1, 1, 3)
    facing /= np.linalg.norm(facing, axis=2, keepdims=True)
    table = empty_table(BOUNCES if shares.size else 0, len(facing))
    centre = centre.reshape(-1, 3).astype(np.float32)
    if parts > 1:
        centre, parts = np.repeat(centre, 2, axis=0), 2 * parts
    for k in range(0, len(facing), _BATCH):
        some = np.arange(k, min(k + _BATCH, len(facing)))
        every = slice(parts * k, parts * (some[-1] + 1))
        sets = np.arange(every.start, every.stop) % len(rays.direction)
        found = probe(centre[every], np.repeat(facing[some], parts, axis=0), sets, rays, shares, follow)
        _write_rows(table, some, facing[some], _mean(found, parts))
    cells = np.zeros((CORNERS * len(levels) * len(bodies.boxes), 4), np.int32)
    for k in range(len(bodies.boxes)):
        row, cell = first + len(axes) * k, CORNERS * len(levels) * k
        for level in range(len(levels)):
            own = cells[cell + CORNERS * level : cell + CORNERS * (level + 1)]
            space_cells(row, 0, own)
            own[own > row] += _SIDES * level
    return table._replace(cells=cells)


def _mean(found: Gathered, parts: int) -> Gathered:
    """Average groups of probes, over those that light reaches."""
    if parts == 1:
        return found
    alive = found.alive.reshape(-1, parts)
    weight = np.where(alive.any(axis=1, keepdims=True), alive, True)
    weight = (weight / weight.sum(axis=1, keepdims=True)).astype(np.float32)
    patches, bounced, view, leaves = (
        np.einsum("kp,kp...->k...", weight, x.reshape(*alive.shape, *x.shape[1:]))
        for x in (found.patches, found.bounced, found.sky_view, found.past_leaves)
    )
    return Gathered(np.rint(patches).astype(np.uint8), bounced, view, leaves, np.asarray(alive.any(axis=1)))


def probe(
    centre: Float[Array, "probe 3"],
    facing: Float[Array, "probe facing 3"],
    sets: Int[Array, "probe"],
    rays: PatchRays,
    shares: Array,
    follow: Follow,
    heights: SolidHeights | None = None,
) -> Gathered:
    """Gather light at probes for the normals that they face; ``heights`` gives what leaves hide."""
    count, fan = len(centre), rays.direction.shape[1]
    taken = np.ones((count, fan), np.bool_)
    if facing.shape[1] == 1:
        for s in range(len(rays.direction)):
            mine = sets == s
            taken[mine] = facing[mine, 0] @ rays.direction[s].T > _GRAZING
    owner, ray = np.nonzero(taken)
    direction = rays.direction[sets[owner], ray]
    first = np.concatenate([[0], np.cumsum(taken.sum(axis=1))])
    level = np.asarray(facing[:, 0, 2] > 0.99)
    sent = PatchRays(direction, rays.patch[ray], rays.solid_angle[ray], rays.brightness[sets[owner], ray])
    facing = np.require(facing, requirements=["C", "W"])  # `readonly` would be another kernel
    met = follow(np.ascontiguousarray(centre[owner]), direction)
    bounces = BOUNCES if shares.size else 0
    if shares.size:
        through = (shares[len(shares) // 2 :] != 0).any(axis=1)
        onward = rays_onward(first, centre, np.asarray(sets), met, through)
    else:
        nowhere = np.zeros((0, 3), np.float32)
        onward = Onward(np.full(len(owner), -1, np.int32), np.zeros(0, np.bool_), nowhere, nowhere)
    beyond = follow(onward.start, onward.direction)
    out = Gathered(
        np.empty((count, PATCHES), np.uint8),
        np.empty((count, facing.shape[1], bounces), np.float32),
        np.empty((count, facing.shape[1]), np.float32),
        np.empty(count, np.float32),
        np.empty(count, np.bool_),
    )
    leafy = find_leaf_occlusion(heights or no_heights(), met.material, met.point, direction)
    query = first, sent, facing, level, met, leafy, onward, beyond, shares
    over_rows(gather_light, count, *query, out, least=64)
    return out
