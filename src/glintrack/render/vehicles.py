"""Vehicles in a frame: outlines, whose each element is, how much of each is visible, what they may change.

A perspective image of a convex hull is the hull of its corners' images, so that the box about the images of
a vehicle's vertices is the box of its outline, as tall as the vehicle leans in the picture. The visible
part is found by a fixed fan of rays to each vehicle, so that it does not depend on how the image is
sampled.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, QhullError

from glintrack.camera import Camera, Pose, project, rays
from glintrack.core.arrays import Array
from glintrack.render.rays.surfaces import Tracer
from glintrack.render.tracer import SceneTracer, intersector
from glintrack.scene import VEHICLE_CLASSES, Mesh, Snapshot

PARKED_ID = 1_000_000  # parked vehicles count from here, in the order of the snapshot's instances


class Outlines(NamedTuple):
    """Images of the vertices of vehicles that the frame holds a part of; those of one after the other's.

    Parameters
    ----------
    instance, vehicle_id
        Of each vehicle: which of the snapshot's instances it is, and its id (parked ones from `PARKED_ID`).
    first
        Where the vertices of each begin, and the last one's end.
    pixel
        (row, column) of the vertices, also beyond the frame. [element]
    box
        (x0, y0, x1, y1) of each, cut at the frame's edge; element centres at integers. [element]
    """

    instance: Int[Array, "vehicle"]
    vehicle_id: Int[Array, "vehicle"]
    first: Int[Array, "vehicle+1"]
    pixel: Float[Array, "vertex 2"]
    box: Float[Array, "vehicle 4"]


def vehicle_ids(snapshot: Snapshot) -> Int[Array, "instance"]:
    """Id of each instance: the truth's of what drives, from `PARKED_ID` of what is parked, −1 of the rest."""
    ids = np.array(snapshot.vehicle_id, np.int64)
    parked = np.flatnonzero(np.asarray(snapshot.model)[: snapshot.fixed] < len(VEHICLE_CLASSES))
    ids[parked] = PARKED_ID + np.arange(len(parked))
    return ids


def outlines(snapshot: Snapshot, camera: Camera, pose: Pose) -> Outlines:
    """Where a frame images each vehicle, parked ones too, hidden or not.

    Parameters
    ----------
    snapshot, camera, pose
        What is looked at, with which camera, from which true pose.
    """
    ids = vehicle_ids(snapshot)
    model, transforms = np.asarray(snapshot.model), np.asarray(snapshot.transforms, float)
    edge = np.array([camera.columns, camera.rows]) - 0.5
    found: dict[int, tuple[Array, Array]] = {}
    for k in np.unique(model[ids >= 0]):
        instances = np.flatnonzero((model == k) & (ids >= 0))
        vertices = np.unique(np.asarray(snapshot.models[k].vertices, float), axis=0)
        placed = np.einsum("nij,vj->nvi", transforms[instances, :, :3], vertices)
        pixel = project(camera, pose, placed + transforms[instances, None, :, 3])
        for instance, corners in zip(instances.tolist(), pixel, strict=True):
            if np.isfinite(corners).all():  # not beside or behind the lens
                low, high = corners.min(axis=0)[::-1], corners.max(axis=0)[::-1]
                if (high > -0.5).all() and (low < edge).all():
                    box = np.concatenate([np.maximum(low, -0.5), np.minimum(high, edge)])
                    found[instance] = corners, box
    instances = np.array(sorted(found), np.int64)
    pixels = [found[i][0] for i in instances.tolist()]
    return Outlines(
        instances,
        ids[instances],
        np.concatenate([[0], np.cumsum([len(p) for p in pixels])]).astype(np.int64),
        np.concatenate(pixels) if pixels else np.empty((0, 2)),
        np.array([found[i][1] for i in instances.tolist()]).reshape(-1, 4),
    )


def vehicle_mask(
    snapshot: Snapshot, camera: Camera, pose: Pose, tracer: SceneTracer, seen: Outlines
) -> Int[Array, "row column"]:
    """Id of the vehicle that the ray through each element's middle meets first, −1 for none.

    Parameters
    ----------
    snapshot, camera, pose
        As for `outlines`.
    tracer
        Of the whole scene, from `build_tracer`.
    seen
        From `outlines`.
    """
    out = np.full((camera.rows, camera.columns), -1, np.int64)
    near = np.zeros(out.shape, np.bool_)
    for x0, y0, x1, y1 in seen.box:
        near[int(np.ceil(y0)) : int(np.floor(y1)) + 1, int(np.ceil(x0)) : int(np.floor(x1)) + 1] = True
    row, column = np.nonzero(near)
    if not len(row):
        return out
    direction = rays(camera, pose, np.stack([row, column], axis=1)).astype(np.float32)
    with tracer.placed(snapshot):
        slots = tracer.rays.intersect(pose.position.astype(np.float32)[None], direction).slot
    ids = np.concatenate([[-1], vehicle_ids(snapshot)])
    met = np.where(slots < len(ids), slots, 0).astype(np.int64)  # slot 0 is what stands, no slot is sky
    out[row, column] = ids[met]
    return out


FAN_SIDE = 16  # 256 rays to a vehicle
_APART_M = 200.0  # between vehicles that stand alone: farther than the longest reaches


def build_vehicle_tracer(snapshot: Snapshot) -> Tracer:
    """Acceleration structure of the vehicles alone, for `visible_fraction`."""
    nothing = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros(0, np.int16))
    return intersector()(nothing, snapshot.models)


def visible_fraction(
    snapshot: Snapshot,
    camera: Camera,
    pose: Pose,
    tracer: SceneTracer,
    vehicle_tracer: Tracer,
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
    vehicle_tracer
        From `build_vehicle_tracer`.
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
            vehicle_tracer, (transforms, model), places, centre, corners, direction, pose.position
        )
    range_m = np.linalg.norm(centre - pose.position, axis=1)
    pixel = project(camera, pose, pose.position + range_m[:, None, None] * direction)
    with np.errstate(invalid="ignore"):
        in_frame = (pixel >= -0.5).all(axis=-1)
        in_frame &= (pixel[..., 0] <= camera.rows - 0.5) & (pixel[..., 1] <= camera.columns - 0.5)
    vehicle, ray = np.nonzero(alone & in_frame)
    origin = pose.position.astype(np.float32)[None]
    with tracer.placed(snapshot):
        slots = tracer.rays.intersect(origin, direction[vehicle, ray].astype(np.float32), True).slot
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
    vehicle_tracer: Tracer,
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
    vehicle_tracer.update(apart, model)
    radius = np.linalg.norm(corners - centre[:, None], axis=-1).max(axis=1)
    before = np.maximum(np.linalg.norm(centre - eye, axis=1) - 2 * radius, 0.0)
    origin = (eye + shift)[:, None] + before[:, None, None] * direction
    starts, directions = (x.reshape(-1, 3).astype(np.float32) for x in (origin, direction))
    slots = vehicle_tracer.intersect(starts, directions, True).slot
    return slots.reshape(count, rays) == np.arange(1, count + 1, dtype=np.uint32)[:, None]


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


_MARGIN_ELEMENTS = 1.5  # an element's rays and those of the sun's edge
_LONGEST_M = 1000.0  # of a shadow


def elements_near_traffic(
    snapshot: Snapshot, camera: Camera, pose: Pose, sun: Float[Array, "3"], lowest_m: float
) -> Bool[Array, "element"]:
    """Elements that may see a moving vehicle or its shadow.

    Parameters
    ----------
    snapshot, camera, pose
        What is looked at, through what, from where.
    sun
        Unit vector toward the sun. [1]
    lowest_m
        Of the ground. [m]
    """
    out = np.zeros((camera.rows, camera.columns), np.bool_)
    models, of_vehicle = np.unique(snapshot.model[snapshot.fixed :], return_inverse=True)
    if not len(models):
        return out.ravel()
    boxes = np.stack([_corners(snapshot.models[model].vertices) for model in models])[of_vehicle]
    turn, place = np.split(snapshot.transforms[snapshot.fixed :], [3], axis=2)
    corners = boxes @ turn.swapaxes(1, 2) + place.swapaxes(1, 2)
    fall = np.minimum((corners[..., 2:] - lowest_m) / max(float(sun[2]), 1e-3), _LONGEST_M)
    pixels = project(camera, pose, np.concatenate([corners, corners - fall * sun], axis=1))
    if not np.isfinite(pixels).all():  # beside or behind the lens
        return np.ones(out.size, np.bool_)
    lows = np.maximum(np.floor(pixels.min(axis=1) - _MARGIN_ELEMENTS), 0).astype(int)
    highs = np.ceil(pixels.max(axis=1) + _MARGIN_ELEMENTS).astype(int) + 1
    for pixel, low, high in zip(pixels, lows, highs, strict=True):
        box = out[low[0] : high[0], low[1] : high[1]] if (high > 0).all() else out[:0]
        if box.size:
            box |= _inside(pixel, low, box.shape)
    return out.ravel()


def _corners(vertices: Array) -> Float[Array, "8 3"]:
    ends = np.stack([vertices.min(axis=0), vertices.max(axis=0)], axis=1)
    return np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1).reshape(-1, 3).astype(float)


def _inside(points: Float[Array, "point 2"], low: Array, shape: tuple[int, int]) -> Bool[Array, "y x"]:
    """Which elements of a box lie within the points' convex hull or a margin of it."""
    try:
        sides = ConvexHull(points).equations
    except QhullError:  # seen along a line
        return np.ones(shape, np.bool_)
    rows, columns = low[0] + np.arange(shape[0]), low[1] + np.arange(shape[1])
    out = np.ones(shape, np.bool_)
    for down, right, offset in sides:
        out &= down * rows[:, None] + right * columns[None] + offset <= _MARGIN_ELEMENTS
    return out
