"""Light that the surfaces of a frame get from sky and surroundings: probes of what stands and of what moves.

A box stands for a vehicle that moves. Around it the rays of a probe are followed from each surface point,
weighed with a clear sky's usual brightness about the sun and with what of their patches stands open; what
the box blocks is lost.
"""

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.render.light.gather import Met
from glintrack.render.light.lattice import BY_HALVES, BY_SIDES, LONG_M
from glintrack.render.light.probes import Bodies, LitSurfaces, Lookup, ProbeTable, joined
from glintrack.render.light.sky import PatchRays
from glintrack.render.rays.surfaces import SurfaceHits
from glintrack.render.tracer import Lit

REACH_M = 3.0  # from a vehicle's sides: farther off a car hides little of the sky
_RAYS = 24  # of a probe's, those that bring level ground most light
_CELL_M = 8.0


class _Boxes(NamedTuple):
    """Vehicles as boxes, and which of them reach into each cell of a grid."""

    low: Float[Array, "body 3"]
    high: Float[Array, "body 3"]
    axes: Float[Array, "body 3 3"]
    origin: Float[Array, "body 3"]
    corner: Float[Array, "2"]
    start: Int[Array, "row column"]
    listed: Int[Array, "entry"]


def sky_left(
    seen, found: Lookup, table: ProbeTable, bodies: Bodies, first: int, rays: PatchRays
) -> Int[Array, "ray"]:
    """`Hits.sky_left` of every surface.

    Parameters
    ----------
    seen, found, table
        SurfaceHits, and what lights them.
    bodies, first
        Vehicles that move, and which instance is the first of them.
    rays
        Directions of probes.
    """
    out = np.full(len(seen.point), 255, np.uint8)
    if len(bodies.transforms) == 0:
        return out
    up = rays.patch >= 0
    direction = rays.direction[0, up].astype(float)
    bright = (rays.solid_angle * rays.brightness[0])[up].astype(float)
    best = np.argsort(-bright * np.maximum(direction[:, 2], 0.1))[:_RAYS]
    sky = direction[best], bright[best], rays.patch[up][best]
    surfaces = seen.point, seen.normal, seen.material, seen.instance, found.cell
    over_rows(_fill_left, len(out), surfaces, table, _boxes(bodies), first, sky, out, least=1024)
    return out


def _boxes(bodies: Bodies) -> _Boxes:
    turn, origin = bodies.transforms[:, :, :3], bodies.transforms[:, :, 3]
    low, high = bodies.boxes[:, 0], bodies.boxes[:, 1]
    reach = np.linalg.norm(np.maximum(np.abs(low), np.abs(high))[:, :2], axis=1) + REACH_M
    corner = (origin[:, :2] - reach[:, None]).min(axis=0)
    first = np.floor((origin[:, :2] - reach[:, None] - corner) / _CELL_M).astype(int)
    last = np.floor((origin[:, :2] + reach[:, None] - corner) / _CELL_M).astype(int)
    shape = last.max(axis=0) + 1
    inside: dict[tuple[int, int], list[int]] = {}
    for k in range(len(origin)):
        for i in range(first[k, 0], last[k, 0] + 1):
            for j in range(first[k, 1], last[k, 1] + 1):
                inside.setdefault((i, j), []).append(k)
    start, listed = np.full(shape, -1, np.int32), []
    for (i, j), some in inside.items():
        start[i, j] = len(listed)
        listed += [*some, -1]
    axes = np.ascontiguousarray(turn.transpose(0, 2, 1))
    return _Boxes(
        low=low,
        high=high,
        axes=axes,
        origin=np.ascontiguousarray(origin),
        corner=corner,
        start=start,
        listed=np.array(listed, np.int32),
    )


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _fill_left(begin, stop, surfaces, table, boxes, first, sky, out):
    point, normal, material, instance, cell = surfaces
    direction, bright, patch = sky
    start, corner = boxes.start, boxes.corner
    for r in range(begin, stop):
        if material[r] < 0 or instance[r] >= first:
            continue
        px, py, pz = float(point[r, 0]), float(point[r, 1]), float(point[r, 2])
        i, j = math.floor((px - corner[0]) / _CELL_M), math.floor((py - corner[1]) / _CELL_M)
        if i < 0 or j < 0 or i >= start.shape[0] or j >= start.shape[1] or start[i, j] < 0:
            continue
        entry = _near(boxes, start[i, j], px, py, pz)
        if entry < 0:
            continue
        nx, ny, nz = float(normal[r, 0]), float(normal[r, 1]), float(normal[r, 2])
        row = table.cells[cell[r], 0] if cell[r] >= 0 else -1
        total, lost = 0.0, 0.0
        for d in range(len(bright)):
            dx, dy, dz = direction[d, 0], direction[d, 1], direction[d, 2]
            weight = (nx * dx + ny * dy + nz * dz) * bright[d]
            if weight <= 0:
                continue
            if row >= 0:
                weight *= (table.patches[row, patch[d]] + 1.0) / 256.0
            total += weight
            if _blocked(boxes, entry, px, py, pz, dx, dy, dz):
                lost += weight
        if lost > 0:
            out[r] = np.uint8(255.0 * (1.0 - lost / total) + 0.5)


@nb.njit(cache=True, error_model="numpy")
def _near(boxes, entry, px, py, pz):
    """The first of the vehicles listed from an entry on that is within reach; −1 if none is."""
    while boxes.listed[entry] >= 0:
        k = boxes.listed[entry]
        qx, qy, qz = px - boxes.origin[k, 0], py - boxes.origin[k, 1], pz - boxes.origin[k, 2]
        near = True
        for c in range(3):
            at = boxes.axes[k, c, 0] * qx + boxes.axes[k, c, 1] * qy + boxes.axes[k, c, 2] * qz
            near &= boxes.low[k, c] - REACH_M < at < boxes.high[k, c] + REACH_M
        if near:
            return entry
        entry += 1
    return -1


@nb.njit(cache=True, error_model="numpy")
def _blocked(boxes, entry, px, py, pz, dx, dy, dz):
    """Whether a ray meets one of the boxes listed from an entry on."""
    while boxes.listed[entry] >= 0:
        k = boxes.listed[entry]
        qx, qy, qz = px - boxes.origin[k, 0], py - boxes.origin[k, 1], pz - boxes.origin[k, 2]
        near, far = 0.0, 1e9
        for c in range(3):
            a, b, e = boxes.axes[k, c, 0], boxes.axes[k, c, 1], boxes.axes[k, c, 2]
            at, along = a * qx + b * qy + e * qz, a * dx + b * dy + e * dz
            if abs(along) < 1e-9:
                along = 1e-9
            one, other = (boxes.low[k, c] - at) / along, (boxes.high[k, c] - at) / along
            near, far = max(near, min(one, other)), min(far, max(one, other))
        if near < far:
            return True
        entry += 1
    return False


@dataclass(frozen=True)
class LightAround:
    """Look-ups of a frame's surfaces and of what is mirrored in them; see `Hits` for the fields."""

    table: ProbeTable
    cell: Int[Array, "ray"]
    part: Int[Array, "ray 2"]
    sky_view: Float[Array, "ray"]
    sky_here: Float[Array, "ray"]
    sky_left: Int[Array, "ray"]
    mirrored: Lookup
    mirrored_left: Int[Array, "mirrored"]


def light_around(scene: Lit, seen, there: SurfaceHits) -> LightAround:
    """Look up, and where needed find, the probes around every surface of a frame.

    Parameters
    ----------
    scene
        With its instances placed, as they are when this returns.
    seen
        SurfaceHits of the frame: `Samples` or `SurfaceHits`.
    there
        What surfaces mirror whose mirrored ray was followed.
    """
    tracer, snapshot = scene.tracer, scene.snapshot
    fixed, known = snapshot.fixed, tracer.probes.toward(scene.sun, scene.surroundings)
    model = np.asarray(snapshot.model)
    transforms = np.ascontiguousarray(snapshot.transforms, np.float64).reshape(-1, 3, 4)
    role = tracer.role[model] if len(model) else np.zeros(0, np.int8)
    role[fixed:] = BY_SIDES
    role[(role == BY_SIDES) & (np.ptp(tracer.boxes[model, :, 0], axis=1) > LONG_M)] = BY_HALVES
    standing = np.flatnonzero(role[:fixed] >= BY_SIDES)
    body = np.full(len(role), -1, np.int32)
    centre = tracer.boxes[model].mean(axis=1) if len(model) else np.zeros((0, 3))
    middle = np.einsum("kij,kj->ki", transforms[:, :, :3], centre) + transforms[:, :, 3]
    follow_still = partial(_follow, replace(scene, past="still"))
    body[standing] = known.stand(Bodies(transforms[standing], tracer.boxes[model[standing]]), follow_still)

    def surfaces(of, some: Array | slice = slice(None)) -> LitSurfaces:
        point, normal, material, instance = (
            np.ascontiguousarray(x[some]) for x in (of.point, of.normal, of.material, of.instance)
        )
        instances = role, body, tracer.sheets, transforms, middle
        return LitSurfaces(point, normal, material, instance, *instances)

    both = [known.look(surfaces(of), follow_still) for of in (seen, there)]
    on_moving = [np.flatnonzero(of.instance >= fixed) for of in (seen, there)]
    met = [of.instance[rays] for of, rays in zip((seen, there), on_moving, strict=True)]
    moving = np.unique(np.concatenate(met))
    table = known.table
    if len(moving):
        bodies = Bodies(transforms[moving], tracer.boxes[model[moving]])
        new, cells = known.probe_moving(bodies, partial(_follow, scene))
        body[moving] = cells
        table = joined(table, new)
        both = [
            found.with_rays(rays, known.look_in(surfaces(of, rays), table))
            for found, of, rays in zip(both, (seen, there), on_moving, strict=True)
        ]
    first, mirrored = both
    moved = Bodies(transforms[fixed:], tracer.boxes[model[fixed:]])
    left, left_there = (
        sky_left(of, found, table, moved, fixed, known.rays)
        for of, found in ((seen, first), (there, mirrored))
    )
    view = first.sky_view * (left / np.float32(255))
    return LightAround(
        table=table,
        cell=first.cell,
        part=first.part,
        sky_view=view,
        sky_here=first.sky_here,
        sky_left=left,
        mirrored=mirrored,
        mirrored_left=left_there,
    )


def _follow(scene: Lit, origins: Array, directions: Array) -> Met:
    """What rays of probes meet."""
    there = scene.meet(origins, origins, directions)
    return Met(
        there.material, scene.sunlight(there) * there.sun_cosine, there.point, there.normal, there.range_m
    )
