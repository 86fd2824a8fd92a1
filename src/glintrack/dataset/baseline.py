"""The baseline table of a set: our detectors with our tracker."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import xarray as xr

from glintrack.camera import Pose
from glintrack.case.build import Scenario, build_scenario
from glintrack.core.records import NONE_SERVED
from glintrack.core.schema import RADIANCE
from glintrack.dataset.annotations import read_rows
from glintrack.dataset.build import read_plan
from glintrack.dataset.plan import DatasetPlan
from glintrack.dataset.shards import POSE, readings_of
from glintrack.io.netcdf import read_dataset
from glintrack.io.raw_mosaics import read_raw
from glintrack.metrics import score_rows
from glintrack.sensor import mosaic_of
from glintrack.track import Frame, TrackDesign, advance, flush, report, start, step
from glintrack.track.files import FRAMES_DESIGN, as_rows

SCORES = ("completeness", "completeness_visible", "purity", "idf1", "hota", "false_per_frame")


@dataclass(frozen=True)
class Baseline:
    """Detector of `track.DETECTORS`, its channel, and True for raws with poses and terrain."""

    detector: str
    channel: str
    raw: bool = False


_DETECTORS = {
    "ours, raw mosaic": ("mosaic", True),
    "ours, rectified, median motion": ("median-motion", False),
}
BASELINES: Mapping[str, Baseline] = {
    f"{line}, {label}": Baseline(detector, channel, raw)
    for line, (detector, raw) in _DETECTORS.items()
    for channel, label in (("pan", "pan"), ("dolp", "DoLP"), ("all", "all"))
}


def score_baselines(
    folder: str | Path,
    split: str = "test",
    baselines: Mapping[str, Baseline] = BASELINES,
    allow_outside_paths: bool = False,
) -> dict[str, dict[str, float]]:
    """Score each baseline, as ``glintrack dataset baseline`` does.

    Parameters
    ----------
    folder
        Folder of a set.
    split
        ``train``, ``val`` or ``test``.
    baselines
        Baselines by name; only those of channel ``pan`` where a sensor has no polarizers.
    allow_outside_paths
        See `read_plan`.

    Returns
    -------
    Name -> `SCORES`, means over the cases of the split.

    Raises
    ------
    ValueError
        If the folder holds no whole set, or the split no case.
    """
    folder = Path(folder)
    plan = read_plan(folder, allow_outside_paths)
    names = plan.names(split)
    if not all(plan.cases[name].sensor.has_stokes for name in names):
        baselines = {line: one for line, one in baselines.items() if one.channel == "pan"}
    found: dict[str, list[dict[str, float]]] = {line: [] for line in baselines}
    for name in names:
        scenario = build_scenario(plan.cases[name])
        area_m, table = scenario.city.extent_m, read_rows(folder, plan, name, "truth.csv")
        truth = xr.Dataset({key: ("row", table[key].to_numpy()) for key in table})
        for line, rows in _track(folder, plan, name, scenario, baselines).items():
            found[line].append(score_rows(rows, truth, area_m))
    return {
        line: {key: float(pd.Series([one[key] for one in scores]).mean()) for key in SCORES}  # without NaN
        for line, scores in found.items()
    }


def _track(
    folder: Path, plan: DatasetPlan, name: str, scenario: Scenario, baselines: Mapping[str, Baseline]
) -> dict[str, xr.Dataset]:
    """Rows of tracks of one case by each baseline, all over the same frames."""
    case = plan.cases[name]
    states = {line: start(_design(case.track, one), case.seed) for line, one in baselines.items()}
    pending: dict[str, Any] = dict.fromkeys(baselines, ())
    reports: dict[str, list[xr.Dataset]] = {line: [] for line in baselines}
    for frame in _frames(folder, plan, name, scenario):
        rectified = Frame(frame.time_s, frame.image)
        for line, baseline in baselines.items():
            states[line], _ = step(states[line], frame if baseline.raw else rectified)
            pending[line], reported = advance(pending[line], states[line], report(states[line]))
            reports[line].extend(reported)
    found = {}
    for line in baselines:
        reports[line].extend(flush(pending[line]))
        found[line] = as_rows((one.attrs["time_s"], one) for one in reports[line])
    return found


def _design(own: TrackDesign, baseline: Baseline) -> TrackDesign:
    """Choose the tracker of the case or of rectified frames, without queries and roads."""
    rectified = FRAMES_DESIGN.replace({"reporting.history": False})
    return (own if baseline.raw else rectified).replace(
        {
            "detect.channel": baseline.channel,
            "detect.detector": baseline.detector,
            "query.policy": "none",
            "roads.prior": False,
        }
    )


def _frames(folder: Path, plan: DatasetPlan, name: str, scenario: Scenario) -> Iterator[Frame]:
    """Frames of a case: rectified and raw, with their reported poses."""
    sensor, terrain = scenario.sensor, scenario.city.terrain
    for shard in plan.shards(name):
        data = read_dataset(folder / shard.file("nc"), "shard")
        for place, k in enumerate(shard.frames):
            one = data.isel(frame=place)
            image = one[["pan", "stokes_radiance", "dolp"]]
            image = image.drop_vars(["frame", "time_s", "component"], errors="ignore")
            image = image.rename({"north_m": "y", "east_m": "x"})
            image = image.assign_attrs(gsd_m=one.attrs["gsd_m"], units=RADIANCE)
            readings = readings_of(read_raw(folder / shard.raw(k)), sensor)
            pose = Pose(**dict(zip(POSE, one["reported_pose"].values.tolist(), strict=True)), kind="reported")
            mosaic = mosaic_of(readings, sensor, NONE_SERVED)
            yield Frame(float(one["time_s"]), image, mosaic, sensor.camera, pose, terrain=terrain)
