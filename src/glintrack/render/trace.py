"""Geometry once: where each element's rays land, and what stands between those points, the sun and the sky.

Nothing here depends on wavelength, filter, tracker or reported pose. Every element gets an even grid of
rays.

Rays of an element that met the same plane (material, instance, normal and offset) are one sample; smooth
surfaces keep one for each ray, whose mirrored ray goes its own way.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.camera import Camera, Pose, rotation
from glintrack.core.arrays import Array
from glintrack.core.distortion import undistort
from glintrack.core.parallel import one_thread, over_rows
from glintrack.render.light.lattice import BY_SIDES, OPEN
from glintrack.render.rays.surfaces import NO_HIT, SHADOW_OFFSET_M, SurfaceHits
from glintrack.render.shading.hits import PROBES, Hits
from glintrack.render.shading.materials import MIRROR_ROUGHNESS
from glintrack.render.surface_light import LightAround, light_around
from glintrack.render.tracer import Lit, SceneTracer, build_tracer
from glintrack.scene import Snapshot

_SAME_PLANE_M = 0.1  # planes farther apart are two: a kerb is higher, and light beside it another


class Samples(NamedTuple):
    """What the rays of some elements met; see `Hits` for the fields not named here.

    Parameters
    ----------
    count
        Number of samples of each element, one element's after the other's.
    rays
        Number of rays that a sample stands for.
    instance
        Which of the snapshot's instances was met; −1 for the static mesh and for none.
    mirror
        Where a smooth sample's ray stands in the last two fields; −1 for rough ones.
    smooth_direction, smooth_lifted
        Of smooth samples: the ray's own direction, and where its mirrored ray starts. [1, m]
    """

    count: Int[Array, "chosen"]
    rays: Float[Array, "sample"]
    point: Float[Array, "sample 3"]
    normal: Float[Array, "sample 3"]
    range_m: Float[Array, "sample"]
    material: Int[Array, "sample"]
    vehicle_id: Int[Array, "sample"]
    instance: Int[Array, "sample"]
    sun_visible: Float[Array, "sample"]
    mirror: Int[Array, "sample"]
    smooth_direction: Float[Array, "smooth 3"]
    smooth_lifted: Float[Array, "smooth 3"]


def merge_rays(
    elements: int,
    n: int,
    direction: Float[Array, "ray 3"],
    seen: SurfaceHits,
    light: Float[Array, "ray"],
    is_smooth: Bool[Array, "material"],
) -> Samples:
    """Merge the rays of some elements to samples.

    Parameters
    ----------
    elements, n
        Number of elements, and of the rays of each, one element's after the other's.
    direction, seen, light
        Of the rays: where they go, what they met, and the part of the sun's light that arrives there.
    is_smooth
        Materials whose mirrored ray is followed.
    """
    rays = len(direction)
    out = Samples(
        count=np.zeros(elements, np.int64),
        rays=np.empty(rays, np.float32),
        point=np.empty((rays, 3), np.float32),
        normal=np.empty((rays, 3), np.float32),
        range_m=np.empty(rays, np.float32),
        material=np.empty(rays, np.int16),
        vehicle_id=np.empty(rays, np.int32),
        instance=np.empty(rays, np.int32),
        sun_visible=np.empty(rays, np.float32),
        mirror=np.empty(rays, np.int32),
        smooth_direction=np.empty((rays, 3), np.float32),
        smooth_lifted=np.empty((rays, 3), np.float32),
    )
    samples, smooth = _merge(n, direction, seen, light, is_smooth, out)
    own = [values[:samples].copy() for values in out[1:-2]]
    return Samples(out.count, *own, *(values[:smooth].copy() for values in out[-2:]))


def concatenate_samples(lots: list[Samples]) -> Samples:
    """Samples of the elements of several lots, one lot's after the other's."""
    smooth = np.cumsum([0, *(len(lot.smooth_lifted) for lot in lots)])
    moved = [
        lot._replace(mirror=np.where(lot.mirror >= 0, lot.mirror + np.int32(start), np.int32(-1)))
        for lot, start in zip(lots, smooth[:-1].tolist(), strict=True)
    ]
    return Samples(*(np.concatenate(values) for values in zip(*moved, strict=True)))


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _merge(n, direction, seen, light, is_smooth, out):
    sample = smooth = 0
    for k in range(len(out.count)):
        begin = sample
        for ray in range(k * n, (k + 1) * n):
            material = seen.material[ray]
            mirrors = material >= 0 and is_smooth[material]
            if not mirrors:
                same = sample - 1
                while same >= begin and not _is_same(out, same, seen, ray):
                    same -= 1
                if same >= begin:
                    _add(out, same, seen.point[ray], seen.range_m[ray], light[ray])
                    continue
            out.rays[sample], out.range_m[sample], out.sun_visible[sample] = (
                1.0,
                seen.range_m[ray],
                light[ray],
            )
            out.material[sample], out.instance[sample] = material, seen.instance[ray]
            out.vehicle_id[sample] = seen.vehicle_id[ray]
            out.mirror[sample] = smooth if mirrors else -1
            for c in range(3):
                out.point[sample, c], out.normal[sample, c] = seen.point[ray, c], seen.normal[ray, c]
                if mirrors:
                    out.smooth_direction[smooth, c] = direction[ray, c]
                    out.smooth_lifted[smooth, c] = seen.lifted[ray, c]
            sample, smooth = sample + 1, smooth + (1 if mirrors else 0)
        out.count[k] = sample - begin
    return sample, smooth


@nb.njit(cache=True, forceinline=True)
def _is_same(these, one, those, other):
    """Whether two met the same plane of the same thing."""
    same = (
        these.material[one] == those.material[other]
        and these.instance[one] == those.instance[other]
        and these.normal[one, 0] == those.normal[other, 0]
        and these.normal[one, 1] == those.normal[other, 1]
        and these.normal[one, 2] == those.normal[other, 2]
    )
    if not same:
        return False
    apart = np.float32(0.0)
    for c in range(3):
        apart += these.normal[one, c] * (those.point[other, c] - these.point[one, c])
    return abs(apart) < _SAME_PLANE_M


@nb.njit(cache=True, forceinline=True, error_model="numpy")
def _add(out, k, point, range_m, light):
    """Take one more ray into a sample's means."""
    out.rays[k] += np.float32(1.0)
    part = np.float32(1.0) / out.rays[k]
    if np.isfinite(range_m):
        out.range_m[k] += part * (range_m - out.range_m[k])
    out.sun_visible[k] += part * (light - out.sun_visible[k])
    for c in range(3):
        out.point[k, c] += part * (point[c] - out.point[k, c])


_RAYS_AT_A_TIME = 32768
_LOT = 16  # elements: whole packets of rays


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
    elements: Int[Array, "chosen"] | None = None,
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
        GGX α of each material; those under `MIRROR_ROUGHNESS`, and all of vehicles, get a reflected ray. [1]
    surroundings
        Material of the level ground beyond the scene's edge, seen by rays that miss everything.
    oversampling
        Rays along each side of an element.
    tracer
        From `build_tracer`, kept over the frames; built here if none is given.
    sun_samples
        Points of the sun's disc toward which shadow rays go; by default its centre alone: shadows are sharp.
        What a mirror shows is lit by the centre in any case.
    elements
        Numbers of the elements to trace, row by row; the whole frame by default.

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
    sun = np.asarray(sun_direction, dtype=np.float32)
    follow = _Follower(
        Lit(tracer, snapshot, surroundings, sun), camera, pose, np.asarray(roughness), sun_samples
    )
    count = camera.rows * camera.columns
    chosen = np.arange(count) if elements is None else np.unique(np.asarray(elements, np.int64))
    with tracer.placed(snapshot):
        if _is_below_ground(tracer, snapshot, pose):
            raise ValueError(f"`pose.up_m` must be above the ground, got {pose.up_m:g} m")
        return _hits(follow, chosen, follow(chosen, oversampling), oversampling**2)


def _hits(follow: "_Follower", chosen: Int[Array, "chosen"], seen: Samples, rays_each: int) -> Hits:
    """Samples of some elements with what mirrors show, and the probes that light them."""
    camera, pose = follow.camera, follow.pose
    count = camera.rows * camera.columns
    rays, samples = np.zeros(count, np.int16), np.zeros(count, np.int64)
    rays[chosen], samples[chosen] = rays_each, seen.count
    mirrored = _follow_mirrored(follow.scene, seen, pose.position)
    around = light_around(follow.scene, seen, mirrored.there)
    return Hits(
        rows=camera.rows,
        columns=camera.columns,
        detector_axis=rotation(pose)[0],
        rays=rays,
        first=np.concatenate([[0], np.cumsum(samples)]),
        weight=seen.rays / np.float32(rays_each),
        look=frame_rays(camera, pose),
        point=seen.point,
        normal=seen.normal,
        range_m=seen.range_m,
        material=seen.material,
        vehicle_id=seen.vehicle_id,
        sun_visible=seen.sun_visible,
        sky_view=around.sky_view,
        sky_here=around.sky_here,
        sky_left=around.sky_left,
        light_cell=around.cell,
        light_part=around.part,
        mirror_material=mirrored.material,
        mirror_sun=mirrored.sun,
        **_spread_mirrored(mirrored, around),
        **{name: getattr(around.table, name.removeprefix("probe_")) for name in PROBES},
    )


@dataclass(frozen=True)
class _Follower:
    """Follows the rays of some elements to a scene and on to the sun."""

    scene: Lit
    camera: Camera
    pose: Pose
    roughness: Array
    sun_samples: int

    def __call__(self, elements: Int[Array, "chosen"], n: int) -> Samples:
        """Samples of n × n rays of each element, one element's after the other's.

        Some elements at a time, each lot on one core: what lies between the steps stays in the cache.
        """
        look = _looker(self.camera, self.pose)
        start = self.pose.position.astype(np.float32)[None]
        is_smooth = self.roughness < MIRROR_ROUGHNESS
        lots: dict[int, Samples] = {}

        def follow(first: int, last: int) -> None:
            part = elements[first * _LOT : last * _LOT]
            direction = np.empty((len(part) * n * n, 3), np.float32)
            look(part, n, direction)
            with one_thread():
                seen = self.scene.meet(self.pose.position[None], start, direction, coherent=True)
                light = self.scene.sunlight(seen, self.sun_samples, coherent=True)
                lots[first] = merge_rays(len(part), n * n, direction, seen, light, is_smooth)

        most = max(_RAYS_AT_A_TIME // (n * n * _LOT), 1)
        over_rows(follow, -(-len(elements) // _LOT), most=most)
        return concatenate_samples([lots[first] for first in sorted(lots)])


def _is_below_ground(tracer: SceneTracer, snapshot: Snapshot, pose: Pose) -> bool:
    """Whether the lens looks up at the back of a surface and does not stand over the front of another.

    Over the scene's edge the ground is level at height 0. A lens under a bridge or a crown has a street below
    it; one in a building sees its roof's back, and is refused unless the building has a floor.
    """
    vertical = np.array([[0, 0, 1], [0, 0, -1]], np.float32)
    origin = pose.position.astype(np.float32)[None]
    met = tracer.rays.intersect(origin, vertical)
    rise = [tracer.faces.facing_up(int(p), int(s), snapshot) for p, s in zip(met.face, met.slot, strict=True)]
    if (met.face == NO_HIT).all():
        return pose.up_m <= 0
    return rise[0] > 0 and not rise[1] > 0


@dataclass(frozen=True)
class _Mirrored:
    """What mirror-reflected rays meet: which samples sent them, what is there, material and sun of all."""

    samples: Array
    there: SurfaceHits
    material: Array
    sun: Array


def _follow_mirrored(scene: Lit, seen: Samples, lens: Float[Array, "3"]) -> _Mirrored:
    """Follow the mirror-reflected rays of smooth surfaces, and of all of vehicles."""
    count, smooth = len(seen.material), np.flatnonzero(seen.mirror >= 0)
    rough = _rough_of_vehicles(scene, seen)
    samples = np.concatenate([smooth, rough])
    material, sunlit = np.full(count, -1, np.int16), np.zeros(count, np.float32)
    if not samples.size:
        return _Mirrored(samples, SurfaceHits.empty(0), material, sunlit)
    which, normal = seen.mirror[smooth], seen.normal[samples]
    along = (seen.point[rough] - lens).astype(np.float32)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    along = np.concatenate([seen.smooth_direction[which], along])
    off = seen.point[rough] + np.float32(SHADOW_OFFSET_M) * seen.normal[rough]
    lifted = np.concatenate([seen.smooth_lifted[which], off])
    there = scene.meet(lifted, lifted, along - 2 * np.einsum("ij,ij->i", along, normal)[:, None] * normal)
    material[samples] = there.material
    sunlit[samples] = scene.sunlight(there) * np.maximum(there.sun_cosine, 0)
    return _Mirrored(samples, there, material, sunlit)


def _rough_of_vehicles(scene: Lit, seen: Samples) -> Int[Array, "rough"]:
    """Samples on rough surfaces of vehicles: low down, they mirror the vehicle's own shadow."""
    if not scene.snapshot.models:
        return np.zeros(0, np.int64)
    vehicle = scene.tracer.role[np.asarray(scene.snapshot.model)] == BY_SIDES
    vehicle[scene.snapshot.fixed :] = True
    on_models = np.flatnonzero((seen.instance >= 0) & (seen.mirror < 0))
    return on_models[vehicle[seen.instance[on_models]]]


def _spread_mirrored(mirrored: _Mirrored, around: LightAround) -> dict[str, Array]:
    """Fields of `Hits` for all samples from what the look-up says of those that were mirrored."""
    count, some, there, found = len(mirrored.material), mirrored.samples, mirrored.there, around.mirrored
    sky, cell = np.zeros(count, np.float32), np.full(count, OPEN, np.int32)
    part, left = np.zeros((count, 2), np.uint8), np.full(count, 255, np.uint8)
    here = np.ones(count, np.float32)
    sky[some] = np.where(there.material >= 0, 0.5 * (1 + there.normal[:, 2]) * found.sky_view, 0)
    cell[some], part[some] = found.cell, found.part
    here[some], left[some] = found.sky_here, around.mirrored_left
    fields = {"sky": sky, "here": here, "left": left, "cell": cell, "part": part}
    return {f"mirror_{name}": values for name, values in fields.items()}


def frame_rays(camera: Camera, pose: Pose) -> Float[Array, "element 3"]:
    """Direction of look of every element, row by row, as `camera.rays` has them."""
    return element_rays(camera, pose, np.arange(camera.rows * camera.columns), 1)


def element_rays(camera: Camera, pose: Pose, elements: Int[Array, "chosen"], n: int) -> Float[Array, "ray 3"]:
    """Directions of an even grid of n × n rays of some elements, one element's after the other's."""
    out = np.empty((len(elements) * n * n, 3), np.float32)
    _looker(camera, pose)(np.asarray(elements, np.int64), n, out)
    return out


def _looker(camera: Camera, pose: Pose) -> Callable[[Array, int, Array], None]:
    """What writes the directions of n × n rays of some elements."""
    row, column = camera.principal_point
    scale = camera.pitch_m / camera.focal_length_m
    lens, axes = camera.bending, rotation(pose)

    def look(elements: Array, n: int, out: Array) -> None:
        _look(elements, n, camera.columns, row, column, scale, axes, lens, out)

    return look


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _look(elements, n, columns, top, left, step, axes, lens, out):
    """Rays of some elements, through the lens if there is one (`distortion.undistort`)."""
    first = 0.5 / n - 0.5  # of an element's rays, from its centre
    ray = 0
    for k in range(len(elements)):
        row = elements[k] // columns
        column = elements[k] - row * columns
        for down in range(n):
            for right in range(n):
                x = (column + first + right / n - left) * step
                y = (top - row - first - down / n) * step
                if lens.size > 0:
                    x, below = undistort(x, -y, lens)
                    y = -below
                scale = 1.0 / math.sqrt(x * x + y * y + 1.0)
                for c in range(3):
                    out[ray, c] = (x * axes[0, c] + y * axes[1, c] - axes[2, c]) * scale
                ray += 1
