"""Labelled frames of a case: what its sensor reads, where all vehicles are in it, and the light itself."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import xarray as xr
from jaxtyping import Float, Int, UInt

from glintrack.camera import Pose
from glintrack.case.build import Scenario
from glintrack.case.design import Case
from glintrack.core.arrays import Array
from glintrack.core.records import ServedQueries
from glintrack.loop import flown_navigation_errors, frame_rngs, true_frame_at
from glintrack.ortho import orthorectify
from glintrack.render import FrameCache
from glintrack.results.boxes import Imaged, box_rows, label_mask, vehicle_boxes
from glintrack.sensor import Sensor, frame_of, noiseless_frame, read_out

NONE_SERVED = ServedQueries((), np.zeros(0, int), np.zeros(0, int), ())
_MOST_COUNTS = 65535


@dataclass(frozen=True)
class LabelledFrame:
    """One frame with its labels.

    Parameters
    ----------
    index, time_s
        Which frame of the flight, from 0, and when. [s]
    raw
        Counts of every element, what calibration knows taken out. [count]
    image
        Rectified by the reported pose: schema ``image``.
    light
        Stokes vectors without noise, blur or mosaic at the superpixels, in the detector's axes.
    mask
        Id of the vehicle that each element's middle shows, −1 for none.
    boxes
        Rows of `results.boxes.COLUMNS`, with ``speed``; parked vehicles too.
    truth
        Rows of all moving vehicles of the city, seen or not.
    true_pose, reported_pose
        Of the camera.
    """

    index: int
    time_s: float
    raw: UInt[Array, "row column"]
    image: xr.Dataset
    light: Float[Array, "y x 3"]
    mask: Int[Array, "row column"]
    boxes: xr.Dataset
    truth: xr.Dataset
    true_pose: Pose
    reported_pose: Pose


def labelled_frames(
    case: Case, scenario: Scenario, frames: Iterable[int], hits_cache: FrameCache | None = None
) -> Iterator[LabelledFrame]:
    """Fly some frames of a case; each is the one that a run has, whatever is flown beside it.

    Parameters
    ----------
    case, scenario
        The design, and what `scenario.build_scenario` makes of it.
    frames
        Which, from 0.
    hits_cache
        As of `simulate.simulate`.
    """
    observer, sensor, flight = scenario.observer, scenario.sensor, scenario.flight
    city, errors = scenario.city, flown_navigation_errors(case, flight.times_s)
    surface = observer.surface_model(case.ortho.gsd_m) if case.ortho.surface == "surface" else None
    for k in frames:
        t = float(flight.times_s[k])
        true = true_frame_at(scenario, t, errors[k], hits_cache)
        true_pose, reported_pose, truth = true.true_pose, true.reported_pose, true.truth
        measured = read_out(true.planes, sensor, frame_rngs(case.seed, k).noise)
        frame = frame_of(measured, sensor, NONE_SERVED, t)
        image = orthorectify(
            frame, sensor.camera, reported_pose, city.terrain, case.ortho.gsd_m, city.extent_m,
            case.ortho.method, surface,
        )  # fmt: skip
        imaged = Imaged(observer, city.at(t), truth, true_pose, reported_pose)
        yield LabelledFrame(
            k, t, counts_of(measured, sensor), image,
            noiseless_frame(true.light, sensor, t)["stokes_radiance"].values[..., :3],
            label_mask(imaged).values, _boxes(imaged, k, t), _rows(truth, t), true_pose, reported_pose,
        )  # fmt: skip


def counts_of(measured: Float[Array, "row column"], sensor: Sensor) -> UInt[Array, "row column"]:
    """Counts of the design's quantizer for what the elements read; below zero there are none. [count]"""
    side = sensor.side
    per_reading = np.tile(sensor.electrons_per_reading, tuple(n // side for n in measured.shape))
    counts = measured * (per_reading / sensor.design.electrons_per_count)
    return np.clip(np.rint(counts), 0, _MOST_COUNTS).astype(np.uint16)


def readings_of(counts: UInt[Array, "row column"], sensor: Sensor) -> Float[Array, "row column"]:
    """What the elements read, of `counts_of`. [W m⁻² sr⁻¹ µm⁻¹]"""
    side = sensor.side
    per_reading = np.tile(sensor.electrons_per_reading, tuple(n // side for n in counts.shape))
    return (counts * (sensor.design.electrons_per_count / per_reading)).astype(np.float32)


def _boxes(imaged: Imaged, frame: int, time_s: float) -> xr.Dataset:
    """Rows of boxes with each vehicle's speed over ground; parked ones stand."""
    boxes, truth = vehicle_boxes(imaged), imaged.truth
    speed = np.hypot(truth["east_speed"].values, truth["north_speed"].values)
    known = dict(zip(truth["vehicle"].values.tolist(), speed.tolist(), strict=True))
    speeds = np.array([known.get(int(i), 0.0) for i in boxes["vehicle"].values])
    boxes = boxes.assign(speed=("vehicle", speeds, {"units": "m s-1"}))
    return box_rows(boxes, frame, time_s)


def _rows(truth: xr.Dataset, time_s: float) -> xr.Dataset:
    """The truth as rows."""
    rows = truth.rename_dims(vehicle="row").reset_index("vehicle").rename_vars(vehicle="vehicle_id")
    return rows.assign(time_s=("row", np.full(rows.sizes["row"], time_s), {"units": "s"}))
