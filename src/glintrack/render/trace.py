"""Geometry once: where each element's ray lands, and what stands between that point, the sun and the sky.

Nothing here depends on wavelength, filter, tracker or reported pose.
"""

from dataclasses import dataclass
from typing import Protocol

import numba as nb
import numpy as np
from jaxtyping import Bool, Float, Int

from ..camera import Camera, Pose, rays, rotation
from ..scene import Mesh, Snapshot
from ..threads import over_rows
from .embree import NO_HIT, EmbreeTracer

Array = np.ndarray

SHADOW_OFFSET_M = 3e-3  # float32 at 3 km needs 1–5 mm along the normal to clear its own facet
MIRROR_ROUGHNESS = 0.1  # below this GGX α the reflected lobe is narrow enough to follow with one ray


class Tracer(Protocol):
    """What `trace` asks of an intersector; `EmbreeTracer` is the one in use."""

    def update(self, transforms: Array, models: Array) -> None:
        """Place the moving instances."""
        ...

    def intersect(self, origins: Array, directions: Array) -> tuple[Array, Array, Array, Array]:
        """Nearest hits: range, primitive, slot, barycentric."""
        ...

    def occluded(self, origins: Array, directions: Array, wanted: Array) -> Array:
        """Whether anything lies ahead."""
        ...


@dataclass(frozen=True)
class Hits:
    """What each ray of a frame met; rays run row by row over the (oversampled) array.

    Parameters
    ----------
    rows, columns, oversampling
        Elements of the array, and rays along each side of an element.
    detector_axis
        The detector's +x in ENU, the reference axis of the ``detector`` Stokes frame. [1]
    direction
        Unit direction of look. [1]
    point
        Hit point in ENU. [m]
    normal
        Facet normal, turned toward the camera. [1]
    range_m
        Distance from the lens; infinite for sky. [m]
    material
        Index into the materials; −1 for sky.
    vehicle_id
        The vehicle hit, −1 for none.
    sun_visible
        The sun's centre can be seen from the point and shines on the facet's front.
    mirror_clear
        The mirror-reflected ray of a smooth surface leaves the scene without meeting anything.
    """

    rows: int
    columns: int
    oversampling: int
    detector_axis: Float[Array, "3"]
    direction: Float[Array, "ray 3"]
    point: Float[Array, "ray 3"]
    normal: Float[Array, "ray 3"]
    range_m: Float[Array, "ray"]
    material: Int[Array, "ray"]
    vehicle_id: Int[Array, "ray"]
    sun_visible: Bool[Array, "ray"]
    mirror_clear: Bool[Array, "ray"]


def build_tracer(snapshot: Snapshot) -> Tracer:
    """Acceleration structure of a scene's static mesh and models, to be used for every frame."""
    return EmbreeTracer(snapshot.static, snapshot.models)


def trace(
    snapshot: Snapshot,
    camera: Camera,
    pose: Pose,
    sun_direction: Float[Array, "3"],
    roughness: Float[Array, "material"],
    surroundings: int = 0,
    oversampling: int = 1,
    tracer: Tracer | None = None,
) -> Hits:
    """Follow one ray an element (or n×n) from the lens to the scene, and on to the sun and the sky.

    Parameters
    ----------
    snapshot
        The scene at one time.
    camera, pose
        The frame camera and its *true* pose.
    sun_direction
        Unit vector toward the sun, ENU. [1]
    roughness
        GGX α of each material; those under `MIRROR_ROUGHNESS` get a reflected ray. [1]
    surroundings
        Material of the level ground beyond the scene's edge, seen by rays that miss everything.
    oversampling
        Rays along each side of an element.
    tracer
        From `build_tracer`, kept over the frames; built here if none is given.

    Raises
    ------
    ValueError
        If the pose is a reported one, or the camera is not above the ground.
    """
    if pose.kind != "true":
        raise ValueError(f"`pose` must be a true pose to render with, got a {pose.kind} one")
    if pose.up_m <= 0:
        raise ValueError(f"`pose.up_m` must be above the ground, got {pose.up_m:g} m")
    tracer = tracer or build_tracer(snapshot)
    tracer.update(snapshot.transforms, snapshot.model)
    directions = _frame_rays(camera, pose, oversampling)
    origin = pose.position.astype(np.float32)[None]
    ranges, primitives, slots, barycentrics = tracer.intersect(origin, directions)

    point, normal = np.empty_like(directions), np.empty_like(directions)
    material = np.empty(len(ranges), np.int16)
    vehicle_id = np.empty(len(ranges), np.int32)
    vertices, corner, face_start, face_material = _concatenate(snapshot)
    over_rows(
        _resolve,
        len(ranges),
        pose.position,
        directions,
        ranges,
        primitives,
        slots,
        barycentrics,
        vertices,
        corner,
        face_start,
        face_material,
        np.asarray(snapshot.transforms, dtype=np.float64),
        np.asarray(snapshot.model, dtype=np.int64),
        np.asarray(snapshot.paint, dtype=np.int16),
        np.asarray(snapshot.vehicle_id, dtype=np.int32),
        np.int16(surroundings),
        point,
        normal,
        material,
        vehicle_id,
    )
    sun = np.asarray(sun_direction, dtype=np.float32)
    lifted = point + np.float32(SHADOW_OFFSET_M) * normal
    facing_sun = (material >= 0) & (normal @ sun > 0)
    sun_visible = facing_sun & ~tracer.occluded(lifted, sun[None], facing_sun)
    smooth = (material >= 0) & (np.asarray(roughness)[material] < MIRROR_ROUGHNESS)
    mirrored = directions - 2 * np.einsum("ij,ij->i", directions, normal)[:, None] * normal
    mirror_clear = ~tracer.occluded(lifted, mirrored, smooth)
    return Hits(
        camera.rows,
        camera.columns,
        oversampling,
        rotation(pose)[0],
        directions,
        point,
        normal,
        ranges,
        material,
        vehicle_id,
        sun_visible,
        mirror_clear,
    )


def _frame_rays(camera: Camera, pose: Pose, oversampling: int) -> Float[Array, "ray 3"]:
    """Directions of look of every (sub-)element, row by row."""
    if oversampling == 1:
        return rays(camera, pose).reshape(-1, 3).astype(np.float32)
    offsets = (np.arange(oversampling) + 0.5) / oversampling - 0.5
    row = (np.arange(camera.rows)[:, None] + offsets).ravel()
    column = (np.arange(camera.columns)[:, None] + offsets).ravel()
    pixels = np.stack(np.meshgrid(row, column, indexing="ij"), axis=-1)
    return rays(camera, pose, pixels).reshape(-1, 3).astype(np.float32)


def _concatenate(snapshot: Snapshot) -> tuple[Array, Array, Array, Array]:
    """All meshes in one set of arrays: mesh k's faces start at ``face_start[k]`` (0 is the static one)."""
    meshes: list[Mesh] = [snapshot.static, *snapshot.models]
    vertex_start = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    return (
        np.concatenate([np.asarray(m.vertices, dtype=np.float32).reshape(-1, 3) for m in meshes]),
        np.concatenate([m.faces.reshape(-1, 3) + s for m, s in zip(meshes, vertex_start, strict=False)]),
        np.cumsum([0, *(len(m.faces) for m in meshes)]),
        np.concatenate([np.asarray(m.material, dtype=np.int16) for m in meshes]),
    )


@nb.njit(nogil=True, cache=True)
def _resolve(
    start,
    stop,
    lens,
    directions,
    ranges,
    primitives,
    slots,
    barycentrics,
    vertices,
    corner,
    face_start,
    face_material,
    transforms,
    models,
    paints,
    vehicle_ids,
    surroundings,
    point,
    normal,
    material,
    vehicle_id,
):
    """Hit point from barycentrics (not from o + t·d, which is too coarse for shadows), normal and ids."""
    for i in range(start, stop):
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        vehicle_id[i] = -1
        if primitives[i] == NO_HIT:
            if dz < 0:  # level ground beyond the scene's edge
                distance = -lens[2] / dz
                ranges[i] = distance
                point[i, 0] = lens[0] + distance * dx
                point[i, 1] = lens[1] + distance * dy
                point[i, 2] = 0.0
                normal[i, 0], normal[i, 1], normal[i, 2] = 0.0, 0.0, 1.0
                material[i] = surroundings
            else:
                for c in range(3):
                    point[i, c], normal[i, c] = 0.0, 0.0
                material[i] = -1
            continue
        instance = np.int64(slots[i]) - 1
        mesh = 0 if instance < 0 else models[instance] + 1
        face = face_start[mesh] + np.int64(primitives[i])
        a, b, c3 = corner[face, 0], corner[face, 1], corner[face, 2]
        u, v = barycentrics[i, 0], barycentrics[i, 1]
        p, e, f = np.empty(3), np.empty(3), np.empty(3)
        for c in range(3):
            e[c] = vertices[b, c] - vertices[a, c]
            f[c] = vertices[c3, c] - vertices[a, c]
            p[c] = vertices[a, c] + u * e[c] + v * f[c]
        nx, ny, nz = e[1] * f[2] - e[2] * f[1], e[2] * f[0] - e[0] * f[2], e[0] * f[1] - e[1] * f[0]
        if instance >= 0:  # rigid motion: the normal turns as the body does
            t = transforms[instance]
            px = t[0, 0] * p[0] + t[0, 1] * p[1] + t[0, 2] * p[2] + t[0, 3]
            py = t[1, 0] * p[0] + t[1, 1] * p[1] + t[1, 2] * p[2] + t[1, 3]
            pz = t[2, 0] * p[0] + t[2, 1] * p[1] + t[2, 2] * p[2] + t[2, 3]
            p[0], p[1], p[2] = px, py, pz
            mx = t[0, 0] * nx + t[0, 1] * ny + t[0, 2] * nz
            my = t[1, 0] * nx + t[1, 1] * ny + t[1, 2] * nz
            mz = t[2, 0] * nx + t[2, 1] * ny + t[2, 2] * nz
            nx, ny, nz = mx, my, mz
            vehicle_id[i] = vehicle_ids[instance]
        length = (nx * nx + ny * ny + nz * nz) ** 0.5
        if length == 0.0:  # a sliver without area has no normal: let it face the camera
            nx, ny, nz, length = -dx, -dy, -dz, 1.0
        sign = -1.0 if nx * dx + ny * dy + nz * dz > 0 else 1.0
        for c in range(3):
            point[i, c] = p[c]
        normal[i, 0], normal[i, 1], normal[i, 2] = sign * nx / length, sign * ny / length, sign * nz / length
        m = face_material[face]
        material[i] = m if m >= 0 else paints[instance]
