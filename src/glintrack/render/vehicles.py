"""Vehicles in a frame: outlines, mask, visible fraction, and the elements that they may change.

A perspective image of a convex hull is the hull of its corners' images. The box about the images of a
vehicle's vertices is therefore the box of its outline, with its layover. The visible fraction is found by a
fixed fan of rays to each vehicle, so that it does not depend on the sampling of the image.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, QhullError

from glintrack.camera import Camera, Pose, project, rays
from glintrack.core.arrays import Array
from glintrack.render.rays.surfaces import Tracer, box_corners
from glintrack.render.tracer import SceneTracer, intersector
from glintrack.scene import Mesh, Snapshot

PARKED_ID = 1_000_000  # first id of parked vehicles, in the order of the snapshot's instances


class Outlines(NamedTuple):
    """Images of the vertices of the vehicles that lie at least partly in a frame.

    Parameters
    ----------
    instance, vehicle_id
        Index of the snapshot's instance of each vehicle, and its id (parked ones from `PARKED_ID`).
    first
        First vertex of each vehicle, and the end of the last one's.
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
    """Id of each instance: the truth's of moving vehicles, from `PARKED_ID` of parked ones, −1 of others."""
    ids = np.array(snapshot.vehicle_id, np.int64)
    ids[snapshot.parked] = PARKED_ID + np.arange(len(snapshot.parked))
    return ids


def outlines(snapshot: Snapshot, camera: Camera, pose: Pose) -> Outlines:
    """Project each vehicle to the frame, also parked and hidden ones.

    Parameters
    ----------
    snapshot, camera, pose
        The scene, the frame camera, and its true pose.
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
            if np.isfinite(corners).all():  # in front of the lens
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
        The scene, the frame camera, and its true pose.
    tracer
        Tracer of the whole scene, from `build_tracer`.
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
    with tracer.hold(snapshot):
        slots = tracer.rays.intersect(pose.position.astype(np.float32)[None], direction).slot
    ids = np.concatenate([[-1], vehicle_ids(snapshot)])
    met = np.where(slots < len(ids), slots, 0).astype(np.int64)  # slot 0 is the static mesh, no slot is sky
    out[row, column] = ids[met]
    return out


FAN_SIDE = 16  # 256 rays to a vehicle
_APART_M = 200.0  # between isolated vehicles: more than the longest one


def build_vehicle_tracer(snapshot: Snapshot) -> Tracer:
    """Build the acceleration structure of the vehicles alone, for `visible_fraction`."""
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
    """Rays of a fan that reach each vehicle within the frame over those that reach it in isolation.

    A fan has 16 × 16 rays, at the middles of equal cells of the rectangle around the vehicle's bounding box
    as seen from the lens, along and across the vehicle. The rays that meet the isolated vehicle are counted,
    inside the frame or not. A ray counts as visible if it lies in the frame and meets this vehicle first.

    Parameters
    ----------
    snapshot, camera, pose
        The scene, the frame camera, and its true pose.
    tracer
        Tracer of the whole scene, from `build_tracer`.
    vehicle_tracer
        From `build_vehicle_tracer`.
    instances
        Vehicles of the snapshot; by default the moving ones, ``snapshot.vehicle_id[snapshot.fixed :]``.

    Returns
    -------
    In their order, 0 to 1; 0 for a vehicle outside the frame. [1]
    """
    chosen = np.arange(snapshot.fixed, len(snapshot.model)) if instances is None else np.asarray(instances)
    seen = np.zeros(len(chosen))
    if len(chosen) == 0:
        return seen
    boxes = np.stack([box_corners(mesh.vertices) for mesh in snapshot.models])[snapshot.model[chosen]]
    transforms = np.asarray(snapshot.transforms, float)[chosen]
    corners = np.einsum("vij,vcj->vci", transforms[:, :, :3], boxes) + transforms[:, None, :, 3]
    near = np.flatnonzero(_may_be_in_frame(camera, pose, corners))
    if len(near) == 0:
        return seen
    number, side = near, int(np.ceil(np.sqrt(len(chosen))))
    chosen, transforms, corners = chosen[near], transforms[near], corners[near]
    centre = corners.mean(axis=1)
    direction = _fans(centre, corners, transforms[:, :, 0], pose.position)
    # in isolation all stand far apart, and rays start close by
    shift = -centre.copy()
    shift[:, :2] += _APART_M * np.stack([number % side, number // side], axis=1)
    apart = transforms.copy()
    apart[:, :, 3] += shift
    range_m = np.linalg.norm(centre - pose.position, axis=1)
    radius = np.linalg.norm(corners - centre[:, None], axis=-1).max(axis=1)
    before = np.maximum(range_m - 2 * radius, 0.0)
    origin = (pose.position + shift)[:, None] + before[:, None, None] * direction
    starts, directions = (x.reshape(-1, 3).astype(np.float32) for x in (origin, direction))
    with tracer.busy:  # the tracer of the vehicles has no lock of its own
        vehicle_tracer.update(apart, snapshot.model[chosen])
        slots = vehicle_tracer.intersect(starts, directions, True).slot
    alone = slots.reshape(direction.shape[:2]) == np.arange(1, len(chosen) + 1, dtype=np.uint32)[:, None]
    pixel = project(camera, pose, pose.position + range_m[:, None, None] * direction)
    with np.errstate(invalid="ignore"):
        in_frame = (pixel >= -0.5).all(axis=-1)
        in_frame &= (pixel[..., 0] <= camera.rows - 0.5) & (pixel[..., 1] <= camera.columns - 0.5)
    vehicle, ray = np.nonzero(alone & in_frame)
    origin = pose.position.astype(np.float32)[None]
    with tracer.hold(snapshot):
        slots = tracer.rays.intersect(origin, direction[vehicle, ray].astype(np.float32), True).slot
    met = slots == (chosen[vehicle] + 1).astype(np.uint32)
    seen[near] = np.bincount(vehicle, weights=met, minlength=len(near)) / np.maximum(alone.sum(axis=1), 1)
    return seen


def _may_be_in_frame(camera: Camera, pose: Pose, corners: Array) -> Bool[Array, "vehicle"]:
    """Mask of the bounding boxes that reach into the frame, with a margin of their own size."""
    pixel = project(camera, pose, corners)
    low, high = np.fmin.reduce(pixel, axis=1), np.fmax.reduce(pixel, axis=1)
    reach = high - low + 1.0
    return ((high + reach >= 0) & (low - reach <= [camera.rows, camera.columns])).all(axis=1)


def _fans(centre: Array, corners: Array, forward: Array, eye: Array) -> Float[Array, "vehicle ray 3"]:
    """Directions from the lens through the cells of each vehicle's rectangle. [1]"""
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
    places = [r.min(1)[:, None] + np.ptp(r, 1)[:, None] * step for r in reach]
    fan = (
        ahead[:, None, None]
        + places[0][:, :, None, None] * along[:, None, None]
        + places[1][:, None, :, None] * across[:, None, None]
    )
    return _unit(fan.reshape(len(centre), -1, 3))


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


_MARGIN_ELEMENTS = 1.5  # an element's rays and those of the sun's edge
_LONGEST_M = 1000.0  # of a shadow


def elements_near_traffic(
    snapshot: Snapshot, camera: Camera, pose: Pose, sun: Float[Array, "3"], lowest_m: float
) -> Bool[Array, "element"]:
    """Mask of the elements that may see a moving vehicle or its shadow.

    Parameters
    ----------
    snapshot, camera, pose
        The scene, the frame camera, and its true pose.
    sun
        Unit vector toward the sun. [1]
    lowest_m
        Lowest height of the ground. [m]
    """
    out = np.zeros((camera.rows, camera.columns), np.bool_)
    models, of_vehicle = np.unique(snapshot.model[snapshot.fixed :], return_inverse=True)
    if not len(models):
        return out.ravel()
    boxes = np.stack([box_corners(snapshot.models[model].vertices) for model in models])[of_vehicle]
    turn, place = np.split(snapshot.transforms[snapshot.fixed :], [3], axis=2)
    corners = boxes @ turn.swapaxes(1, 2) + place.swapaxes(1, 2)
    fall = np.minimum((corners[..., 2:] - lowest_m) / max(float(sun[2]), 1e-3), _LONGEST_M)
    pixels = project(camera, pose, np.concatenate([corners, corners - fall * sun], axis=1))
    if not np.isfinite(pixels).all():  # not in front of the lens
        return np.ones(out.size, np.bool_)
    lows = np.maximum(np.floor(pixels.min(axis=1) - _MARGIN_ELEMENTS), 0).astype(int)
    highs = np.ceil(pixels.max(axis=1) + _MARGIN_ELEMENTS).astype(int) + 1
    for pixel, low, high in zip(pixels, lows, highs, strict=True):
        box = out[low[0] : high[0], low[1] : high[1]] if (high > 0).all() else out[:0]
        if box.size:
            box |= _inside(pixel, low, box.shape)
    return out.ravel()


def _inside(points: Float[Array, "point 2"], low: Array, shape: tuple[int, int]) -> Bool[Array, "y x"]:
    """Mask of a box's elements within the points' convex hull and a margin."""
    try:
        sides = ConvexHull(points).equations
    except QhullError:  # seen along a line
        return np.ones(shape, np.bool_)
    rows, columns = low[0] + np.arange(shape[0]), low[1] + np.arange(shape[1])
    out = np.ones(shape, np.bool_)
    for down, right, offset in sides:
        out &= down * rows[:, None] + right * columns[None] + offset <= _MARGIN_ELEMENTS
    return out
