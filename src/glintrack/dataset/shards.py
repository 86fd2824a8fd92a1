"""Labelled frames of a case, and shards of a data set.

A labelled frame is the readout of the sensor, the positions of all vehicles in it, and the light. A shard is
some frames of one case: their raws as PNG of 16 bits, one NetCDF-4 file with the rest, tables of boxes and of
the truth, and a TOML file with the SHA-256 of each, which is written last.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from jaxtyping import Float, Int, UInt

from glintrack.camera import Pose
from glintrack.case.build import Scenario
from glintrack.case.design import Case
from glintrack.core.arrays import Array
from glintrack.core.records import NONE_SERVED
from glintrack.core.schema import RADIANCE
from glintrack.dataset.plan import Shard
from glintrack.io.atomic import content_hash, write_text
from glintrack.io.images import write_counts
from glintrack.io.netcdf import write_dataset
from glintrack.io.tables import write_table
from glintrack.io.toml import read_toml, to_toml
from glintrack.loop import case_navigation_errors, frame_rngs, true_frame_at
from glintrack.ortho import orthorectify
from glintrack.results.epoch import BOX_COLUMNS as FRAME_COLUMNS
from glintrack.results.epoch import SceneView, box_rows, label_mask, vehicle_boxes
from glintrack.sensor import Sensor, frame_of, noiseless_frame, read_out

_MAX_COUNT = 65535
BOX_COLUMNS = (*FRAME_COLUMNS, "speed_m_s")
TRUTH_COLUMNS = (
    "time_s", "vehicle_id", "east_m", "north_m", "east_speed_m_s", "north_speed_m_s", "heading_rad",
    "length_m", "width_m", "visible_fraction",
)  # fmt: skip
POSE = (
    *("east_m", "north_m", "up_m", "heading_rad", "roll_rad", "pitch_rad"),
    *("gimbal_azimuth_rad", "gimbal_depression_rad"),
)
FOLDERS = ("raw", "shards", "cases")


@dataclass(frozen=True)
class LabelledFrame:
    """One frame with its labels.

    Parameters
    ----------
    index, time_s
        Index of the frame in the flight, from 0, and its time. [s]
    raw
        Calibrated counts of every element. [count]
    image
        Image rectified by the reported pose: schema ``image``.
    light
        Stokes vectors without noise, blur or mosaic at the superpixels, in the detector's axes.
    mask
        Id of the vehicle at the centre of each element, −1 for none.
    boxes
        Rows of `results.epoch.BOX_COLUMNS`, with ``speed_m_s``; also of parked vehicles.
    truth
        Rows of all moving vehicles of the city, seen or not.
    true_pose, reported_pose
        Poses of the camera.
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


def simulate_frames(case: Case, scenario: Scenario, frames: Iterable[int]) -> Iterator[LabelledFrame]:
    """Simulate some frames of a case; each is independent of the others.

    Parameters
    ----------
    case, scenario
        The design, and its scenario of `case.build.build_scenario`.
    frames
        Indices of the frames, from 0.
    """
    observer, sensor, flight = scenario.observer, scenario.sensor, scenario.flight
    city, errors = scenario.city, case_navigation_errors(case, flight.times_s)
    surface = observer.surface_model(case.ortho.gsd_m) if case.ortho.surface == "surface" else None
    for k in frames:
        t = float(flight.times_s[k])
        true = true_frame_at(scenario, t, errors[k])
        true_pose, reported_pose, truth = true.true_pose, true.reported_pose, true.truth
        measured = read_out(true.planes, sensor, frame_rngs(case.seed, k).noise)
        frame = frame_of(measured, sensor, NONE_SERVED, t)
        image = orthorectify(
            frame, sensor.camera, reported_pose, city.terrain, case.ortho.gsd_m, city.extent_m,
            case.ortho.method, surface,
        )  # fmt: skip
        imaged = SceneView(observer, city.at(t), truth, true_pose, reported_pose)
        rows = truth.rename_dims(vehicle="row").reset_index("vehicle").rename_vars(vehicle="vehicle_id")
        yield LabelledFrame(
            index=k,
            time_s=t,
            raw=counts_of(measured, sensor),
            image=image,
            light=noiseless_frame(true.light, sensor, t)["stokes_radiance"].values[..., :3],
            mask=label_mask(imaged).values,
            boxes=_boxes(imaged, k, t),
            truth=rows.assign(time_s=("row", np.full(rows.sizes["row"], t), {"units": "s"})),
            true_pose=true_pose,
            reported_pose=reported_pose,
        )


def counts_of(measured: Float[Array, "row column"], sensor: Sensor) -> UInt[Array, "row column"]:
    """Quantize a readout to counts of the design, from 0. [count]"""
    counts = measured / _readings_per_count(sensor, measured.shape)
    return np.clip(np.rint(counts), 0, _MAX_COUNT).astype(np.uint16)


def readings_of(counts: UInt[Array, "row column"], sensor: Sensor) -> Float[Array, "row column"]:
    """Convert counts back to the readout. [W m⁻² sr⁻¹ µm⁻¹]"""
    return (counts * _readings_per_count(sensor, counts.shape)).astype(np.float32)


def _readings_per_count(sensor: Sensor, shape: tuple[int, ...]) -> Float[Array, "row column"]:
    electrons_per_reading = np.tile(sensor.electrons_per_reading, tuple(n // sensor.side for n in shape))
    return sensor.design.electrons_per_count / electrons_per_reading


def _boxes(imaged: SceneView, frame: int, time_s: float) -> xr.Dataset:
    """Rows of boxes with each vehicle's speed over ground, 0 for parked ones."""
    boxes, truth = vehicle_boxes(imaged), imaged.truth
    speed = np.hypot(truth["east_speed_m_s"].values, truth["north_speed_m_s"].values)
    known = dict(zip(truth["vehicle"].values.tolist(), speed.tolist(), strict=True))
    speeds = np.array([known.get(int(i), 0.0) for i in boxes["vehicle"].values])
    boxes = boxes.assign(speed_m_s=("vehicle", speeds, {"units": "m s-1"}))
    return box_rows(boxes, frame, time_s)


def is_done(folder: Path, shard: Shard) -> bool:
    """Return True if a folder has a whole shard of the same design and version."""
    path = folder / shard.file("toml")
    if not path.is_file():
        return False
    seal = read_toml(path, "shard")
    sums = seal.get("sha256", {})
    if seal.get("key") != shard.key or set(sums) != set(shard.files):
        return False
    return all((folder / n).is_file() and file_hash(folder / n) == sums[n] for n in shard.files)


def write_shard(folder: Path, shard: Shard, frames: Sequence[LabelledFrame]) -> None:
    """Write a shard's files, and their hashes last."""
    (folder / shard.raw(0)).parent.mkdir(parents=True, exist_ok=True)
    for frame in frames:
        write_counts(folder / shard.raw(frame.index), frame.raw)
    write_dataset(folder / shard.file("nc"), _data(frames))
    for ending, rows, columns in (
        ("boxes.csv", [f.boxes for f in frames], BOX_COLUMNS),
        ("truth.csv", [f.truth for f in frames], TRUTH_COLUMNS),
    ):
        write_table(folder / shard.file(ending), xr.concat(rows, "row", combine_attrs="override"), columns)
    sums = {name: file_hash(folder / name) for name in shard.files}
    write_text(folder / shard.file("toml"), to_toml({"key": shard.key, "sha256": sums}))


def file_hash(path: Path) -> str:
    """SHA-256 of a file."""
    return content_hash(path.read_bytes())


def _data(frames: Sequence[LabelledFrame]) -> xr.Dataset:
    def stack(values: Iterable[np.ndarray], dtype: type) -> np.ndarray:
        return np.stack([np.asarray(value).astype(dtype) for value in values])

    def poses(kind: str) -> tuple:
        rows = [[getattr(getattr(frame, f"{kind}_pose"), key) for key in POSE] for frame in frames]
        about = {"units": "m, rad", "long_name": f"{kind} pose of the camera"}
        return ("frame", "component"), np.array(rows), about

    images = {
        name: stack((f.image[name].values for f in frames), np.float32)
        for name in ("pan", "stokes_radiance", "dolp")
    }
    ground, first = ("frame", "north_m", "east_m"), frames[0]
    axis = {"units": RADIANCE, "stokes_frame": "meridian"}
    detector = {"units": RADIANCE, "stokes_frame": "detector", "long_name": "without noise, blur or mosaic"}
    about_mask = {"units": "1", "long_name": "vehicle_id, -1 for none"}
    return xr.Dataset(
        {
            "light": (("frame", "y", "x", "stokes"), stack((f.light for f in frames), np.float32), detector),
            "mask": (("frame", "row", "column"), stack((f.mask for f in frames), np.int32), about_mask),
            "pan": (ground, images["pan"], {"units": RADIANCE}),
            "stokes_radiance": ((*ground, "stokes"), images["stokes_radiance"][..., :3], axis),
            "dolp": (ground, images["dolp"], {"units": "1"}),
            "true_pose": poses("true"),
            "reported_pose": poses("reported"),
        },
        coords={
            "frame": [f.index for f in frames],
            "time_s": ("frame", [f.time_s for f in frames], {"units": "s"}),
            "stokes": ["I", "Q", "U"],
            "component": list(POSE),
            "north_m": ("north_m", first.image["y"].values, {"units": "m"}),
            "east_m": ("east_m", first.image["x"].values, {"units": "m"}),
        },
        attrs={"gsd_m": float(first.image.attrs["gsd_m"])},
    )
