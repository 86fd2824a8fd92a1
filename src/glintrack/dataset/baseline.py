"""The baseline table of a set: our detectors with our tracker."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from glintrack.case.build import Scenario, build_scenario
from glintrack.core.schema import RADIANCE
from glintrack.dataset.annotations import truth_of
from glintrack.dataset.build import read_plan
from glintrack.dataset.plan import SPLITS, DatasetPlan
from glintrack.dataset.shards import NONE_SERVED, ShardFiles, pose_of, readings_of
from glintrack.io.netcdf import read_dataset
from glintrack.io.raw_mosaics import read_raw
from glintrack.metrics import score_rows
from glintrack.sensor import mosaic_of
from glintrack.track import Frame, TrackDesign, advance, flush, report, start, step
from glintrack.track.files import FRAMES_DESIGN, as_rows

SCORES = ("completeness", "completeness_visible", "purity", "idf1", "hota", "false_per_epoch")


@dataclass(frozen=True)
class Baseline:
    """One line of the table.

    Parameters
    ----------
    detector, channel
        Of `track.DETECTORS`, and what it searches.
    raw
        Whether it looks at raws with poses and terrain, or at rectified frames alone.
    """

    detector: str
    channel: str
    raw: bool = False


_DETECTORS = {
    "ours, raw mosaic": ("mosaic", True),
    "ours, rectified, median motion": ("median-motion", False),
}
_CHANNELS = {"pan": "pan", "dolp": "DoLP", "all": "all"}
BASELINES: Mapping[str, Baseline] = {
    f"{line}, {_CHANNELS[channel]}": Baseline(detector, channel, raw)
    for line, (detector, raw) in _DETECTORS.items()
    for channel in _CHANNELS
}


def score_baselines(
    folder: str | Path,
    split: str = "test",
    baselines: Mapping[str, Baseline] = BASELINES,
    allow_outside_paths: bool = False,
) -> dict[str, dict[str, float]]:
    """Scores of each baseline, means over the cases of a split; what ``glintrack dataset baseline`` does.

    Parameters
    ----------
    folder
        Of a set.
    split
        ``train``, ``val`` or ``test``.
    baselines
        By the name of their line; those that look at pan alone where a sensor has no polarizers.
    allow_outside_paths
        As of `read_plan`.

    Returns
    -------
    Name -> `SCORES`.

    Raises
    ------
    ValueError
        If the folder holds no whole set, or the split no case.
    """
    folder = Path(folder)
    plan = read_plan(folder, allow_outside_paths)
    names = [name for name in plan.cases if plan.split[name] == split]
    if split not in SPLITS or not names:
        held = ", ".join(sorted(set(plan.split.values())))
        raise ValueError(f"`split` must be one that the set has ({held}), got {split!r}")
    if not all(plan.cases[name].sensor.has_stokes for name in names):
        baselines = {line: one for line, one in baselines.items() if one.channel == "pan"}
    found: dict[str, list[dict[str, float]]] = {line: [] for line in baselines}
    for name in names:
        scenario = build_scenario(plan.cases[name])
        truth, area_m = truth_rows(folder, plan, name), scenario.city.extent_m
        for line, rows in track_baselines(folder, plan, name, scenario, baselines).items():
            scores = score_rows(_tracks(rows), truth, area_m)
            found[line].append({key: scores[key] for key in SCORES})
    return {line: {key: _mean([one[key] for one in of]) for key in SCORES} for line, of in found.items()}


def _mean(values: list[float]) -> float:
    """Of what is known; NaN where nothing is."""
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")


def track_baselines(
    folder: Path, plan: DatasetPlan, name: str, scenario: Scenario, baselines: Mapping[str, Baseline]
) -> dict[str, xr.Dataset]:
    """Rows of tracks of one case by each baseline, all over the same frames, each read once."""
    case = plan.cases[name]
    trackers = {line: _Tracker(_design(case.track, one), case.seed) for line, one in baselines.items()}
    told: dict[str, list[xr.Dataset]] = {line: [] for line in baselines}
    for time_s, raw in set_frames(folder, plan, name, scenario):
        rectified = Frame(time_s, raw.image)
        for line, baseline in baselines.items():
            told[line].extend(trackers[line].step(raw if baseline.raw else rectified))
    for line, tracker in trackers.items():
        told[line].extend(tracker.rest())
    return {line: as_rows((one.attrs["time_s"], one) for one in reports) for line, reports in told.items()}


class _Tracker:
    """Our tracker, which may report with a fixed lag."""

    def __init__(self, design: TrackDesign, seed: int):
        self._state, self._pending = start(design, seed), ()

    def step(self, frame: Frame) -> Iterable[xr.Dataset]:
        self._state, _ = step(self._state, frame)
        self._pending, reported = advance(self._pending, self._state, report(self._state))
        return reported

    def rest(self) -> Iterable[xr.Dataset]:
        return flush(self._pending)


def _design(own: TrackDesign, baseline: Baseline) -> TrackDesign:
    """The case's tracker over raws, that of anybody's frames over rectified ones; no spectra, no map."""
    rectified = FRAMES_DESIGN.replace({"reporting.history": False})
    return (own if baseline.raw else rectified).replace(
        {
            "detect.channel": baseline.channel,
            "detect.detector": baseline.detector,
            "query.policy": "none",
            "roads.prior": False,
        }
    )


def set_frames(
    folder: Path, plan: DatasetPlan, name: str, scenario: Scenario
) -> Iterator[tuple[float, Frame]]:
    """Time [s] and what a detector sees of each frame of a case: rectified and raw, with its pose."""
    sensor, terrain = scenario.sensor, scenario.city.terrain
    for shard in plan.shards(name):
        files = ShardFiles(shard)
        data = read_dataset(folder / files.data, "shard")
        for place, k in enumerate(shard.frames):
            one = data.isel(frame=place)
            time_s, image = float(one["time_s"]), _image(one)
            readings = readings_of(read_raw(folder / files.raw(k)), sensor)
            pose = pose_of(one["reported_pose"].values, "reported")
            mosaic = mosaic_of(readings, sensor, NONE_SERVED)
            yield time_s, Frame(time_s, image, mosaic, sensor.camera, pose, terrain=terrain)


def truth_rows(folder: Path, plan: DatasetPlan, name: str) -> xr.Dataset:
    """Truth of one case as `metrics.score_rows` takes it."""
    table = truth_of(folder, plan, name)
    columns = {column: column.removesuffix("_m_s").removesuffix("_m") for column in table}
    columns |= {"time_s": "time_s", "vehicle_id": "vehicle_id"}
    return xr.Dataset({to: ("row", table[column].to_numpy()) for column, to in columns.items()})


def _image(one: xr.Dataset) -> xr.Dataset:
    """Schema ``image`` of one frame of a shard."""
    image = one[["pan", "stokes_radiance", "dolp"]].drop_vars(
        ["frame", "time_s", "component"], errors="ignore"
    )
    image = image.rename({"north": "y", "east": "x"})
    return image.assign_attrs(gsd_m=one.attrs["gsd_m"], units=RADIANCE)


def _tracks(rows: xr.Dataset) -> xr.Dataset:
    """Rows of tracks, also where there are none."""
    if rows.sizes.get("row"):
        return rows
    names: Iterable[str] = ("time_s", "east", "north", "east_speed", "north_speed")
    empty = {name: ("row", np.empty(0)) for name in names}
    return xr.Dataset({**empty, "track_id": ("row", np.empty(0, np.int64))})
