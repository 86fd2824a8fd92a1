"""Traffic from floating-car data: SUMO's FCD as XML, CSV or Parquet.

In each format a row is a vehicle at a time: the centre of its front bumper, its angle clockwise from north in
degrees, and its type. An unknown type becomes the model its name suggests, else a car. Without angles a
vehicle heads where it moves.
"""

import itertools
import re
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pandas as pd

from glintrack.core.arrays import Array
from glintrack.core.installation import read_data
from glintrack.io.readings import report_reading
from glintrack.io.untrusted import MAX_COORDINATE_M, check_netcdf
from glintrack.scene.read.fcd_files import read_fcd_rows
from glintrack.scene.traffic import Traffic, read_recording
from glintrack.scene.vehicles import VEHICLE_CLASSES

_MAX_CLOCK_ERROR = 0.1  # of a step: times are rounded
_MAX_DURATION_S = 1e6  # eleven days
_MAX_NAMED_TYPES = 6
# model of each word, `none` for no road vehicle, in groups of which the first that matches counts
_GROUPS = [
    {word: model for model, words in group.items() for word in words}
    for group in read_data("traffic", "vehicle_types.toml")["groups"]
]
_WORD = re.compile(r"[^\W\d_][a-zà-ÿ]+|[^\W\d_a-zà-ÿ]+")
_MIN_MOVE_M = 0.05  # of a step that shows a heading
_MAX_DEGREES_PER_S, _MAX_TOWN_DEG = 0.005, 5.0  # 500 m/s; no vehicle in metres stays below 5 mm/s for ever


def read_fcd(
    path: Path,
    extent_m: tuple[float, float, float, float],
    start_s: float | None = None,
    returning: bool = True,
    project: Callable[[Array, Array], tuple[Array, Array]] | None = None,
) -> Traffic:
    """Read floating-car data and crop them to a window.

    Parameters
    ----------
    path
        XML, CSV (separated by semicolons or commas) or Parquet as ``sumo --fcd-output`` writes them, also
        gzipped; or ``.nc``, a `Recording`, which is not cropped.
    extent_m
        West, south, east, north in the file's coordinates. The traffic has each vehicle from its first to its
        last sample inside. [m]
    start_s
        Time of the file that becomes time zero; its first time by default, with or without a vehicle. [s]
    returning
        True: a vehicle that disappears and comes back (a teleport of SUMO's) comes back as another one.
        False: it does not come back.
    project
        From longitude and latitude [deg] to the coordinates of ``extent_m``; None refuses degrees.

    Returns
    -------
    Traffic in the file's coordinates, vehicles in order of first appearance, then of their id.

    Raises
    ------
    ValueError
        If the file is damaged or hostile, holds no such data, or has a row without time or vehicle, or two
        rows of a vehicle at one time, or degrees that cannot be projected.
    """
    if path.suffix == ".nc":
        traffic = read_recording(check_netcdf(path, path.name)).traffic
        report_reading(path, "vehicles", traffic.count.size, traffic.count.size)
        return traffic
    rows = read_fcd_rows(path)
    clock, table = rows.clock_s, rows.table
    all_ids = len(table["vehicle_id"].unique())
    models = {kind: model_of(kind) for kind in table["vehicle_type"].unique()}
    road = table["vehicle_type"].isin([kind for kind, model in models.items() if model]).to_numpy()
    others = table.loc[~road].drop_duplicates("vehicle_id")["vehicle_type"]
    if not road.any() and len(table):
        raise ValueError(f"`{path.name}` must hold road vehicles; got none among {len(table)} rows.")
    table = table.loc[road]
    step, start_s, step_s = _time_steps(path, clock, table["timestep_time"].to_numpy(float), start_s)
    names, vehicle = np.unique(table["vehicle_id"].to_numpy(dtype=str), return_inverse=True)
    whole, stretch = vehicle, _number_stretches(path, vehicle, step, start_s + step_s * step, names)
    x, y = (table[f"vehicle_{axis}"].to_numpy(float) for axis in "xy")
    notes = [f"{clock.size:,} time steps of {step_s:g} s; time zero is {start_s:g} s of the file"]
    if _is_geographic(x, y, stretch, step * step_s):
        if project is None:
            raise ValueError(
                f"`{path.name}` must be in metres; got numbers that look like degrees, about "
                f"({np.median(x):.4f}, {np.median(y):.4f}). Write it without --fcd-output.geo, or give the "
                "scene crs and origin_m."
            )
        x, y = project(x, y)
        notes.append("longitude and latitude are projected")
    if "vehicle_angle" in table:
        angle = np.radians(table["vehicle_angle"].to_numpy(float))
    else:
        angle = _angles_of_motion(path, x, y, stretch, step)
        notes.append("no angles: vehicles head where they move")
    for name, values in (("x", x), ("y", y), ("angle", angle)):
        bad = ~(np.abs(values) < MAX_COORDINATE_M)
        if bad.any():
            raise ValueError(
                f"`{path.name}` must give finite {name} in metres and degrees; "
                f"got {values[bad][0]:g} in {int(bad.sum())} of {bad.size} rows."
            )
    if returning:
        vehicle = stretch
    kept, enters = _crop(step, vehicle, x, y, extent_m)
    present, starts = np.unique(vehicle[kept], return_index=True)
    ranked = present[np.argsort(starts)]
    count = np.bincount(vehicle[kept], minlength=len(enters))[ranked]
    kinds = table["vehicle_type"].to_numpy(dtype=str)[kept[np.cumsum(count) - count]]
    traffic = Traffic(
        step_s=step_s,
        steps=int(np.round((clock[-1] - start_s) / step_s)) + 1,
        first=enters[ranked],
        count=count,
        model=np.array([VEHICLE_CLASSES.index(str(models[kind])) for kind in kinds], dtype=int),
        bumper_east=x[kept],
        bumper_north=y[kept],
        angle=angle[kept],
    )
    guessed = [kind for kind in kinds if kind not in VEHICLE_CLASSES]
    if guessed:
        notes.append(f"shown as the model their type suggests, else a car: {_count_types(guessed)}")
    used = len(np.unique(whole[kept]))
    if returned := len(present) - used:
        notes.append(f"{returned} vehicles vanish and come back as others")
    left_out = {
        f"no road vehicles: {_count_types(others)}": len(others),
        "never in the window": len(names) - used,
    }
    report_reading(path, "vehicles", all_ids, used, left_out, notes)
    return traffic


def _time_steps(
    path: Path, clock_s: Array, time_s: Array, start_s: float | None
) -> tuple[Array, float, float]:
    """Time step of each row, counted from ``start_s``; that time; and the interval. [1, s, s]"""
    if clock_s.size < 2:
        raise ValueError(f"`{path.name}` must hold at least two time steps; got {clock_s.size}.")
    if np.ptp(clock_s) > _MAX_DURATION_S:
        raise ValueError(
            f"`{path.name}` must span at most {_MAX_DURATION_S:g} s; got {clock_s[0]:g} to {clock_s[-1]:g} s."
        )
    start_s = float(clock_s[0]) if start_s is None else start_s
    gaps = np.diff(clock_s)
    typical_s = max(float(np.round(np.median(gaps), 6)), 1e-6)
    count = np.r_[0, np.cumsum(np.round(gaps / typical_s))]
    fitted_s = float(np.round(np.polyfit(count, clock_s, 1)[0], 9))  # through times that are rounded
    for step_s in (typical_s, fitted_s):
        position = (time_s - start_s) / step_s
        late = np.abs(position - np.round(position)) > _MAX_CLOCK_ERROR
        if not late.any():
            return np.round(position).astype(int), start_s, step_s
    raise ValueError(
        f"`{path.name}` must be sampled every {typical_s:g} s, as most of it is; got the time "
        f"{time_s[late][0]:g} s in {int(late.sum())} of {late.size} rows."
    )


def _is_geographic(x: Array, y: Array, stretch: Array, time_s: Array) -> bool:
    """Return True for longitudes and latitudes: within their range, and no faster than degrees pass."""
    if not len(x) or not ((np.abs(x) <= 180) & (np.abs(y) <= 90)).all():
        return False
    order = np.lexsort((time_s, stretch))
    same = np.diff(stretch[order]) == 0
    moved = np.hypot(np.diff(x[order]), np.diff(y[order]))[same]
    fastest = float((moved / np.diff(time_s[order])[same]).max(initial=0.0))
    if np.ptp(x) > _MAX_TOWN_DEG or np.ptp(y) > _MAX_TOWN_DEG or fastest > _MAX_DEGREES_PER_S:
        return False
    several = stretch.max() > 0 and max(np.ptp(x), np.ptp(y)) < 1.0  # nobody stands within a metre of others
    return fastest > 0 or bool(several)


def _angles_of_motion(path: Path, x: Array, y: Array, stretch: Array, step: Array) -> Array:
    """Heading clockwise from north by the way to the next place, while standing as before. [rad]"""
    order = np.lexsort((step, stretch))
    east, north, same = np.diff(x[order]), np.diff(y[order]), np.diff(stretch[order]) == 0
    moves = np.append(same & (np.hypot(east, north) > _MIN_MOVE_M), False)
    heading = pd.Series(np.where(moves, np.arctan2(np.append(east, 0.0), np.append(north, 0.0)), np.nan))
    own = heading.groupby(stretch[order])
    filled = own.ffill().fillna(own.bfill()).to_numpy()
    if np.isnan(filled).any():
        standing = len(np.unique(stretch[order][np.isnan(filled)]))
        raise ValueError(
            f"`{path.name}` must give angles; got none, and {standing} "
            "vehicles that never move. Write the attribute angle too."
        )
    angle = np.empty(len(x))
    angle[order] = filled
    return angle


def _count_types(kinds: Iterable[str]) -> str:
    few = list(Counter(map(str, kinds)).items())[:_MAX_NAMED_TYPES]
    return ", ".join(f"{n} × {kind or 'no type'}" for kind, n in few)


def fcd_table(traffic: Traffic) -> pd.DataFrame:
    """Table of floating-car data for `read_fcd`, in order of time, rounded to 1 mm and 10⁻⁴ degrees."""
    vehicle = np.repeat(np.arange(traffic.count.size), traffic.count)
    starts = np.cumsum(traffic.count) - traffic.count
    step = np.arange(vehicle.size) - starts[vehicle] + traffic.first[vehicle]
    table = pd.DataFrame(
        {
            "timestep_time": np.round(step * traffic.step_s, 6),
            "vehicle_id": np.char.add("v", vehicle.astype(str)),
            "vehicle_type": np.array(VEHICLE_CLASSES)[traffic.model[vehicle]],
            "vehicle_x": np.round(traffic.bumper_east, 3),
            "vehicle_y": np.round(traffic.bumper_north, 3),
            "vehicle_angle": np.round(np.degrees(traffic.angle) % 360.0, 4),
        }
    )
    return table.iloc[np.lexsort((vehicle, step))].reset_index(drop=True)


def _number_stretches(path: Path, vehicle: Array, step: Array, time: Array, names: Array) -> Array:
    """Assign a number to each row's unbroken stretch of time steps, vehicle after vehicle."""
    order = np.lexsort((step, vehicle))
    same, ahead = np.diff(vehicle[order]) == 0, np.diff(step[order])
    twice = np.flatnonzero(same & (ahead == 0))
    if twice.size:
        row = order[twice[0] + 1]
        raise ValueError(
            f"`{path.name}` must give each vehicle once a time step; got {str(names[vehicle[row]])[:40]!r} "
            f"twice at {time[row]:g} s, in {twice.size} rows."
        )
    typical = float(np.median(ahead[same])) if same.any() else 1.0
    if typical >= 2:
        raise ValueError(
            f"`{path.name}` must give each vehicle at every time step; got most of them every {typical:g} "
            "time steps. Interpolate them to common times."
        )
    stretch = np.empty(vehicle.size, int)
    stretch[order] = np.cumsum(np.r_[0, ~(same & (ahead == 1))])
    return stretch


def _crop(
    step: Array, vehicle: Array, x: Array, y: Array, extent_m: tuple[float, ...]
) -> tuple[Array, Array]:
    """Rows in the window, vehicle after vehicle in order of time, and the step each vehicle enters at."""
    vehicles = int(vehicle.max()) + 1
    west, south, east, north = extent_m
    inside = (step >= 0) & (x >= west) & (x <= east) & (y >= south) & (y <= north)
    enters, leaves = np.full(vehicles, np.iinfo(int).max), np.full(vehicles, -1)
    np.minimum.at(enters, vehicle[inside], step[inside])
    np.maximum.at(leaves, vehicle[inside], step[inside])
    rows = np.flatnonzero((step >= enters[vehicle]) & (step <= leaves[vehicle]))
    # in order of first appearance, then of the file's id; within a vehicle in order of time
    rows = rows[np.lexsort((step[rows], vehicle[rows], enters[vehicle[rows]]))]
    _, starts = np.unique(vehicle[rows], return_index=True)
    within = np.arange(rows.size) - np.repeat(np.sort(starts), np.diff([*np.sort(starts), rows.size]))
    # only the first stretch of a vehicle that comes back
    return rows[step[rows] - enters[vehicle[rows]] == within], enters


def model_of(vehicle_type: str) -> str | None:
    """Name of the model for a vehicle type, else a car; None for what is no motor vehicle of the road.

    Whole words of the type are compared, never parts of them, with words of models and SUMO's vehicle classes
    (vClass): a motorbike is no bike, and a trailer is no rail vehicle.
    """
    if vehicle_type in VEHICLE_CLASSES:
        return vehicle_type
    known = {word for models in _GROUPS for word in models}
    bare = [word.lower().removesuffix("type") for word in _WORD.findall(vehicle_type)]  # SUMO's end in it
    words = [word.removesuffix("s") if word.removesuffix("s") in known else word for word in bare]
    pairs = [first + second for first, second in itertools.pairwise(["", *words])]  # motor bike, cable car
    found = [pair if pair in known else word for pair, word in zip(pairs, words, strict=True)]
    for models in _GROUPS:
        for word in reversed(found):
            if word in models:
                return None if models[word] == "none" else models[word]
    return "car"
