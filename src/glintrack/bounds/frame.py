"""Expected and measured electrons of one frame, with and without polarization."""

from collections.abc import Callable
from dataclasses import dataclass

import numba as nb
import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from glintrack.bounds.predictor import PastFrame
from glintrack.camera import Camera, Pose, project, rays
from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.render import Hits
from glintrack.sensor import Sensor, depolarize, photo_electrons, read_out

_MARGIN = 2  # elements about a vehicle that the lens smears it over
_SHADOW_STEP_M = 0.3  # of height
_LOW_M, _HIGH_M = 2.0, 3.5  # of what casts a car's shadow, and a lorry's


@dataclass(frozen=True)
class ObservedFrame:
    """A frame of a flight.

    Parameters
    ----------
    index, time_s
        Index and time. [1, s]
    true_pose, reported_pose
        Pose of the camera, and the navigator's.
    hits, planes
        Hits of the rays, and their light on the elements, from `sensor.light_on_elements`.
    planes_with
        Function that gives the planes with some elements traced again.
    truth
        Schema ``truth`` with ``visible_fraction``.
    """

    index: int
    time_s: float
    true_pose: Pose
    reported_pose: Pose
    hits: Hits
    planes: Float[Array, "plane row column"]
    planes_with: Callable[[Hits], Float[Array, "plane row column"]]
    truth: xr.Dataset


@dataclass(frozen=True)
class ExposedFrame:
    """Part of an `ObservedFrame` for predictions; ``occluded`` may contain a vehicle or its shadow."""

    time_s: float
    true_pose: Pose
    reported_pose: Pose
    planes: Float[Array, "plane row column"]
    occluded: Bool[Array, "row column"]

    def past(self, electrons: Float[Array, "row column"], reported: bool) -> PastFrame:
        """Past frame for `predict`, with its `mean_electrons`."""
        pose = self.reported_pose if reported else self.true_pose
        return PastFrame(electrons, self.occluded, pose, self.time_s)


def mean_electrons(
    planes: Float[Array, "plane row column"], sensor: Sensor, polarized: bool = True
) -> Float[Array, "row column"]:
    """Mean photoelectrons of each element; of the light with S1 = S2 = 0 if not ``polarized``. [e]"""
    light = planes if polarized else depolarize(planes, sensor)
    return photo_electrons(light, sensor) * sensor.pattern.gain


def sample_electrons(
    planes: Float[Array, "plane row column"], sensor: Sensor, rng: np.random.Generator, polarized: bool = True
) -> Float[Array, "row column"]:
    """Photoelectrons after readout with noise, fixed pattern and full well, and calibration. [e]"""
    light = planes if polarized else depolarize(planes, sensor)
    rows, columns = sensor.camera.rows, sensor.camera.columns
    one = np.tile(sensor.electrons_per_reading, (rows // sensor.side + 1, columns // sensor.side + 1))
    return read_out(light, sensor, rng) * (one[:rows, :columns] * sensor.pattern.known_gain)


def vehicles_on(hits: Hits) -> Int[Array, "row column"]:
    """Highest id of the moving vehicles that the rays of each element hit; −1 for none."""
    highest = np.maximum.reduceat(hits.vehicle_id, hits.first[:-1]).reshape(hits.rows, hits.columns)
    return np.maximum(highest, -1)


def element_points(
    hits: Hits, camera: Camera, pose: Pose, again: Hits | None = None
) -> Float[Array, "row column 3"]:
    """Point along each element's axis at the median range of its rays; NaN for sky. [m]

    Elements that were traced ``again`` have those hits.
    """
    middle = _median_ranges(hits)
    if again is not None:
        middle = np.where(again.rays.reshape(middle.shape) > 0, _median_ranges(again), middle)
    return pose.position + rays(camera, pose) * np.where(np.isfinite(middle), middle, np.nan)[..., None]


def _median_ranges(hits: Hits) -> Float[Array, "row column"]:
    middle = np.empty((hits.rows, hits.columns), np.float32)
    over_rows(_median_range, middle.size, hits.first, hits.weight, hits.range_m, middle.ravel(), least=1024)
    return middle


@nb.njit(nogil=True, cache=True)
def _median_range(start, stop, first, weight, range_m, out):
    """Least range within which at least half of an element's rays end."""
    for element in range(start, stop):
        out[element] = np.inf
        for sample in range(first[element], first[element + 1]):
            within = 0.0
            for other in range(first[element], first[element + 1]):
                within += weight[other] if range_m[other] <= range_m[sample] else 0.0
            if within >= 0.5 - 1e-6:
                out[element] = min(out[element], range_m[sample])


def traffic_mask(
    on: Int[Array, "row column"], tall: Array, camera: Camera, pose: Pose, sun: Float[Array, "3"]
) -> Bool[Array, "row column"]:
    """Elements with vehicles or their shadows: silhouettes, extended along the shadow and dilated.

    Parameters
    ----------
    on
        Vehicle ids from `vehicles_on`.
    tall
        Ids of the vehicles higher than 2 m.
    camera, pose
        Camera and pose of the frame.
    sun
        Unit vector toward the sun. [1]
    """
    middle = np.array([camera.rows / 2, camera.columns / 2])
    ahead = rays(camera, pose, middle)
    ground = pose.position + ahead * (pose.up_m / max(-float(ahead[2]), 1e-3))
    slant = -sun[:2] / max(float(sun[2]), 0.1)
    step = project(camera, pose, ground + np.array([*slant, 0.0])) - project(camera, pose, ground)
    out = on >= 0
    is_tall = np.isin(on, tall)
    for height_m in np.arange(_SHADOW_STEP_M, _HIGH_M + 1e-9, _SHADOW_STEP_M):
        source = (on >= 0) if height_m <= _LOW_M else is_tall
        shift = np.round(step * height_m)
        out = out | (ndimage.shift(source.astype(np.uint8), shift, order=0) > 0)
    return ndimage.binary_dilation(out, np.ones((3, 3), bool), iterations=_MARGIN)
