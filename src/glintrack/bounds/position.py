"""Fisher information of a frame on positions of vehicles, with noise alone.

Elements near vehicles are traced again with 6 × 6 rays: as they are, and with every vehicle a step farther
east, and north. With the derivatives ∂μ of the elements' expected electrons and their variance σ²,
I = Σ ∂μ ∂μᵀ/σ². The change of the variance adds 1/(2σ²) of it, less than a thousandth. DoLP is one value per
superpixel.

References
----------
Kay, Fundamentals of Statistical Signal Processing I (1993), §3.9.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from glintrack.bounds.evidence import dolp_variance
from glintrack.bounds.ideal_observer import dolp_of, find_changes, is_in_group
from glintrack.camera import Pose
from glintrack.core.arrays import Array
from glintrack.render import Hits, Observer, elements_near_traffic
from glintrack.scene import Snapshot
from glintrack.sensor import Sensor

STEP_M = 0.25
RAYS = 6  # along each side of an element


def shift_vehicles(
    observer: Observer,
    snapshot: Snapshot,
    pose: Pose,
    vehicles: Int[Array, "vehicle"],
    planes_of: Callable[[Hits], Array],
) -> list[Float[Array, "plane row column"]]:
    """Light on the elements with some vehicles in place, a step farther east, and a step farther north.

    Parameters
    ----------
    observer, snapshot, pose
        Observer, scene and camera pose of the frame.
    vehicles
        Ids of the vehicles that are moved.
    planes_of
        Function that gives the light with some elements traced again.

    Returns
    -------
    Three frames; none if no vehicle is among the elements.
    """
    sun = np.asarray(observer.sky.sun_direction, float)
    lowest = float(observer.city.terrain["height"].min()) - 0.1
    steps = np.isin(snapshot.vehicle_id, vehicles)
    steps[: snapshot.fixed] = False
    moving = np.concatenate([np.arange(snapshot.fixed), np.flatnonzero(steps)])
    chosen = {
        name: getattr(snapshot, name)[moving] for name in ("transforms", "model", "paint", "vehicle_id")
    }
    around = np.flatnonzero(
        elements_near_traffic(replace(snapshot, **chosen), observer.camera, pose, sun, lowest)
    )
    if not len(around):
        return []
    many = observer.replace(oversampling=RAYS)
    out = []
    for step in ((0.0, 0.0), (STEP_M, 0.0), (0.0, STEP_M)):
        transforms = np.array(snapshot.transforms, float)
        transforms[steps, :2, 3] += step
        placed = replace(snapshot, transforms=transforms)
        out.append(planes_of(many.trace(placed, pose, elements=around)))
    return out


def position_information(
    group: str,
    expected_e: list[Float[Array, "row column"]],
    nearest: Int[Array, "row column"],
    vehicles: Int[Array, "vehicle"],
    sensor: Sensor,
) -> Float[Array, "vehicle 2 2"]:
    """Fisher information of each vehicle's (east, north). [m⁻²]

    Parameters
    ----------
    group
        pan, dolp or all.
    expected_e
        Expected electrons of the frame, with every vehicle `STEP_M` farther east, and farther north. [e]
    nearest, vehicles
        As for `ideal_observer`.
    sensor
        The sensor.
    """
    full, design = sensor.design.saturation_e, sensor.design
    present, east, north = (np.minimum(e, full) for e in expected_e)
    out = np.zeros((len(vehicles), 2, 2))
    frames = [(e, design.noise_variance_e2(e)) for e in (present, east, north)]
    farthest = np.where(np.abs(east - present) > np.abs(north - present), east, north)
    for k, rows, columns in find_changes(present, farthest, nearest, vehicles, design):
        if group == "dolp":
            of = [dolp_of(*frame, rows, columns, sensor) for frame in frames]
            lengths = [np.linalg.norm(one.mean, axis=1) for one in of]
            slope, variance = np.stack([one - lengths[0] for one in lengths[1:]]), dolp_variance(of[0])
        else:
            inside = is_in_group(group, rows, columns, sensor)
            at = rows[inside], columns[inside]
            slope = np.stack([e[at] - present[at] for e in (east, north)])
            variance = frames[0][1][at]
        slope = slope / STEP_M
        out[k] = np.einsum("an,bn,n->ab", slope, slope, 1 / variance)
    return out
