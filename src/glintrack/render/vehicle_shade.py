"""The light of the sky that vehicles which move take from what lies beside them.

A box stands for a vehicle. Around it the rays of a probe are followed from each surface point, weighed with a
clear sky's usual brightness about the sun and with what of their patches stands open; what the box blocks is
lost.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.render.probe_table import ProbeTable
from glintrack.render.probes import Bodies, Lookup
from glintrack.render.sky_patches import PatchRays

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
        Surfaces, and what lights them.
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
    return _Boxes(low, high, axes, np.ascontiguousarray(origin), corner, start, np.array(listed, np.int32))


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _fill_left(begin, stop, surfaces, table, boxes, first, sky, out):
    direction, bright, patch = sky
    point, normal, material, instance, cell = surfaces
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
