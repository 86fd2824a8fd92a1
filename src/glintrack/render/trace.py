"""Geometry of a frame: the surfaces that each element's rays meet, and their light of sun and sky.

Nothing here depends on wavelength, filter, tracker or reported pose. Every element gets an even grid of rays.

Rays of an element that meet the same plane (material, instance, normal and offset) are one sample. Smooth
surfaces have one for each ray, because their mirrored rays differ.
"""

import math
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
from glintrack.render.surface_light import light_around
from glintrack.render.tracer import SceneTracer, SunlitScene, build_tracer
from glintrack.scene import Snapshot

_SAME_PLANE_M = 0.1  # planes farther apart are two: a kerb is higher, and has other light
_RAYS_AT_A_TIME = 32768
_LOT = 16  # elements: whole packets of rays


class Samples(NamedTuple):
    """Samples of some elements, one element's after the other's; see `Hits` for the fields not named here.

    Parameters
    ----------
    count
        Number of samples of each element.
    rays
        Number of rays of a sample.
    instance
        Index of the snapshot's instance; −1 for the static mesh and for none.
    is_smooth
        True for a sample of one ray, which is mirrored.
    direction, lifted
        Direction of the sample's first ray, and origin of its mirrored ray. [1, m]
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
    is_smooth: Bool[Array, "sample"]
    direction: Float[Array, "sample 3"]
    lifted: Float[Array, "sample 3"]


def _merge_rays(
    elements: int, direction: Float[Array, "ray 3"], seen: SurfaceHits, light: Array, is_smooth: Array
) -> Samples:
    """Merge the rays of some elements to samples, which take the place of the rays in their arrays.

    ``is_smooth`` are the materials with mirrored rays.
    """
    rays = len(direction)
    out = Samples(
        count=np.zeros(elements, np.int64),
        rays=np.empty(rays, np.float32),
        sun_visible=light,
        is_smooth=np.empty(rays, np.bool_),
        direction=direction,
        **{name: getattr(seen, name) for name in SurfaceHits._fields if name != "sun_cosine"},
    )
    samples = _merge(rays // max(elements, 1), seen, is_smooth, out)
    return Samples(out.count, *(values[:samples] for values in out[1:]))


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _merge(n, seen, is_smooth, out):
    """Move the first ray of each sample to its row, and average the others into it; return their number."""
    sample = 0
    for k in range(len(out.count)):
        begin = sample
        for ray in range(k * n, (k + 1) * n):
            material = seen.material[ray]
            mirrors = material >= 0 and is_smooth[material]
            same = begin - 1 if mirrors else sample - 1
            while same >= begin and not _is_same(out, same, seen, ray):
                same -= 1
            if same >= begin:
                out.rays[same] += np.float32(1.0)
                part = np.float32(1.0) / out.rays[same]
                if np.isfinite(seen.range_m[ray]):
                    out.range_m[same] += part * (seen.range_m[ray] - out.range_m[same])
                out.sun_visible[same] += part * (out.sun_visible[ray] - out.sun_visible[same])
                for c in range(3):
                    out.point[same, c] += part * (seen.point[ray, c] - out.point[same, c])
                continue
            out.rays[sample], out.is_smooth[sample] = 1.0, mirrors
            for values in (out.range_m, out.sun_visible):
                values[sample] = values[ray]
            for values in (out.vehicle_id, out.instance):
                values[sample] = values[ray]
            out.material[sample] = material
            for values in (out.point, out.normal, out.direction, out.lifted):
                for c in range(3):
                    values[sample, c] = values[ray, c]
            sample += 1
        out.count[k] = sample - begin
    return sample


@nb.njit(cache=True, forceinline=True)
def _is_same(these, one, those, other):
    """Return True if two rays met the same plane of the same thing."""
    same = these.material[one] == those.material[other] and these.instance[one] == those.instance[other]
    apart = np.float32(0.0)
    for c in range(3):
        same &= these.normal[one, c] == those.normal[other, c]
        apart += these.normal[one, c] * (those.point[other, c] - these.point[one, c])
    return same and abs(apart) < _SAME_PLANE_M


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
    """Trace one ray (or n × n) of each element from the lens to the scene, and on to the sun and the sky.

    Parameters
    ----------
    snapshot
        The scene at one time.
    camera, pose
        The frame camera and its *true* pose.
    sun_direction
        Unit vector toward the sun, ENU. [1]
    roughness
        GGX α of each material; those under `MIRROR_ROUGHNESS`, and all of vehicles, get a mirrored ray. [1]
    surroundings
        Material of the level ground beyond the scene's edge.
    oversampling
        Rays along each side of an element.
    tracer
        From `build_tracer`; built here by default.
    sun_samples
        Number of shadow rays, toward points of the sun's disc; by default its centre (sharp shadows).
        Mirrored surfaces are always lit by the centre.
    elements
        Numbers of the elements to trace, row by row; the whole frame by default.

    Raises
    ------
    ValueError
        If the pose is a reported one, the camera is not above the ground, or the scene is empty.
    """
    if pose.kind != "true":
        raise ValueError(f"`pose` must be a true pose to render with; got a {pose.kind} one.")
    if sun_samples < 1:
        raise ValueError(f"`sun_samples` must be at least 1; got {sun_samples}.")
    tracer = tracer or build_tracer(snapshot)
    sun = np.asarray(sun_direction, dtype=np.float32)
    scene = SunlitScene(tracer, snapshot, surroundings, sun)
    count = camera.rows * camera.columns
    chosen = np.arange(count) if elements is None else np.unique(np.asarray(elements, np.int64))
    is_smooth = np.asarray(roughness) < MIRROR_ROUGHNESS
    with tracer.hold(snapshot):
        if _is_below_ground(tracer, snapshot, pose):
            raise ValueError(f"`pose.up_m` must be above the ground; got {pose.up_m:g} m.")
        seen = _trace_elements(scene, camera, pose, chosen, oversampling, is_smooth, sun_samples)
        mirrored, there = _mirror(scene, seen, pose.position)
        around = light_around(scene, seen, there)
        sun_there = scene.sunlight(there) * np.maximum(there.sun_cosine, 0)
    rays, samples = np.zeros(count, np.int16), np.zeros(count, np.int64)
    rays[chosen], samples[chosen] = oversampling**2, seen.count
    total = len(seen.material)
    cell, part, view, here = (values[:total] for values in around.found)
    cell_there, part_there, view_there, here_there = (values[total:] for values in around.found)
    sky_there = np.where(there.material >= 0, 0.5 * (1 + there.normal[:, 2]) * view_there, 0)

    def spread(values: Array, elsewhere: float) -> Array:
        """Values of mirrored surfaces at the samples that mirror them."""
        out = np.full((total, *values.shape[1:]), elsewhere, values.dtype)
        out[mirrored] = values
        return out

    return Hits(
        rows=camera.rows,
        columns=camera.columns,
        detector_axis=rotation(pose)[0],
        rays=rays,
        first=np.concatenate([[0], np.cumsum(samples)]),
        weight=seen.rays / np.float32(oversampling**2),
        look=frame_rays(camera, pose),
        **{name: getattr(seen, name) for name in Samples._fields if name in Hits._fields and name != "rays"},
        sky_view=view * (around.sky_left[:total] / np.float32(255)),
        sky_here=here,
        sky_left=around.sky_left[:total],
        light_cell=cell,
        light_part=part,
        mirror_material=spread(there.material, -1),
        mirror_sun=spread(sun_there, 0),
        mirror_sky=spread(sky_there.astype(np.float32), 0),
        mirror_here=spread(here_there, 1),
        mirror_left=spread(around.sky_left[total:], 255),
        mirror_cell=spread(cell_there, OPEN),
        mirror_part=spread(part_there, 0),
        **{name: getattr(around.table, name.removeprefix("probe_")) for name in PROBES},
    )


def _trace_elements(
    scene: SunlitScene, camera: Camera, pose: Pose, elements: Int[Array, "chosen"], n: int, is_smooth: Array,
    sun_samples: int,
) -> Samples:  # fmt: skip
    """Trace n × n rays of each element to the scene and on to the sun.

    Some elements at a time, each lot on one core, so that its arrays stay in the processor's cache.
    """
    start, lots = pose.position.astype(np.float32)[None], dict[int, Samples]()

    def follow(first: int, last: int) -> None:
        part = elements[first * _LOT : last * _LOT]
        direction = element_rays(camera, pose, part, n)
        with one_thread():
            seen = scene.meet(pose.position[None], start, direction, coherent=True)
            light = scene.sunlight(seen, sun_samples, coherent=True)
            lots[first] = _merge_rays(len(part), direction, seen, light, is_smooth)

    over_rows(follow, max(-(-len(elements) // _LOT), 1), most=max(_RAYS_AT_A_TIME // (n * n * _LOT), 1))
    return Samples(*(np.concatenate(values) for values in zip(*(lots[k] for k in sorted(lots)), strict=True)))


def _is_below_ground(tracer: SceneTracer, snapshot: Snapshot, pose: Pose) -> bool:
    """Return True if the lens is under the back of a surface and not over the front of another.

    Beyond the scene's edge the ground is level at height 0. A lens under a bridge or a crown has a street
    below. One in a building is under its roof's back, and is refused unless the building has a floor.
    """
    vertical = np.array([[0, 0, 1], [0, 0, -1]], np.float32)
    origin = pose.position.astype(np.float32)[None]
    met = tracer.rays.intersect(origin, vertical)
    hit, faces = met.face != NO_HIT, tracer.faces
    if not hit.any():
        return pose.up_m <= 0
    slot, rise = met.slot[hit].astype(int), np.zeros(2)
    mesh = np.concatenate([[0], np.asarray(snapshot.model, int) + 1])[slot]
    a, b, c = faces.vertices[faces.corners[faces.start[mesh] + met.face[hit]]].astype(float).swapaxes(0, 1)
    upward = np.concatenate([np.eye(3, 4)[None], snapshot.transforms])[slot, 2, :3]
    rise[hit] = (upward * np.cross(b - a, c - a)).sum(axis=1)
    return bool(rise[0] > 0 and not rise[1] > 0)


def _mirror(
    scene: SunlitScene, seen: Samples, lens: Float[Array, "3"]
) -> tuple[Int[Array, "mirrored"], SurfaceHits]:
    """Trace the mirrored rays of smooth surfaces and of all of vehicles; return their samples and hits.

    Rough surfaces of vehicles are low and mirror the vehicle's own shadow.
    """
    rough = np.flatnonzero((seen.instance >= 0) & ~seen.is_smooth)
    if len(rough):
        is_vehicle = scene.tracer.role[np.asarray(scene.snapshot.model)] == BY_SIDES
        is_vehicle[scene.snapshot.fixed :] = True
        rough = rough[is_vehicle[seen.instance[rough]]]
    smooth = np.flatnonzero(seen.is_smooth)
    along = (seen.point[rough] - lens).astype(np.float32)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    along = np.concatenate([seen.direction[smooth], along])
    off = seen.point[rough] + np.float32(SHADOW_OFFSET_M) * seen.normal[rough]
    lifted, samples = np.concatenate([seen.lifted[smooth], off]), np.concatenate([smooth, rough])
    normal = seen.normal[samples]
    along = along - 2 * np.einsum("ij,ij->i", along, normal)[:, None] * normal
    return samples, scene.meet(lifted, lifted, along)


def frame_rays(camera: Camera, pose: Pose) -> Float[Array, "element 3"]:
    """Direction of look of every element, row by row, as from `camera.rays`. [1]"""
    return element_rays(camera, pose, np.arange(camera.rows * camera.columns), 1)


def element_rays(camera: Camera, pose: Pose, elements: Int[Array, "chosen"], n: int) -> Float[Array, "ray 3"]:
    """Directions of an even grid of n × n rays of some elements, one element's after the other's. [1]"""
    out, (top, left) = np.empty((len(elements) * n * n, 3), np.float32), camera.principal_point
    step, elements = camera.pitch_m / camera.focal_length_m, np.asarray(elements, np.int64)
    _look(elements, n, camera.columns, top, left, step, rotation(pose), camera.bending, out)
    return out


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
