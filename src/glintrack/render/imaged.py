"""Vehicles as a camera images them: outlines and boxes in the raw frame, and whose each element is.

A perspective image of a convex hull is the hull of its corners' images, so that the box about the images of a
vehicle's vertices is the box of its outline, as tall as the vehicle leans in the picture.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from glintrack.camera import Camera, Pose, project, rays
from glintrack.core.arrays import Array
from glintrack.render.rays.tracer import SceneTracer
from glintrack.scene import VEHICLE_CLASSES, Snapshot

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
        _, _, slots, _ = tracer.rays.intersect(pose.position.astype(np.float32)[None], direction)
    ids = np.concatenate([[-1], vehicle_ids(snapshot)])
    met = np.where(slots < len(ids), slots, 0).astype(np.int64)  # slot 0 is what stands, no slot is sky
    out[row, column] = ids[met]
    return out
