"""How much of each vehicle the camera sees past trees, buildings and the frame's edge."""

import numpy as np
from jaxtyping import Float

from glintrack.arrays import Array
from glintrack.camera import Camera, Pose, project
from glintrack.render.hits import Hits
from glintrack.render.rays.resolve import NO_HIT
from glintrack.render.rays.tracer import intersector
from glintrack.render.rays.tracer_protocol import Tracer
from glintrack.scene import Mesh, Snapshot


def build_bare_tracer(snapshot: Snapshot) -> Tracer:
    """Acceleration structure of the vehicles alone, for `visible_fraction`."""
    nothing = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros(0, np.int16))
    return intersector()(nothing, snapshot.models)


def visible_fraction(
    hits: Hits, snapshot: Snapshot, camera: Camera, pose: Pose, bare_tracer: Tracer
) -> Float[Array, "vehicle"]:
    """Rays that reach each vehicle over the rays that would if only vehicles stood there.

    Parameters
    ----------
    hits
        Of the whole scene, from `trace` with the same snapshot, camera and pose.
    snapshot, camera, pose
        What was traced.
    bare_tracer
        From `build_bare_tracer`.

    Returns
    -------
    In the order of the moving instances, ``snapshot.vehicle_id[snapshot.fixed :]``, 0 to 1; 0 for a vehicle
    outside the frame. [1]
    """
    moving = slice(snapshot.fixed, None)
    bare_tracer.update(snapshot.transforms[moving], snapshot.model[moving])
    rays = _rays_over_vehicles(hits, snapshot, camera, pose)
    origin = pose.position.astype(np.float32)[None]
    _, _, slots, _ = bare_tracer.intersect(origin, np.ascontiguousarray(hits.direction[rays]))
    met = slots != NO_HIT
    instance = slots[met].astype(np.int64) - 1
    vehicle_id = np.asarray(snapshot.vehicle_id)[moving]
    seen = hits.vehicle_id[rays[met]] == vehicle_id[instance]
    count = len(vehicle_id)
    possible = np.bincount(instance, minlength=count)
    return np.bincount(instance, weights=seen, minlength=count) / np.maximum(possible, 1)


def _rays_over_vehicles(hits: Hits, snapshot: Snapshot, camera: Camera, pose: Pose) -> Array:
    """Indices of the rays inside the image rectangle of any vehicle's bounding box, each once."""
    n = hits.oversampling
    wanted = np.zeros((hits.rows * n, hits.columns * n), np.bool_)
    moving = slice(snapshot.fixed, None)
    for model, transform in zip(snapshot.model[moving], snapshot.transforms[moving], strict=True):
        vertices = snapshot.models[int(model)].vertices
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        corners = np.array(
            [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
        )
        pixel = project(camera, pose, corners @ transform[:, :3].T + transform[:, 3])
        if np.isfinite(pixel).all():
            first = np.floor((pixel.min(axis=0) + 0.5) * n).astype(int) - 1
            last = np.ceil((pixel.max(axis=0) + 0.5) * n).astype(int) + 1
            wanted[max(first[0], 0) : max(last[0], 0), max(first[1], 0) : max(last[1], 0)] = True
    return np.flatnonzero(wanted)
