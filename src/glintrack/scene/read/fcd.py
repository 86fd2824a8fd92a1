"""Floating-car data: SUMO's FCD as XML (plain or gzipped), CSV or Parquet, read and written.

Whatever the format, a row is a vehicle at a time: the centre of its front bumper, its angle clockwise from
north in degrees, and its type. Types that are not ours become the model their name suggests, else a car.
"""

import gzip
import io
import math
import zlib
from collections import Counter
from dataclasses import dataclass
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
from glintrack.scene.vehicles import MODELS

_COLUMNS = ("timestep_time", "vehicle_id", "vehicle_type", "vehicle_x", "vehicle_y", "vehicle_angle")
_NUMBERS = ("timestep_time", "vehicle_x", "vehicle_y", "vehicle_angle")
_OFF_CLOCK = 0.1  # of a step: times are rounded
_MOST_ROWS = 50_000_000
_LONGEST_S = 1e6  # eleven days
_FURTHEST_M = 1e6  # coordinates beyond this are no scene's: geographic or broken ones
# word in a type's name -> our model, the first that fits
_WORDS = (
    ("motorcycle", ("motorcycle", "moped", "motorbike", "scooter")),
    ("bus", ("bus", "coach")),
    ("truck", ("truck", "lorry", "trailer", "hgv", "emergency")),
    ("van", ("van", "delivery", "transporter")),
    ("suv", ("suv", "jeep", "offroad", "pickup")),
    ("hatch", ("hatch", "compact", "small")),
)
_MOST_TOLD = 6  # types
_NO_ROAD_USERS = ("pedestrian", "bicycle", "bike", "tram", "rail", "subway", "ship", "person")


@dataclass(frozen=True)
class Oddities:
    """What was made of floating-car data where they do not fit.

    Parameters
    ----------
    guessed, left_out
        Vehicles shown as the model that their type suggests, and what is no road user, by type.
    returned
        Vehicles that vanished and came back, each time as another one.
    """

    guessed: dict[str, int]
    left_out: dict[str, int]
    returned: int

    def sentences(self) -> tuple[str, ...]:
        """What to say of them."""
        said = ()
        if self.guessed:
            said += (
                f"{sum(self.guessed.values())} vehicles are shown as the model their type suggests, "
                f"else a car: {_few(self.guessed)}",
            )
        if self.left_out:
            said += (f"what is no road vehicle is left out: {_few(self.left_out)}",)
        if self.returned:
            times = "once" if self.returned == 1 else f"{self.returned} times"
            said += (f"vehicles that vanish and come back do so as others, {times}",)
        return said


def _few(kinds: dict[str, int]) -> str:
    return ", ".join(f"{n} × {kind or 'no type'}" for kind, n in list(kinds.items())[:_MOST_TOLD])


def read_fcd(
    path: Path,
    extent_m: tuple[float, float, float, float],
    start_s: float | None = None,
    returning: bool = True,
) -> tuple[Traffic, Oddities]:
    """Floating-car data cropped to a window.

    Parameters
    ----------
    path
        ``.xml``, ``.xml.gz``, ``.csv`` (separated by semicolons or commas) or ``.parquet``, as
        ``sumo --fcd-output`` writes them; or ``.nc``, a `recording`, which is not cropped.
    extent_m
        West, south, east, north in the file's coordinates: what never enters is dropped, and each vehicle is
        kept from its first to its last sample inside. [m]
    start_s
        The file's time that becomes time zero; its first time by default. [s]
    returning
        Whether a vehicle that vanishes and comes back (a teleport of SUMO's) comes back as another one; else
        it is gone for good.

    Returns
    -------
    Traffic in the file's coordinates, vehicles in order of first appearance, then of their id; and what did
    not fit.

    Raises
    ------
    ValueError
        If the file is damaged or hostile, holds no such data, or has a row without time or vehicle, or two
        rows of a vehicle at one time.
    """
    if path.suffix == ".nc":
        return read_recording(check_netcdf(path, path.name)).traffic, Oddities({}, {}, 0)
    table = _read_table(path)
    table["vehicle_type"] = table["vehicle_type"].fillna("").astype(str)
    clock = np.unique(table["timestep_time"].to_numpy(dtype=float))  # of all that is in it
    clock = clock[np.isfinite(clock)]
    road = ~table["vehicle_type"].str.lower().str.contains("|".join(_NO_ROAD_USERS))
    others = table.loc[~road].drop_duplicates("vehicle_id")["vehicle_type"]
    if not road.any() and len(table):
        raise ValueError(f"`{path.name}` must hold road vehicles, got none among {len(table)} rows")
    table = table.loc[road]
    time, x, y, angle = (
        table[name].to_numpy(dtype=float)
        for name in ("timestep_time", "vehicle_x", "vehicle_y", "vehicle_angle")
    )
    _check_rows(path, time, table["vehicle_id"])
    for name, values in (("x", x), ("y", y), ("angle", angle)):
        bad = ~(np.abs(values) < _FURTHEST_M)
        if bad.any():
            raise ValueError(
                f"`{path.name}` must give finite {name} in metres and degrees, "
                f"got {values[bad][0]:g} in {int(bad.sum())} of {bad.size} rows"
            )
    if clock.size < 2:
        raise ValueError(f"`{path.name}` must hold at least two time steps, got {clock.size}")
    if np.ptp(clock) > _LONGEST_S:
        raise ValueError(
            f"`{path.name}` must span at most {_LONGEST_S:g} s, got {clock[0]:g} to {clock[-1]:g} s"
        )
    start_s = float(clock[0]) if start_s is None else start_s
    step_s = float(np.round(np.median(np.diff(clock)), 6))
    step = _on_clock(path, time, start_s, step_s)
    names, vehicle = np.unique(table["vehicle_id"].to_numpy(dtype=str), return_inverse=True)
    stretch = _stretches(path, vehicle, step, time, names)
    whole = vehicle
    if returning:
        vehicle = stretch
    kept, enters = _kept(step, vehicle, int(vehicle.max()) + 1, x, y, extent_m)
    present, starts = np.unique(vehicle[kept], return_index=True)
    ranked = present[np.argsort(starts)]
    count = np.bincount(vehicle[kept], minlength=len(enters))[ranked]
    kinds = table["vehicle_type"].to_numpy(dtype=str)[kept[np.cumsum(count) - count]]
    number = {kind: k for k, kind in enumerate(MODELS)}
    traffic = Traffic(
        step_s=step_s,
        steps=int(np.round((clock[-1] - start_s) / step_s)) + 1,
        first=enters[ranked],
        count=count,
        model=np.array([number[model_of(kind)] for kind in kinds], dtype=int),
        bumper_east=x[kept],
        bumper_north=y[kept],
        angle=np.radians(angle[kept]),
    )
    guessed = Counter(str(kind) for kind in kinds if kind not in MODELS)
    returned = len(present) - len(np.unique(whole[kept]))
    return traffic, Oddities(dict(guessed), dict(Counter(map(str, others))), returned)


def fcd_table(traffic: Traffic) -> pd.DataFrame:
    """Traffic as rows of floating-car data, in order of time, as `read_fcd` reads them back.

    Parameters
    ----------
    traffic
        In the coordinates the rows shall have; they are rounded to 1 mm and 10⁻⁴ degrees.
    """
    vehicle = np.repeat(np.arange(traffic.count.size), traffic.count)
    starts = np.cumsum(traffic.count) - traffic.count
    step = np.arange(vehicle.size) - starts[vehicle] + traffic.first[vehicle]
    names = np.array(list(MODELS))
    table = pd.DataFrame(
        {
            "timestep_time": np.round(step * traffic.step_s, 6),
            "vehicle_id": np.char.add("v", vehicle.astype(str)),
            "vehicle_type": names[traffic.model[vehicle]],
            "vehicle_x": np.round(traffic.bumper_east, 3),
            "vehicle_y": np.round(traffic.bumper_north, 3),
            "vehicle_angle": np.round(np.degrees(traffic.angle) % 360.0, 4),
        }
    )
    return table.iloc[np.lexsort((vehicle, step))].reset_index(drop=True)


def model_of(vehicle_type: str) -> str:
    """Name of the model a vehicle type is shown as: its own, what its name suggests, or a car."""
    if vehicle_type in MODELS:
        return vehicle_type
    name = vehicle_type.lower()
    return next((model for model, words in _WORDS if any(w in name for w in words)), "car")


def _check_rows(path: Path, time: Array, vehicle_id: pd.Series) -> None:
    """Refuse rows that belong to no time or no vehicle: left out, they would cut a drive short."""
    for what, bad in (("a time", ~np.isfinite(time)), ("a vehicle", vehicle_id.isna().to_numpy())):
        if bad.any():
            first = int(vehicle_id.index[np.flatnonzero(bad)[0]]) + 1
            raise ValueError(
                f"`{path.name}` must give each row {what}, got none in {int(bad.sum())} of {bad.size} rows, "
                f"first in data row {first} (mend it, or leave it out)"
            )


def _on_clock(path: Path, time: Array, start_s: float, step_s: float) -> Array:
    """Number of the time step of each row, from the file's even clock."""
    position = (time - start_s) / step_s
    step = np.round(position)
    late = np.abs(position - step) > _OFF_CLOCK
    if late.any():
        raise ValueError(
            f"`{path.name}` must be sampled every {step_s:g} s, as most of it is, got the time "
            f"{time[late][0]:g} s in {int(late.sum())} of {late.size} rows"
        )
    return step.astype(int)


def _stretches(path: Path, vehicle: Array, step: Array, time: Array, names: Array) -> Array:
    """Number of each row's unbroken stretch of time steps, counted vehicle after vehicle."""
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


def _kept(
    step: Array, vehicle: Array, vehicles: int, x: Array, y: Array, extent_m: tuple[float, ...]
) -> tuple[Array, Array]:
    """Rows that are kept, vehicle after vehicle in order of time, and the step each vehicle enters at."""
    west, south, east, north = extent_m
    inside = (step >= 0) & (x >= west) & (x <= east) & (y >= south) & (y <= north)
    enters, leaves = np.full(vehicles, np.iinfo(int).max), np.full(vehicles, -1)
    np.minimum.at(enters, vehicle[inside], step[inside])
    np.maximum.at(leaves, vehicle[inside], step[inside])
    kept = np.flatnonzero((step >= enters[vehicle]) & (step <= leaves[vehicle]))
    # in order of first appearance, then of the file's id; within a vehicle in order of time
    kept = kept[np.lexsort((step[kept], vehicle[kept], enters[vehicle[kept]]))]
    _, starts = np.unique(vehicle[kept], return_index=True)
    within = np.arange(kept.size) - np.repeat(np.sort(starts), np.diff([*np.sort(starts), kept.size]))
    # of a vehicle that vanished and came back, only the first stretch
    return kept[step[kept] - enters[vehicle[kept]] == within], enters


def _read_table(path: Path) -> pd.DataFrame:
    try:
        if path.suffix == ".parquet":
            table = _read_parquet(check_file(path, path.name))
        elif path.suffix == ".csv":
            table = _read_csv(check_file(path, path.name))
        else:
            table = _read_xml(check_file(path, path.name))
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
        separator = _separator_of_all_rows(path)
    except UnicodeDecodeError as error:
        raise ValueError(f"`{path.name}` must be SUMO's floating-car data as CSV, got {error}") from error
    return read_csv(
        path,
        path.name,
        separator=separator,
        types={"vehicle_id": "str", "vehicle_type": "str"},
        only=_is_ours,
        comments=False,
        most_bytes=None,
    )


def _separator_of_all_rows(path: Path) -> str:
    """What separates the columns; a row with more of them than the header would be read shifted."""
    with path.open(encoding="utf-8") as file:
        head = file.readline()
        separator = ";" if head.count(";") >= head.count(",") else ","
        most = head.count(separator)
        for number, line in enumerate(file, 1):
            if line.count(separator) > most and '"' not in line:
                raise ValueError(
                    f"`{path.name}` must give each row the header's {most + 1} columns, got "
                    f"{line.count(separator) + 1} in data row {number} (mend it, or leave it out)"
                )
    return separator


def _is_ours(column: object) -> bool:
    return column in _COLUMNS


def _read_parquet(path: Path) -> pd.DataFrame:
    try:
        arrow = pyarrow.parquet.read_table(path)
        arrow.validate(full=True)  # names that are no text would be found by whoever looks at them
        table = arrow.to_pandas()
    except Exception as error:  # whatever a damaged file makes Arrow say
        raise ValueError(f"`{path.name}` must be a whole Parquet file, got {error}") from error
    known = {c.removeprefix("vehicle_").removeprefix("timestep_"): c for c in _COLUMNS}
    return table.rename(columns={c: known[c] for c in table.columns if c in known})


def _read_xml(path: Path) -> pd.DataFrame:
    """Rows of an ``fcd-export`` as they stream by: whole files may be larger than memory."""
    rows: dict[str, list] = {name: [] for name in _COLUMNS}
    now = math.nan
    try:
        opened = gzip.open(path, "rb") if path.suffix == ".gz" else path.open("rb")
        with opened as file:
            events = defusedxml.ElementTree.iterparse(
                io.BufferedReader(file), events=("start", "end"), forbid_dtd=True
            )
            for event, element in events:
                if event == "start" and element.tag == "timestep":
                    now = element.get("time", "nan")
                elif event == "end" and element.tag == "vehicle":
                    if len(rows["timestep_time"]) >= _MOST_ROWS:
                        raise ValueError(f"more than {_MOST_ROWS} rows")
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
