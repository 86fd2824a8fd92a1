"""Floating-car data: SUMO's FCD as XML (plain or gzipped), CSV or Parquet.

In each format a row is a vehicle at a time: the centre of its front bumper, its angle clockwise from north in
degrees, and its type. An unknown type becomes the model its name suggests, else a car.
"""

import gzip
import io
import math
import zlib
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from xml.etree.ElementTree import ParseError

import defusedxml.ElementTree
import numpy as np
import pandas as pd
import pyarrow.parquet
from defusedxml import DefusedXmlException

from glintrack.core.arrays import Array
from glintrack.io.tables import read_csv
from glintrack.io.untrusted import check_file, check_netcdf
from glintrack.scene.traffic import Traffic, read_recording
from glintrack.scene.vehicles import VEHICLE_CLASSES

_COLUMNS = ("timestep_time", "vehicle_id", "vehicle_type", "vehicle_x", "vehicle_y", "vehicle_angle")
_NUMBERS = ("timestep_time", "vehicle_x", "vehicle_y", "vehicle_angle")
_MAX_CLOCK_ERROR = 0.1  # of a step: times are rounded
_MAX_ROWS = 50_000_000
_MAX_DURATION_S = 1e6  # eleven days
_MAX_COORDINATE_M = 1e6  # larger coordinates are geographic or broken
# model, and words in a type's name; the first match counts
_WORDS = (
    ("motorcycle", ("motorcycle", "moped", "motorbike", "scooter")),
    ("bus", ("bus", "coach")),
    ("truck", ("truck", "lorry", "trailer", "hgv", "emergency")),
    ("van", ("van", "delivery", "transporter")),
    ("suv", ("suv", "jeep", "offroad", "pickup")),
    ("hatch", ("hatch", "compact", "small")),
)
_MAX_NAMED_TYPES = 6
_NO_ROAD_USERS = ("pedestrian", "bicycle", "bike", "tram", "rail", "subway", "ship", "person")


def read_fcd(
    path: Path,
    extent_m: tuple[float, float, float, float],
    start_s: float | None = None,
    returning: bool = True,
) -> tuple[Traffic, tuple[str, ...]]:
    """Read floating-car data and crop them to a window.

    Parameters
    ----------
    path
        ``.xml``, ``.xml.gz``, ``.csv`` (separated by semicolons or commas) or ``.parquet``, as
        ``sumo --fcd-output`` writes them; or ``.nc``, a `Recording`, which is not cropped.
    extent_m
        West, south, east, north in the file's coordinates. The traffic has each vehicle from its first to its
        last sample inside. [m]
    start_s
        Time of the file that becomes time zero; its first time by default. [s]
    returning
        True: a vehicle that disappears and comes back (a teleport of SUMO's) comes back as another one.
        False: it does not come back.

    Returns
    -------
    Traffic in the file's coordinates, vehicles in order of first appearance, then of their id; and the
    changes made, one sentence each.

    Raises
    ------
    ValueError
        If the file is damaged or hostile, holds no such data, or has a row without time or vehicle, or two
        rows of a vehicle at one time.
    """
    if path.suffix == ".nc":
        return read_recording(check_netcdf(path, path.name)).traffic, ()
    table = _read_table(path)
    table["vehicle_type"] = table["vehicle_type"].fillna("").astype(str)
    clock = np.unique(table["timestep_time"].to_numpy(dtype=float))  # of all that is in it
    clock = clock[np.isfinite(clock)]
    road = ~table["vehicle_type"].str.lower().str.contains("|".join(_NO_ROAD_USERS))
    others = table.loc[~road].drop_duplicates("vehicle_id")["vehicle_type"]
    if not road.any() and len(table):
        raise ValueError(f"`{path.name}` must hold road vehicles, got none among {len(table)} rows")
    table = table.loc[road]
    time, x, y, angle = (table[name].to_numpy(dtype=float) for name in _NUMBERS)
    for what, bad in (("a time", ~np.isfinite(time)), ("a vehicle", table["vehicle_id"].isna().to_numpy())):
        if bad.any():
            first = int(table.index[np.flatnonzero(bad)[0]]) + 1
            raise ValueError(
                f"`{path.name}` must give each row {what}, got none in {int(bad.sum())} of {bad.size} rows, "
                f"first in data row {first} (correct it, or delete it)"
            )
    for name, values in (("x", x), ("y", y), ("angle", angle)):
        bad = ~(np.abs(values) < _MAX_COORDINATE_M)
        if bad.any():
            raise ValueError(
                f"`{path.name}` must give finite {name} in metres and degrees, "
                f"got {values[bad][0]:g} in {int(bad.sum())} of {bad.size} rows"
            )
    if clock.size < 2:
        raise ValueError(f"`{path.name}` must hold at least two time steps, got {clock.size}")
    if np.ptp(clock) > _MAX_DURATION_S:
        raise ValueError(
            f"`{path.name}` must span at most {_MAX_DURATION_S:g} s, got {clock[0]:g} to {clock[-1]:g} s"
        )
    start_s = float(clock[0]) if start_s is None else start_s
    step_s = float(np.round(np.median(np.diff(clock)), 6))
    position = (time - start_s) / step_s
    late = np.abs(position - np.round(position)) > _MAX_CLOCK_ERROR
    if late.any():
        raise ValueError(
            f"`{path.name}` must be sampled every {step_s:g} s, as most of it is, got the time "
            f"{time[late][0]:g} s in {int(late.sum())} of {late.size} rows"
        )
    step = np.round(position).astype(int)
    names, vehicle = np.unique(table["vehicle_id"].to_numpy(dtype=str), return_inverse=True)
    whole, stretch = vehicle, _number_stretches(path, vehicle, step, time, names)
    if returning:
        vehicle = stretch
    rows, enters = _crop(step, vehicle, x, y, extent_m)
    present, starts = np.unique(vehicle[rows], return_index=True)
    ranked = present[np.argsort(starts)]
    count = np.bincount(vehicle[rows], minlength=len(enters))[ranked]
    kinds = table["vehicle_type"].to_numpy(dtype=str)[rows[np.cumsum(count) - count]]
    traffic = Traffic(
        step_s=step_s,
        steps=int(np.round((clock[-1] - start_s) / step_s)) + 1,
        first=enters[ranked],
        count=count,
        model=np.array([VEHICLE_CLASSES.index(model_of(kind)) for kind in kinds], dtype=int),
        bumper_east=x[rows],
        bumper_north=y[rows],
        angle=np.radians(angle[rows]),
    )
    said = ()
    guessed = [kind for kind in kinds if kind not in VEHICLE_CLASSES]
    if guessed:
        said += (
            f"{len(guessed)} vehicles are shown as the model their type suggests, else a car: "
            f"{_count_types(guessed)}",
        )
    if len(others):
        said += (f"what is no road vehicle is left out: {_count_types(others)}",)
    returned = len(present) - len(np.unique(whole[rows]))
    if returned:
        times = "once" if returned == 1 else f"{returned} times"
        said += (f"vehicles that vanish and come back do so as others, {times}",)
    return traffic, said


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


def model_of(vehicle_type: str) -> str:
    """Name of the model for a vehicle type: its own, the one its name suggests, or a car."""
    if vehicle_type in VEHICLE_CLASSES:
        return vehicle_type
    name = vehicle_type.lower()
    return next((model for model, words in _WORDS if any(w in name for w in words)), "car")


def _number_stretches(path: Path, vehicle: Array, step: Array, time: Array, names: Array) -> Array:
    """Assign a number to each row's unbroken stretch of time steps, vehicle after vehicle."""
    order = np.lexsort((step, vehicle))
    same, ahead = np.diff(vehicle[order]) == 0, np.diff(step[order])
    twice = np.flatnonzero(same & (ahead == 0))
    if twice.size:
        row = order[twice[0] + 1]
        raise ValueError(
            f"`{path.name}` must give each vehicle once a time step, got {str(names[vehicle[row]])[:40]!r} "
            f"twice at {time[row]:g} s ({twice.size} such rows)"
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


def _read_table(path: Path) -> pd.DataFrame:
    readers = {".parquet": _read_parquet, ".csv": _read_csv}
    try:
        table = readers.get(path.suffix, _read_xml)(check_file(path, path.name))
    except OSError as error:
        raise ValueError(f"`{path.name}` must be a readable file, got {error.strerror or error}") from error
    missing = [c for c in _COLUMNS if c not in table.columns and c != "vehicle_type"]
    if missing:
        raise ValueError(
            f"`{path.name}` must be SUMO's floating-car data with the columns {', '.join(_COLUMNS)} (the "
            f"type may be left out), got no {', '.join(missing)}"
        )
    if "vehicle_type" not in table.columns:
        table["vehicle_type"] = ""
    table = pd.DataFrame({name: table[name] for name in _COLUMNS})
    for name in _NUMBERS:
        try:
            table[name] = np.asarray(pd.to_numeric(table[name], errors="coerce"), dtype=float)
        except OverflowError as error:
            raise ValueError(f"`{path.name}` must hold numbers that fit, got {error} in {name}") from error
    return table


def _read_csv(path: Path) -> pd.DataFrame:
    try:
        with path.open(encoding="utf-8") as file:
            head = file.readline()
            separator = ";" if head.count(";") >= head.count(",") else ","
            count = head.count(separator)
            for number, line in enumerate(file, 1):
                if line.count(separator) > count and '"' not in line:  # pandas would shift the columns
                    raise ValueError(
                        f"`{path.name}` must give each row the header's {count + 1} columns, got "
                        f"{line.count(separator) + 1} in data row {number} (correct it, or delete it)"
                    )
    except UnicodeDecodeError as error:
        raise ValueError(f"`{path.name}` must be SUMO's floating-car data as CSV, got {error}") from error
    return read_csv(
        path,
        path.name,
        separator=separator,
        types={"vehicle_id": "str", "vehicle_type": "str"},
        only=lambda column: column in _COLUMNS,
        comments=False,
        most_bytes=None,
    )


def _read_parquet(path: Path) -> pd.DataFrame:
    try:
        arrow = pyarrow.parquet.read_table(path)
        arrow.validate(full=True)  # also finds names that are not text
        table = arrow.to_pandas()
    except Exception as error:  # Arrow has many errors for damaged files
        raise ValueError(f"`{path.name}` must be a whole Parquet file, got {error}") from error
    known = {c.removeprefix("vehicle_").removeprefix("timestep_"): c for c in _COLUMNS}
    return table.rename(columns={c: known[c] for c in table.columns if c in known})


def _read_xml(path: Path) -> pd.DataFrame:
    """Read the rows of an ``fcd-export`` as a stream: whole files may be larger than memory."""
    rows: dict[str, list] = {name: [] for name in _COLUMNS}
    now = math.nan
    try:
        with gzip.open(path, "rb") if path.suffix == ".gz" else path.open("rb") as file:
            events = defusedxml.ElementTree.iterparse(
                io.BufferedReader(file), events=("start", "end"), forbid_dtd=True
            )
            for event, element in events:
                if event == "start" and element.tag == "timestep":
                    now = element.get("time", "nan")
                elif event == "end" and element.tag == "vehicle":
                    if len(rows["timestep_time"]) >= _MAX_ROWS:
                        raise ValueError(f"more than {_MAX_ROWS} rows")
                    rows["timestep_time"].append(now)
                    for name in _COLUMNS[1:]:
                        rows[name].append(element.get(name.removeprefix("vehicle_")))
                elif event == "end" and element.tag == "timestep":
                    element.clear()
    except DefusedXmlException as error:
        raise ValueError(
            f"`{path.name}` must be plain XML without DTD or entities, got {type(error).__name__}"
        ) from error
    except (ParseError, gzip.BadGzipFile, zlib.error, EOFError, ValueError, LookupError) as error:
        raise ValueError(f"`{path.name}` must be whole, well-formed XML, got {error}") from error
    return pd.DataFrame(rows)
