"""Light that every surface gets from sky and surroundings, kept by probes that stand still with the scene.

Probes (`lattice`) are found once, when a surface near them is first looked at, by rays into every patch
of the sky (`sky`) and below the horizon. Each keeps which part of each patch is open, and the
irradiance from what its blocked rays end on (`gather`). Nothing of it has a wavelength. A facet takes the
four around it, bilinearly, without those that stand in a building or under a car, and scales what they say
of sky and surroundings by what a map of heights says of the very place (`solid_heights`). Trees and hedges
have probes in space, vehicles one a side (`bodies`), each read by the squares of the normal's components
(the ambient cube of McTaggart, "Half-Life 2 / Valve Source Shading", GDC 2004).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.render.light.gather import BOUNCES, Beyond, Gathered, Met, Sent, gather_light, rays_onward
from glintrack.render.light.heights import SolidHeights, hidden_by_leaves, no_heights
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
    """What probes found; `Hits.light_cell` points into ``cells``.

    Parameters
    ----------
    cells
        The four probes of each cell. Cells of points in space are eight each, the first at a multiple of
        eight, by which components of the normal are negative (1 x, 2 y, 4 z): z, x, y and y again.
    facing
        Node of the normal that each probe faces (`sky.node_normals`).
    patches
        Part of each patch of the sky that is open, 0 to 255.
    bounced
        Irradiance from what stands around, over that of its light, by light and class of material
        (`gather`), in units of `BOUNCE_UNIT`; no columns where materials are not known.
    view
        Sky view factor; negative of a probe that stands in a building or under a car. [1]
    past_leaves
        Part that leaves leave of the light from an even sky past solids. [1]
    """

    cells: Int[Array, "cell 4"]
    facing: Int[Array, "probe"]
    patches: Int[Array, "probe patch"]
    bounced: Int[Array, "probe bounce"]
    view: Float[Array, "probe"]
    past_leaves: Float[Array, "probe"]


def empty_table(bounces: int, rows: int = 0) -> ProbeTable:
    """No cells yet, and rows that are not yet filled."""
    return ProbeTable(
        np.zeros((0, 4), np.int32),
        np.zeros(rows, np.int16),
        np.zeros((rows, PATCHES), np.uint8),
        np.zeros((rows, bounces), np.int16),
        np.zeros(rows, np.float32),
        np.zeros(rows, np.float32),
    )


def joined(first: ProbeTable, second: ProbeTable) -> ProbeTable:
    """Two tables in one; cells of the second already count probes from the end of the first."""
    return ProbeTable(*(np.concatenate(both) for both in zip(first, second, strict=True)))


MOST_PROBES = 700_000  # of a map of a million slots; more are wanted, and the lattice is coarsened
AXES = np.array([[0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, -1]], float)
_CAPACITY = 1 << 20
_BATCH = 2048  # probes at a time
_SIDES = 4  # of a vehicle, those of `AXES` after the first
_OFF_BODY_M = 0.1  # of a vehicle's probes
_LEVELS, _LEVELS_OF_LONG = (0.45,), (0.35, 0.7)  # of a vehicle's height where its sides are probed
_PART_M = 3.0  # of a long vehicle's length: so many probes are made one
_GRAZING = 0.03  # cosine from which a facet's rays go
Follow = Callable[[Array, Array], Met]


class LitSurfaces(NamedTuple):
    """Where rays end.

    Parameters
    ----------
    point, normal, material
        See `Hits`.
    instance
        Of a mesh that stands in several places; −1 on the static one.
    role, body, transforms, middle
        Of every instance: how it finds its probes, the first cell of those `BY_SIDES` (−1 if it has none),
        body frame to ENU, and the middle of its box.
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

    def some(self, rays: Int[Array, "chosen"]) -> "LitSurfaces":
        """Where some of the rays end."""
        return self._replace(
            point=self.point[rays],
            normal=self.normal[rays],
            material=self.material[rays],
            instance=self.instance[rays],
        )


class Bodies(NamedTuple):
    """Vehicles: body frame to ENU, and the box of each in its own frame, lower and upper corner. [m]"""

    transforms: Float[Array, "body 3 4"]
    boxes: Float[Array, "body 2 3"]


@dataclass(frozen=True)
class Lookup:
    """Which cell lights each surface, its place in that, and its sky view; see `Hits` for the fields."""

    cell: Int[Array, "ray"]
    part: Int[Array, "ray 2"]
    sky_view: Float[Array, "ray"]
    sky_here: Float[Array, "ray"]

    def with_rays(self, rays: Int[Array, "chosen"], own: "Lookup") -> "Lookup":
        """Itself, its arrays changed to hold what is said of some rays in their place."""
        self.cell[rays], self.part[rays] = own.cell, own.part
        self.sky_view[rays], self.sky_here[rays] = own.sky_view, own.sky_here
        return self


class SceneProbes:
    """Probes of a scene that stands still under one sun, found where asked for and kept.

    Parameters
    ----------
    box
        Corners of the box that holds all that rises over the ground: beyond it the whole sky is seen. [m]
    window
        West, south, east, north of where the lattice is fine; all of the box by default. [m]
    shares
        `gather.MaterialClasses.shares`; without them light from surfaces is not followed.
    heights
        What makes the map of solid heights within the window, when first asked for; none by default.
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
        self._sun, self._surroundings, self._scale = np.zeros(3), 0, 1.0
        self._standing: tuple[ProbeTable, Array] | None = None
        self._make_heights = heights
        self._clear()

    @property
    def step_m(self) -> float:
        """Of the lattice on facets within the window. [m]"""
        return 2.0 * self._scale

    @property
    def coarsened(self) -> bool:
        """Whether more probes were wanted than are kept: then what was looked at before decides the step."""
        return self._scale > 1.0

    @cached_property
    def heights(self) -> SolidHeights:
        """The map of solid heights."""
        return self._make_heights()

    @property
    def table(self) -> ProbeTable:
        """All that is known."""
        return self._table

    def toward(self, sun: Float[Array, "3"], surroundings: int) -> "SceneProbes":
        """The probes under this sun, over level ground of this material: those of another are forgotten."""
        sun = np.asarray(sun, float)
        if not np.array_equal(sun, self._sun) or surroundings != self._surroundings:
            self._sun, self._surroundings, self._scale, self._standing = sun, surroundings, 1.0, None
            self.rays = patch_rays(sun)
            self._clear()
        return self

    def look(self, seen: LitSurfaces, follow: Follow) -> Lookup:
        """Which cells light surfaces.

        Parameters
        ----------
        seen
            The surfaces.
        follow
            What rays meet that start at points in directions, of what stands still.
        """
        found, unknown = self._looked_up(seen, self._table)
        while len(lacking := np.flatnonzero(unknown)):
            scale = self._scale
            self._find(lacking, seen, follow)
            if self._scale != scale:  # all others stand on the finer lattice
                found, unknown = self._looked_up(seen, self._table)
                continue
            some = seen.some(lacking)
            own, unknown[lacking] = self._looked_up(some, self._table)
            found = found.with_rays(lacking, own)
        return found

    def _looked_up(self, seen: LitSurfaces, table: ProbeTable) -> tuple[Lookup, Array]:
        """Look-up of surfaces in what is known, and which of them it does not have."""
        count = len(seen.point)
        cell, part = np.empty(count, np.int32), np.empty((count, 2), np.uint8)
        found = Lookup(cell, part, np.empty(count, np.float32), np.empty(count, np.float32))
        unknown, where = np.zeros(count, np.bool_), (self._box, self._window, self._scale)
        known = self._cell_map, table.cells, table.view, table.past_leaves
        out = cell, part, found.sky_view, found.sky_here
        over_rows(look_up, count, seen, where, known, self.heights, out, unknown, least=1024)
        return found, unknown

    def stand(self, bodies: Bodies, follow: Follow) -> Int[Array, "body"]:
        """Probe the vehicles that stand, once and before any `look`; the first cell of each."""
        if self._standing is None:
            none = empty_table(BOUNCES if self.shares.size else 0)
            self._standing = probe_bodies(bodies, self.rays, self.shares, follow, none)
            self._clear()
        return self._standing[1]

    def probe_moving(self, bodies: Bodies, follow: Follow) -> tuple[ProbeTable, Int[Array, "body"]]:
        """Probes of vehicles that move, to be joined to `table`, and the first cell of each."""
        return probe_bodies(bodies, self.rays, self.shares, follow, self._table)

    def look_in(self, seen: LitSurfaces, table: ProbeTable) -> Lookup:
        """Which cells light surfaces, all in what is known."""
        return self._looked_up(seen, table)[0]

    def _clear(self) -> None:
        self._cell_map, self._row_map = empty_map(_CAPACITY), empty_map(_CAPACITY)
        none = empty_table(BOUNCES if self.shares.size else 0)
        self._table = self._room = none if self._standing is None else self._standing[0]

    def _find(self, rays: Array, seen: LitSurfaces, follow: Follow) -> None:
        """Find the probes that some rays lack; where too many are wanted, on a coarser lattice."""
        rows, cells = len(self._table.view), len(self._table.cells)
        cells += -cells % CORNERS
        wanted, first_row = np.empty(MOST_PROBES, np.int64), np.empty(MOST_PROBES, np.int64)
        new_cells = np.zeros((CORNERS * MOST_PROBES, 4), np.int32)
        maps, counts = (self._cell_map, self._row_map), (rows, cells, MOST_PROBES)
        where = self._box, self._window, self._scale
        used, made, last = add_wanted(rays, seen, where, maps, counts, wanted, first_row, new_cells)
        if used < 0:
            self._scale *= 2.0
            self._clear()
            return
        table = self._with_room(made, last)
        table.cells[len(self._table.cells) : cells] = 0
        table.cells[cells:] = new_cells[: made - cells]
        fresh = ProbeTable(table.cells[cells:], *(values[rows:] for values in table[1:]))
        self._gather(wanted[:used], first_row[:used] - rows, follow, fresh)
        self._table = table

    def _with_room(self, cells: int, rows: int) -> ProbeTable:
        """The table made longer, what is new not yet filled; tables handed out before do not change."""
        room = []
        for values, own, length in zip(self._room, self._table, (cells, *5 * [rows]), strict=True):
            if length > len(values):  # twice what is asked for, of which the system gives what is written
                values = np.empty((2 * length, *own.shape[1:]), own.dtype)
                values[: len(own)] = own
            room.append(values)
        self._room = ProbeTable(*room)
        return ProbeTable(self._room.cells[:cells], *(values[:rows] for values in self._room[1:]))

    def _gather(self, wanted: Array, first_row: Array, follow: Follow, fresh: ProbeTable) -> None:
        """Fill the rows of new probes by following their rays."""
        places = places_of(wanted, self._scale)
        normals = node_normals()
        in_space = places.kind >= VOLUME
        for volume in (False, True):
            mine = np.flatnonzero(in_space == volume)
            for k in range(0, len(mine), _BATCH):
                some = mine[k : k + _BATCH]
                facing = (
                    np.broadcast_to(AXES, (len(some), len(AXES), 3))
                    if volume
                    else normals[places.facing[some]][:, None]
                )
                found = probe(
                    places.centre[some],
                    facing,
                    places.set[some],
                    self.rays,
                    self.shares,
                    follow,
                    self.heights,
                )
                put(fresh, first_row[some], facing, found)


def put(table: ProbeTable, first: Int[Array, "probe"], facing: Array, found: Gathered) -> None:
    """Write what probes gathered into rows of a new table, those of each from ``first`` on."""
    for f in range(facing.shape[1]):
        rows = first + f
        table.facing[rows] = nodes_of(np.array(facing[:, f], float, order="C"))  # of one kind: one kernel
        table.patches[rows] = found.patches
        table.bounced[rows] = np.clip(np.rint(found.bounced[:, f] / BOUNCE_UNIT), -32767, 32767)
        table.view[rows] = np.where(found.alive, found.sky_view[:, f], -1.0)
        table.past_leaves[rows] = found.past_leaves


def probe_bodies(
    bodies: Bodies, rays: PatchRays, shares: Array, follow: Follow, before: ProbeTable
) -> tuple[ProbeTable, Int[Array, "body"]]:
    """Probes at the top and the sides of vehicles, as rows and cells after those of ``before``.

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
        table = joined(table, _probe_alike(own, levels, count, rays, shares, follow, first))
    return table, starts


def _probe_alike(
    bodies: Bodies, levels: tuple[float, ...], parts: int, rays: PatchRays, shares: Array, follow: Follow,
    first: int,
) -> ProbeTable:  # fmt: skip
    """Probes, each the mean of ``parts`` along a vehicle; their rows are counted from ``first`` on.

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
        put(table, some, facing[some], _mean(found, parts))
    cells = np.zeros((CORNERS * len(levels) * len(bodies.boxes), 4), np.int32)
    for k in range(len(bodies.boxes)):
        row, cell = first + len(axes) * k, CORNERS * len(levels) * k
        for level in range(len(levels)):
            own = cells[cell + CORNERS * level : cell + CORNERS * (level + 1)]
            space_cells(row, 0, own)
            own[own > row] += _SIDES * level
    return table._replace(cells=cells)


def _mean(found: Gathered, parts: int) -> Gathered:
    """What probes gather between so many, those that stand where light comes."""
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


@nb.njit(cache=True)
def nodes_of(normals):
    """`node_of_normal` of every normal."""
    nodes = np.empty(len(normals), np.int16)
    for k in range(len(normals)):
        nodes[k] = node_of_normal(normals[k, 0], normals[k, 1], normals[k, 2])
    return nodes


def probe(
    centre: Float[Array, "probe 3"],
    facing: Float[Array, "probe facing 3"],
    sets: Int[Array, "probe"],
    rays: PatchRays,
    shares: Array,
    follow: Follow,
    heights: SolidHeights | None = None,
) -> Gathered:
    """What probes at some places gather for the normals that they face; leaves are told by ``heights``."""
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
    seen = rays.patch[ray], rays.solid_angle[ray], rays.brightness[sets[owner], ray]
    facing = np.require(facing, requirements=["C", "W"])  # `readonly` would be another kernel
    sent = Sent(first, direction, *seen, facing, level)
    met = follow(np.ascontiguousarray(centre[owner]), direction)
    bounces = BOUNCES if shares.size else 0
    beyond = _go_on(first, centre, sets, met, shares, follow)
    out = Gathered(
        np.empty((count, PATCHES), np.uint8),
        np.empty((count, facing.shape[1], bounces), np.float32),
        np.empty((count, facing.shape[1]), np.float32),
        np.empty(count, np.float32),
        np.empty(count, np.bool_),
    )
    hidden = hidden_by_leaves(heights or no_heights(), met.material, met.point, direction)
    over_rows(gather_light, count, sent, met, hidden, beyond, shares, out, least=64)
    return out


def _go_on(first: Array, centre: Array, sets: Array, met: Met, shares: Array, follow: Follow) -> Beyond:
    """What some rays meet that go on from where they end."""
    if not shares.size:
        none = np.zeros(0, np.int16)
        return Beyond(np.full(len(met.material), -1, np.int32), none > 0, none, np.zeros(0, np.float32))
    translucent = (shares[len(shares) // 2 :] != 0).any(axis=1)
    rays = rays_onward(first, centre, np.asarray(sets), met.material, met.point, met.normal, translucent)
    there = follow(rays.start, rays.direction)
    return Beyond(rays.of, rays.behind, there.material, there.sun)
