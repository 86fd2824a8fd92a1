"""Geometry once: where each element's rays land, and what stands between those points, the sun and the sky.

Nothing here depends on wavelength, filter, tracker or reported pose. Every element gets an even grid of rays;
where a function of what they met asks for it (`sampling.further_rays`), a second, finer one.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.camera import Camera, Pose, rotation
from glintrack.core.arrays import Array
from glintrack.core.distortion import undistort
from glintrack.core.parallel import one_thread, over_rows
from glintrack.render.hits import PROBES, Hits
from glintrack.render.light_around import LightAround, light_around
from glintrack.render.probe_lookup import BY_SIDES, OPEN
from glintrack.render.rays.lit import Lit
from glintrack.render.rays.resolve import NO_HIT, SHADOW_OFFSET_M, Surfaces
from glintrack.render.rays.tracer import SceneTracer, build_tracer
from glintrack.render.samples import Samples, in_order, join_samples, merge_rays
from glintrack.scene import Snapshot

Further = Callable[[Samples], Int[Array, "element"]]  # from first samples to the side of the second grid
_RAYS_AT_A_TIME = 32768
_LOT = 16  # elements: whole packets of rays
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
    further: Further | None = None,
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
    further
        Given what those rays met, how many more each element gets along each side, 0 for none; their grid is
        even too, and all rays of an element count the same.
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
    chosen = _in_tiles(camera.rows, camera.columns) if elements is None else np.asarray(elements, np.int64)
    with tracer.placed(snapshot):
        if _is_below_ground(tracer, snapshot, pose):
            raise ValueError(f"`pose.up_m` must be above the ground, got {pose.up_m:g} m")
        return _traced(follow, chosen, oversampling, further)


def _traced(
    follow: "_Follower", chosen: Int[Array, "chosen"], oversampling: int, further: Further | None
) -> Hits:
    """Hits of some elements, whose scene is placed."""
    count = follow.camera.rows * follow.camera.columns
    parts, rays = [follow(chosen, oversampling)], np.zeros(count, np.int64)
    rays[chosen] = oversampling**2
    if further is not None:
        side = further(parts[0])
        for n in np.unique(side[chosen][side[chosen] > 0]).tolist():
            again = chosen[side[chosen] == n]
            parts.append(follow(again, n))
            rays[again] += n * n
    return _hits(follow, join_samples(parts, count), rays)


def _hits(follow: "_Follower", seen: Samples, rays: Int[Array, "element"]) -> Hits:
    """Samples with what mirrors show, and where light from sky and surroundings comes from."""
    camera, pose = follow.camera, follow.pose
    mirrored = _follow_mirrored(follow.scene, seen, pose.position)
    around = light_around(follow.scene, seen, mirrored.there)
    return Hits(
        rows=camera.rows,
        columns=camera.columns,
        detector_axis=rotation(pose)[0],
        rays=rays.astype(np.int16),
        first=np.concatenate([[0], np.cumsum(seen.count)]),
        weight=seen.rays / np.repeat(np.maximum(rays, 1), seen.count).astype(np.float32),
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
        """Samples of n × n rays of each element, in the frame's order.

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
                lots[first] = merge_rays(part, n * n, direction, seen, light, is_smooth)

        most = max(_RAYS_AT_A_TIME // (n * n * _LOT), 1)
        over_rows(follow, -(-len(elements) // _LOT), most=most)
        return in_order(list(lots.values()), self.camera.rows * self.camera.columns)


@lru_cache(maxsize=8)
def _in_tiles(rows: int, columns: int) -> Int[Array, "element"]:
    """Elements of a frame, those of a square of 4 × 4 after each other: rays traced together part less."""
    row, column = np.divmod(np.arange(rows * columns), columns)
    inner = ((row % 4 // 2) * 2 + column % 4 // 2) * 4 + row % 2 * 2 + column % 2
    return np.lexsort((inner, column // 4, row // 4))


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


@dataclass(frozen=True)
class _Mirrored:
    """What mirror-reflected rays meet: which samples sent them, what is there, material and sun of all."""

    samples: Array
    there: Surfaces
    material: Array
    sun: Array


def _follow_mirrored(scene: Lit, seen: Samples, lens: Float[Array, "3"]) -> _Mirrored:
    """Follow the mirror-reflected rays of smooth surfaces, and of all of vehicles."""
    count, smooth = len(seen.material), np.flatnonzero(seen.mirror >= 0)
    rough = _rough_of_vehicles(scene, seen)
    samples = np.concatenate([smooth, rough])
    material, sunlit = np.full(count, -1, np.int16), np.zeros(count, np.float32)
    if not samples.size:
        return _Mirrored(samples, Surfaces.empty(0), material, sunlit)
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
