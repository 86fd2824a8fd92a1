"""Light of sky and surroundings on the surfaces of a frame: probes of fixed and of moving instances.

A box represents each moving vehicle. Around it the rays of a probe are followed from each surface point. They
are weighted with a clear sky's usual brightness about the sun and with the open part of their patches. The
light of the rays that the box blocks is lost.
"""

import math
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.render.light.gather import Met
from glintrack.render.light.lattice import BY_HALVES, BY_SIDES, LONG_M
from glintrack.render.light.probes import (
    Bodies,
    LitSurfaces,
    Lookup,
    ProbeTable,
    concatenate_tables,
    probe_bodies,
)
from glintrack.render.light.sky import PatchRays
from glintrack.render.tracer import SunlitScene

REACH = 3.0  # heights from the sides: beyond are 1 % of an overcast, 7 % of a clear sky with a low sun
_CELL_M = 8.0


class _Boxes(NamedTuple):
    """Vehicles as boxes, and a list of those that reach into each cell of a grid."""

    low: Float[Array, "body 3"]
    high: Float[Array, "body 3"]
    reach: Float[Array, "body"]
    axes: Float[Array, "body 3 3"]
    origin: Float[Array, "body 3"]
    corner: Float[Array, "2"]
    start: Int[Array, "row column"]
    listed: Int[Array, "entry"]


def traffic_sky_factor(
    seen: LitSurfaces, found: Lookup, table: ProbeTable, bodies: Bodies, first: int, rays: PatchRays
) -> Int[Array, "ray"]:
    """`Hits.sky_left` of every surface [1/255]; moving vehicles are the instances from ``first`` on."""
    out = np.full(len(seen.point), 255, np.uint8)
    if len(bodies.transforms) == 0:
        return out
    up = rays.patch >= 0
    direction = rays.direction[0, up].astype(float)
    bright = (rays.solid_angle * rays.brightness[0])[up].astype(float)
    sky = direction, bright, rays.patch[up]
    over_rows(_fill_factor, len(out), seen, found.cell, table, _boxes(bodies), first, sky, out, least=1024)
    return out


def _boxes(bodies: Bodies) -> _Boxes:
    turn, origin = bodies.transforms[:, :, :3], bodies.transforms[:, :, 3]
    low, high = bodies.boxes[:, 0], bodies.boxes[:, 1]
    beside = REACH * (high[:, 2] - low[:, 2])
    reach = np.linalg.norm(np.maximum(np.abs(low), np.abs(high))[:, :2], axis=1) + beside
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
    return _Boxes(
        low=low,
        high=high,
        reach=beside,
        axes=np.ascontiguousarray(turn.transpose(0, 2, 1)),
        origin=np.ascontiguousarray(origin),
        corner=corner,
        start=start,
        listed=np.array(listed, np.int32),
    )


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _fill_factor(begin, stop, seen, cell, table, boxes, first, sky, out):
    point, normal, (direction, bright, patch) = seen.point, seen.normal, sky
    start, corner = boxes.start, boxes.corner
    for r in range(begin, stop):
        if seen.material[r] < 0 or seen.instance[r] >= first:
            continue
        px, py, pz = float(point[r, 0]), float(point[r, 1]), float(point[r, 2])
        i, j = math.floor((px - corner[0]) / _CELL_M), math.floor((py - corner[1]) / _CELL_M)
        if i < 0 or j < 0 or i >= start.shape[0] or j >= start.shape[1] or start[i, j] < 0:
            continue
        entry = _next_box(boxes, start[i, j], px, py, pz)
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
            if _blocks(boxes, entry, px, py, pz, dx, dy, dz):
                lost += weight
        if lost > 0:
            out[r] = np.uint8(255.0 * (1.0 - lost / total) + 0.5)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _next_box(boxes, entry, px, py, pz):
    """Find the first vehicle within reach that is listed from an entry on; −1 for none."""
    while boxes.listed[entry] >= 0:
        k = boxes.listed[entry]
        qx, qy, qz = px - boxes.origin[k, 0], py - boxes.origin[k, 1], pz - boxes.origin[k, 2]
        near = True
        for c in range(3):
            at = boxes.axes[k, c, 0] * qx + boxes.axes[k, c, 1] * qy + boxes.axes[k, c, 2] * qz
            near &= boxes.low[k, c] - boxes.reach[k] < at < boxes.high[k, c] + boxes.reach[k]
        if near:
            return entry
        entry += 1
    return -1


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _blocks(boxes, entry, px, py, pz, dx, dy, dz):
    """Return True if a ray meets one of the boxes listed from an entry on."""
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


class SurfaceLight(NamedTuple):
    """Probes, their look-up for some surfaces, and `Hits.sky_left` of those."""

    table: ProbeTable
    found: Lookup
    sky_left: Int[Array, "ray"]


def light_around(scene: SunlitScene, *surfaces: Any) -> SurfaceLight:
    """Look up, and where needed create, the probes around groups of surfaces (with fields of `SurfaceHits`).

    The instances of the scene must be placed, and are placed in the same way on return.
    """
    point, normal, material, instance = (
        np.concatenate([getattr(group, name) for group in surfaces])
        for name in ("point", "normal", "material", "instance")
    )
    tracer, snapshot = scene.tracer, scene.snapshot
    fixed, probes = snapshot.fixed, tracer.probes.toward(scene.sun, scene.surroundings)
    model = np.asarray(snapshot.model)
    transforms = np.ascontiguousarray(snapshot.transforms, np.float64).reshape(-1, 3, 4)
    role = tracer.role[model] if len(model) else np.zeros(0, np.int8)
    role[fixed:] = BY_SIDES
    role[(role == BY_SIDES) & (np.ptp(tracer.boxes[model, :, 0], axis=1) > LONG_M)] = BY_HALVES
    standing, moving = np.flatnonzero(role[:fixed] >= BY_SIDES), np.unique(instance[instance >= fixed])
    body = np.full(len(role), -1, np.int32)
    centre = tracer.boxes[model].mean(axis=1) if len(model) else np.zeros((0, 3))
    middle = np.einsum("kij,kj->ki", transforms[:, :, :3], centre) + transforms[:, :, 3]
    still = partial(_follow, replace(scene, past="still"))
    body[standing] = probes.probe_standing(Bodies(transforms[standing], tracer.boxes[model[standing]]), still)
    seen = LitSurfaces(*(point, normal, material, instance), *(role, body, tracer.sheets, transforms, middle))
    found, table = probes.look(seen, still), probes.table
    if len(moving):
        bodies = Bodies(transforms[moving], tracer.boxes[model[moving]])
        own, body[moving] = probe_bodies(bodies, probes.rays, probes.shares, partial(_follow, scene), table)
        table = concatenate_tables(table, own)
        probes.look_up(seen, np.flatnonzero(instance >= fixed), table, found)
    traffic = Bodies(transforms[fixed:], tracer.boxes[model[fixed:]])
    return SurfaceLight(table, found, traffic_sky_factor(seen, found, table, traffic, fixed, probes.rays))


def _follow(scene: SunlitScene, origins: Array, directions: Array) -> Met:
    """Find the surfaces that rays of probes meet, and their sunlight."""
    there = scene.meet(origins, origins, directions)
    sun = scene.sunlight(there) * there.sun_cosine
    return Met(there.material, sun, there.point, there.normal, there.range_m)
