"""Geometry once: where each element's ray lands, and what stands between that point, the sun and the sky.

Nothing here depends on wavelength, filter, tracker or reported pose.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numba as nb
import numpy as np
from jaxtyping import Float

from glintrack.arrays import Array
from glintrack.camera import Camera, Pose, rotation
from glintrack.distortion import undistort
from glintrack.parallel import one_thread, over_rows
from glintrack.render.hits import Hits
from glintrack.render.rays.resolve import NO_HIT, Surfaces, resolve
from glintrack.render.rays.tracer import SceneTracer, build_tracer
from glintrack.render.rays.tracer_protocol import TILE
from glintrack.scene import Snapshot

SUN_RADIUS_RAD = 4.65e-3  # mean angular radius, 959.6″
_RAYS_AT_A_TIME = 32768
MIRROR_ROUGHNESS = 0.1  # below this GGX α the reflected lobe is narrow enough to follow with one ray


def trace(
    snapshot: Snapshot,
    camera: Camera,
    pose: Pose,
    sun_direction: Float[Array, "3"],
    roughness: Float[Array, "material"],
    surroundings: int = 0,
    oversampling: int = 1,
    tracer: SceneTracer | None = None,
    sun_samples: int = 1,
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
    sun_samples
        Points of the sun's disc toward which shadow rays go; by default its centre alone: shadows are sharp.
        What a mirror shows is lit by the centre in any case.

    Raises
    ------
    ValueError
        If the pose is a reported one, the camera is not above the ground, or the scene is empty.
    """
    if pose.kind != "true":
        raise ValueError(f"`pose` must be a true pose to render with, got a {pose.kind} one")
    if sun_samples < 1:
        raise ValueError(f"`sun_samples` must be at least 1, got {sun_samples}")
    tracer = tracer or build_tracer(snapshot)
    tracer.place(snapshot)
    if _is_below_ground(tracer, snapshot, pose):
        raise ValueError(f"`pose.up_m` must be above the ground, got {pose.up_m:g} m")
    sun = np.asarray(sun_direction, dtype=np.float32)
    scene = _Lit(tracer, snapshot, surroundings, sun)
    seen = _look_around(scene, camera, pose, oversampling, np.asarray(roughness), sun_samples)
    sky_view, sky_behind = tracer.sky.view(
        seen.point, seen.normal, seen.material, oversampling, tracer.sheets
    )
    mirror_material, mirror_sun, mirror_sky = _follow_mirrored(scene, seen)
    return Hits(
        rows=camera.rows,
        columns=camera.columns,
        oversampling=oversampling,
        detector_axis=rotation(pose)[0],
        direction=seen.direction,
        point=seen.point,
        normal=seen.normal,
        range_m=seen.range_m,
        material=seen.material,
        vehicle_id=seen.vehicle_id,
        sun_visible=seen.sun_visible,
        sky_view=sky_view,
        sky_behind=sky_behind,
        mirror_material=mirror_material,
        mirror_sun=mirror_sun,
        mirror_sky=mirror_sky,
    )


@dataclass(frozen=True)
class _Lit:
    """A scene at one time under its sun, with its instances placed."""

    tracer: SceneTracer
    snapshot: Snapshot
    surroundings: int
    sun: Array

    def meet(
        self, origins: Array, starts: Array, directions: Array, width: int = 0, found: Surfaces | None = None
    ) -> Surfaces:
        """Surfaces that rays meet; ``starts`` are their origins in single precision."""
        met = self.tracer.rays.intersect(starts, directions, width)
        known = self.tracer.faces, self.snapshot, self.surroundings, self.sun, self.tracer.sheets
        return resolve(origins, directions, met, *known, found)

    def sunlight(self, seen: Surfaces, samples: int = 1, width: int = 0) -> Float[Array, "ray"]:
        """Part of the sun's light that arrives at each surface, by rays to points of its disc."""
        wanted = seen.sun_cosine != 0
        light = np.zeros(len(wanted), np.float32)
        for direction in _sun_disc(self.sun, samples):
            light += self.tracer.rays.transmitted(seen.lifted, direction[None], wanted, width)
        return light / np.float32(samples)


@dataclass(frozen=True)
class _Seen:
    """What the rays of a frame meet, and those of them whose mirrored rays are to be followed."""

    direction: Array
    point: Array
    normal: Array
    range_m: Array
    material: Array
    vehicle_id: Array
    sun_visible: Array
    smooth: Array
    smooth_lifted: Array


def _look_around(
    scene: _Lit, camera: Camera, pose: Pose, oversampling: int, roughness: Array, sun_samples: int
) -> _Seen:
    """Follow the rays of a frame to the scene and on to the sun.

    Some rows at a time, each on one core: what lies between the steps stays in the cache.
    """
    rows, width = camera.rows * oversampling, camera.columns * oversampling
    look = _looker(camera, pose, oversampling)
    start = pose.position.astype(np.float32)[None]
    whole, direction = Surfaces.empty(rows * width, keep_all=False), np.empty((rows * width, 3), np.float32)
    sun_visible = np.empty(rows * width, np.float32)
    is_smooth = roughness < MIRROR_ROUGHNESS
    smooth: dict[int, tuple[Array, Array]] = {}

    def follow(first: int, last: int) -> None:
        part = slice(first * width, last * width)
        look(first, last, direction)
        with one_thread():
            seen = scene.meet(pose.position[None], start, direction[part], width, whole.part(part))
            light = scene.sunlight(seen, sun_samples, width)
        sun_visible[part] = light
        mirrors = np.flatnonzero((seen.material >= 0) & is_smooth[seen.material])
        smooth[first] = part.start + mirrors, seen.lifted[mirrors]

    over_rows(follow, rows, least=TILE, most=max(_RAYS_AT_A_TIME // width, 1))
    found = [smooth[first] for first in sorted(smooth)]
    return _Seen(
        direction,
        whole.point,
        whole.normal,
        whole.range_m,
        whole.material,
        whole.vehicle_id,
        sun_visible,
        np.concatenate([index for index, _ in found]),
        np.concatenate([lifted for _, lifted in found]),
    )


def _is_below_ground(tracer: SceneTracer, snapshot: Snapshot, pose: Pose) -> bool:
    """Whether the lens looks up at the back of a surface and does not stand over the front of another.

    Over the scene's edge the ground is level at height 0. A lens under a bridge or a crown has a street below
    it; one in a building sees its roof's back, and is refused unless the building has a floor.
    """
    vertical = np.array([[0, 0, 1], [0, 0, -1]], np.float32)
    origin = pose.position.astype(np.float32)[None]
    _, primitives, slots, _ = tracer.rays.intersect(origin, vertical)
    rise = [tracer.faces.facing_up(int(p), int(s), snapshot) for p, s in zip(primitives, slots, strict=True)]
    if primitives[0] == NO_HIT and primitives[1] == NO_HIT:
        return pose.up_m <= 0
    return rise[0] > 0 and not rise[1] > 0


def _sun_disc(sun: Float[Array, "3"], samples: int) -> Float[Array, "sample 3"]:
    """Directions toward points spread evenly over the sun's disc; its centre if there is one. [1]"""
    k = np.arange(samples)
    across = 0.0 if samples == 1 else np.tan(SUN_RADIUS_RAD) * np.sqrt((k + 0.5) / samples)
    turn = math.pi * (3 - math.sqrt(5)) * k  # the golden angle: a sunflower's seeds
    level = np.array([-sun[1], sun[0], 0.0]) if abs(sun[2]) < 0.9 else np.array([0.0, -sun[2], sun[1]])
    level /= np.linalg.norm(level)
    offset = (across * np.cos(turn))[:, None] * level + (across * np.sin(turn))[:, None] * np.cross(
        sun, level
    )
    directions = sun + offset
    return (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)


def _follow_mirrored(scene: _Lit, seen: _Seen) -> tuple[Array, Array, Array]:
    """What the mirror-reflected rays of smooth surfaces meet: material, sun and sky there."""
    count, smooth = len(seen.direction), seen.smooth
    material = np.full(count, -1, np.int16)
    sunlit, sky = np.zeros(count, np.float32), np.zeros(count, np.float32)
    if smooth.size:
        normal, along = seen.normal[smooth], seen.direction[smooth]
        mirrored = along - 2 * np.einsum("ij,ij->i", along, normal)[:, None] * normal
        there = scene.meet(seen.smooth_lifted, seen.smooth_lifted, mirrored)
        view, _ = scene.tracer.sky.view(there.point, there.normal, there.material)
        material[smooth] = there.material
        sunlit[smooth] = scene.sunlight(there) * np.maximum(there.sun_cosine, 0)
        sky[smooth] = np.where(there.material >= 0, 0.5 * (1 + there.normal[:, 2]) * view, 0)
    return material, sunlit, sky


def frame_rays(camera: Camera, pose: Pose, oversampling: int) -> Float[Array, "ray 3"]:
    """Directions of look of every (sub-)element, row by row, as `camera.rays` has them."""
    rows = camera.rows * oversampling
    out = np.empty((rows * camera.columns * oversampling, 3), np.float32)
    over_rows(_looker(camera, pose, oversampling), rows, out)
    return out


def _looker(camera: Camera, pose: Pose, oversampling: int) -> Callable[[int, int, Array], None]:
    """What writes the directions of some rows of a frame."""
    n, (row, column) = oversampling, camera.principal_point
    first = 0.5 / n - 0.5  # of an element's rays, from its centre
    scale = camera.pitch_m / camera.focal_length_m
    corner = (row - first) * scale, (first - column) * scale
    width, lens, axes = camera.columns * n, camera.bending, rotation(pose)

    def look(start: int, stop: int, out: Array) -> None:
        _look(start, stop, width, *corner, scale / n, axes, lens, out)

    return look


@nb.njit(nogil=True, cache=True)
def _look(start, stop, width, top, left, step, axes, lens, out):
    """Rows of `frame_rays`, through the lens if there is one (`distortion.undistort`)."""
    for row in range(start, stop):
        for column in range(width):
            x, y = left + column * step, top - row * step
            if lens.size > 0:
                x, down = undistort(x, -y, lens)
                y = -down
            scale = 1.0 / math.sqrt(x * x + y * y + 1.0)
            for c in range(3):
                out[row * width + column, c] = (x * axes[0, c] + y * axes[1, c] - axes[2, c]) * scale
