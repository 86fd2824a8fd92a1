"""Information by task: what sensors with equal light can reach with fixed learners on unseen cities.

`standing` finds vehicles that stand in single frames, `moving` finds moving vehicles by their residuals
against the background that is predicted from past frames, and `reacquire` recognizes a vehicle some seconds
later among others. Poses are true, and so are the outlines of vehicles for `reacquire`.
"""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import pandas as pd
from scipy import stats

from glintrack import metrics
from glintrack.bounds.appearance import Look, find_unseen, recognize_unseen, superpixels
from glintrack.bounds.frame import element_points
from glintrack.bounds.predictor import PastFrame, predict
from glintrack.camera import rays
from glintrack.case.build import Scenario, build_scenario
from glintrack.case.design import Case
from glintrack.core.arrays import Array
from glintrack.core.installation import require_extra
from glintrack.core.progress import step
from glintrack.loop import frame_rngs
from glintrack.render import outlines, vehicle_mask
from glintrack.sensor import Sensor, build_preset, read_arrays, read_presets

Task = Literal["standing", "moving", "reacquire"]
INTERVAL_S = 6.0  # between measured frames
MAX_ELEMENTS = {"rows": 280, "columns": 440}  # that are simulated
_START_STEP_S, _STARTS = 20.0, 5  # other traffic of the recording for each city
_PAST = 6  # frames that predict the background


def measure_tasks(case: Case, task: Task, cities: Sequence[int], frames: int = 3) -> pd.DataFrame:
    """Measure what each preset can reach in one task, on each city by what is learnt in the others.

    Parameters
    ----------
    case
        Flight, atmosphere, lens and electronics.
    task, cities, frames
        The task, two or more seeds of cities, and measured frames of each, 6 s apart.

    Returns
    -------
    One row for each preset and city, with the scores of `find_unseen` or `recognize_unseen`.
    """
    if len(set(cities)) < max(len(cities), 2):
        raise ValueError(f"`cities` must be two different seeds at least; got {list(cities)}.")
    if task != "reacquire":  # before minutes of simulation
        require_extra("sklearn.ensemble", "optimize", f"measure the task {task!r}")
    score, seen, rows = recognize_unseen if task == "reacquire" else find_unseen, [], []
    for number, seed in enumerate(cities):
        with step(f"city {number + 1} of {len(cities)}"):
            seen.append(_observe_city(case, task, seed, number, frames))
    for name in read_presets():
        with step(f"learning with {name}"):
            for k, seed in enumerate(cities):
                found = score([city[name] for city in seen[:k] + seen[k + 1 :]], seen[k][name])
                rows.append({"task": task, "preset": name, "city": seed, **found})
    return pd.DataFrame(rows)


def summarize_tasks(rows: pd.DataFrame) -> pd.DataFrame:
    """Mean scores by preset; ``gain`` of the first over ``pan``, and ``half`` of its 95 % interval (t)."""
    names = list(dict.fromkeys(rows["preset"]))
    scores = [name for name in ("found_50", "found_200", "auc") if name in rows]
    values = rows[scores].to_numpy().reshape(len(names), -1, len(scores))
    gain = values[..., 0] - values[names.index("pan"), :, 0]
    half = stats.t.ppf(0.975, gain.shape[1] - 1) * stats.sem(gain, axis=1)
    return pd.DataFrame(values.mean(axis=1), names, scores).assign(gain=gain.mean(axis=1), half=half)


def _observe_city(case: Case, task: Task, seed: int, number: int, frames: int) -> dict[str, list[Look]]:
    """Simulate a city for every preset at once, with varied materials and traffic of its own."""
    interval = max(round(INTERVAL_S * case.flight.rate_hz), _PAST + 1)
    scenario = build_scenario(_city_case(case, seed, number, _PAST + (frames - 1) * interval + 1))
    design, grid_um = scenario.case.sensor, scenario.sky.wavelength_um
    presets = {name: build_preset(one, design, grid_um) for name, one in read_presets().items()}
    arrays = [sensor for own in presets.values() for sensor in own]
    past, looks = list[list[PastFrame]](), {name: list[Look]() for name in presets}
    for index, time_s in enumerate(scenario.flight.times_s.tolist()):
        ahead = (_PAST - index) % interval  # frames to the next measured one
        if ahead and (task != "moving" or ahead > _PAST):
            continue
        pose = scenario.flight.pose(time_s)
        hits = scenario.observer.trace(scenario.city.at(time_s), pose)
        readings = read_arrays(arrays, scenario.observer.radiance(hits), frame_rngs(seed, index).noise)
        if not ahead:
            found = [(_logarithm(one), ()) for one in readings]
            if task == "moving":
                points = [element_points(hits, scenario.sensor.camera, pose)] * len(arrays)
                before = zip(*past[-_PAST:], strict=True)  # of each array
                found = list(map(_residual, readings, arrays, before, points))
            of_vehicles = _vehicles(scenario, time_s, task)
            for name, own in presets.items():
                mine, found = found[: len(own)], found[len(own) :]
                looks[name].append(Look([one[0] for one in mine], extra=mine[0][1], **of_vehicles))
        clear = np.zeros(readings[0].shape, bool)  # a mask of vehicles would tell where they are
        past.append([PastFrame(one, clear, pose, time_s) for one in readings])
    return looks


def _city_case(case: Case, seed: int, number: int, frames: int) -> Case:
    size = {name: min(getattr(case.sensor, name), most) // 2 * 2 for name, most in MAX_ELEMENTS.items()}
    changes = {
        "seed": seed,
        "scene.seed": seed,
        "flight.start_s": case.flight.start_s + number % _STARTS * _START_STEP_S,
        "flight.frames": frames,
        "sensor": case.sensor.replace({"layout": "pan", "demosaic": "superpixel", **size}),
        "channels": ("pan",),
        "track.query.policy": "none",
    }
    return case.replace(changes)


def _vehicles(scenario: Scenario, time_s: float, task: Task) -> dict[str, Any]:
    """Vehicles of a frame, and the ground area of a superpixel."""
    observer, city, pose = scenario.observer, scenario.city, scenario.flight.pose(time_s)
    camera, snapshot, truth = observer.camera, city.at(time_s), city.truth(time_s)
    ids = vehicle_mask(snapshot, camera, pose, observer.tracer, outlines(snapshot, camera, pose))
    driving, every = truth["vehicle"].values, np.unique(ids[ids >= 0])
    moving = driving[metrics.is_moving(truth)]
    targets = {"standing": np.setdiff1d(every, moving), "moving": moving, "reacquire": driving}[task]
    excluded = driving if task == "moving" else every
    down = max(-float(rays(camera, pose, np.array([camera.rows, camera.columns]) / 2)[2]), 0.1)
    area_km2 = (2e-3 * scenario.sensor.design.ifov_rad * pose.up_m / down) ** 2 / down
    return {"ids": ids, "targets": targets, "excluded": excluded, "superpixel_km2": area_km2}


def _logarithm(reading: Array) -> Array:
    return np.log(np.maximum(reading, 0.01 * np.median(reading)))


def _residual(reading: Array, sensor: Sensor, past: Sequence[PastFrame], points: Array) -> tuple:
    """Logarithm over the median of predictions from past frames; planes of their spread and level."""
    found = [predict([one], points, sensor.camera, sensor.side, one.time_s).electrons for one in past]
    image = _logarithm(reading)
    logs = [np.where(np.isfinite(one), _logarithm(np.nan_to_num(one)), image) for one in found]
    expected = np.median(logs, axis=0)
    spread, level = np.median(np.abs(logs - expected), axis=0), superpixels(expected)
    return image - expected, [np.log(superpixels(spread) + 1e-4), level - np.median(level)]
