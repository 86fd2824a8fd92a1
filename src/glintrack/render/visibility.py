"""Visible share of each vehicle, past trees, buildings, other vehicles and the frame's edge.

A fixed fan of rays goes to each vehicle, so that the answer does not depend on how the image is sampled.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.camera import Camera, Pose, project
from glintrack.core.arrays import Array
from glintrack.render.rays.tracer import SceneTracer, intersector
from glintrack.render.rays.tracer_protocol import Tracer
from glintrack.scene import Mesh, Snapshot

FAN_SIDE = 16  # 256 rays to a vehicle
_APART_M = 200.0  # between vehicles that stand alone: farther than the longest reaches


def build_bare_tracer(snapshot: Snapshot) -> Tracer:
    """Acceleration structure of the vehicles alone, for `visible_fraction`."""
    nothing = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros(0, np.int16))
    return intersector()(nothing, snapshot.models)


def visible_fraction(
    snapshot: Snapshot,
    camera: Camera,
    pose: Pose,
    tracer: SceneTracer,
    bare_tracer: Tracer,
    instances: Int[Array, "vehicle"] | None = None,
) -> Float[Array, "vehicle"]:
    """Rays of a fan that reach each vehicle within the frame over those that would if it stood alone.

    A fan has 16 × 16 rays, at the middles of equal cells of the rectangle that its bounding box fills as seen
    from the lens, along and across the vehicle. Those that meet the vehicle standing alone are counted, in
    frame or not; a ray counts as seen if it lies in the frame and meets this vehicle first.

    Parameters
    ----------
    snapshot, camera, pose
        What is looked at, with which camera, from which true pose.
    tracer
        Of the whole scene, from `build_tracer`.
    bare_tracer
        From `build_bare_tracer`.
    instances
        Which vehicles of the snapshot; by default those that drive,
        ``snapshot.vehicle_id[snapshot.fixed :]``.

    Returns
    -------
    In their order, 0 to 1; 0 for a vehicle outside the frame. [1]
    """
    chosen = np.arange(snapshot.fixed, len(snapshot.model)) if instances is None else np.asarray(instances)
    transforms = np.asarray(snapshot.transforms, float)[chosen]
    count = len(transforms)
    if count == 0:
        return np.zeros(0)
    model = np.asarray(snapshot.model)[chosen]
    centre, corners = _bounds(snapshot, transforms, model)
    near = np.flatnonzero(_may_be_in_frame(camera, pose, corners))  # the others take memory for nothing
    seen = np.zeros(count)
    if len(near) == 0:
        return seen
    places = _places(count)[near]
    chosen, transforms, model, centre, corners = (
        x[near] for x in (chosen, transforms, model, centre, corners)
    )
    direction = _fans(centre, corners, transforms[:, :, 0], pose.position)
    with tracer.busy:  # which the bare one has no lock of its own for
        alone = _meets_alone(
            bare_tracer, (transforms, model), places, centre, corners, direction, pose.position
        )
    range_m = np.linalg.norm(centre - pose.position, axis=1)
    pixel = project(camera, pose, pose.position + range_m[:, None, None] * direction)
    with np.errstate(invalid="ignore"):
        in_frame = (pixel >= -0.5).all(axis=-1)
        in_frame &= (pixel[..., 0] <= camera.rows - 0.5) & (pixel[..., 1] <= camera.columns - 0.5)
    vehicle, ray = np.nonzero(alone & in_frame)
    origin = pose.position.astype(np.float32)[None]
    with tracer.placed(snapshot):
        _, _, slots, _ = tracer.rays.intersect(origin, direction[vehicle, ray].astype(np.float32), True)
    met = slots == (chosen[vehicle] + 1).astype(np.uint32)
    seen[near] = np.bincount(vehicle, weights=met, minlength=len(near)) / np.maximum(alone.sum(axis=1), 1)
    return seen


def _may_be_in_frame(camera: Camera, pose: Pose, corners: Array) -> Bool[Array, "vehicle"]:
    """Whose bounding box, with as much again to each side, reaches into the frame."""
    pixel = project(camera, pose, corners)
    low, high = np.fmin.reduce(pixel, axis=1), np.fmax.reduce(pixel, axis=1)
    reach = high - low + 1.0
    return ((high + reach >= 0) & (low - reach <= [camera.rows, camera.columns])).all(axis=1)


def _places(count: int) -> Float[Array, "vehicle 2"]:
    """Where vehicles stand, each alone. [m]"""
    side = int(np.ceil(np.sqrt(count)))
    number = np.arange(count)
    return _APART_M * np.stack([number % side, number // side], axis=1)


def _bounds(snapshot: Snapshot, transforms: Array, model: Array) -> tuple[Array, Array]:
    """Centre and corners of each vehicle's bounding box, in ENU. [m]"""
    boxes = np.array(
        [
            np.stack(np.meshgrid(*np.stack([low, high], axis=1), indexing="ij"), -1).reshape(-1, 3)
            for low, high in ((m.vertices.min(axis=0), m.vertices.max(axis=0)) for m in snapshot.models)
        ]
    )[model]
    corners = np.einsum("vij,vcj->vci", transforms[:, :, :3], boxes) + transforms[:, None, :, 3]
    return corners.mean(axis=1), corners


def _fans(centre: Array, corners: Array, forward: Array, eye: Array) -> Float[Array, "vehicle ray 3"]:
    """Unit directions from the lens through the cells of each vehicle's rectangle. [1]"""
    ahead = _unit(centre - eye)
    along = forward - np.einsum("vi,vi->v", forward, ahead)[:, None] * ahead
    end_on = np.linalg.norm(along, axis=1) < 1e-3 * np.linalg.norm(forward, axis=1)
    along[end_on] = np.cross(ahead[end_on], [1.0, 0.0, 0.0])
    along = _unit(along)
    across = np.cross(ahead, along)
    to = corners - eye
    depth = np.einsum("vci,vi->vc", to, ahead)
    reach = [np.einsum("vci,vi->vc", to, axis) / depth for axis in (along, across)]
    step = (np.arange(FAN_SIDE) + 0.5) / FAN_SIDE
    places = [
        low[:, None] + (high - low)[:, None] * step for low, high in ((r.min(1), r.max(1)) for r in reach)
    ]
    fan = (
        ahead[:, None, None]
        + places[0][:, :, None, None] * along[:, None, None]
        + places[1][:, None, :, None] * across[:, None, None]
    )
    return _unit(fan.reshape(len(centre), -1, 3))


def _meets_alone(
    bare_tracer: Tracer,
    placed: tuple[Array, Array],
    places: Array,
    centre: Array,
    corners: Array,
    direction: Array,
    eye: Array,
) -> Array:
    """Which rays of each fan meet the vehicle standing alone: all stand far apart, rays start close by."""
    transforms, model = placed
    count, rays = direction.shape[:2]
    shift = -centre.copy()
    shift[:, :2] += places
    apart = transforms.copy()
    apart[:, :, 3] += shift
    bare_tracer.update(apart, model)
    radius = np.linalg.norm(corners - centre[:, None], axis=-1).max(axis=1)
    before = np.maximum(np.linalg.norm(centre - eye, axis=1) - 2 * radius, 0.0)
    origin = (eye + shift)[:, None] + before[:, None, None] * direction
    starts, directions = (x.reshape(-1, 3).astype(np.float32) for x in (origin, direction))
    _, _, slots, _ = bare_tracer.intersect(starts, directions, True)
    return slots.reshape(count, rays) == np.arange(1, count + 1, dtype=np.uint32)[:, None]


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
