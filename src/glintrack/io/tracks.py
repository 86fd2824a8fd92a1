"""Write tracks and truth as files, in every format of `WRITERS`, and read MOTChallenge text.

A format of `WRITERS` is a function of the table and of its `TrackGeoreference`. Runs,
``glintrack track``, its help and the tests use all entries.
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from glintrack.core.arrays import Array
from glintrack.io import map_files
from glintrack.io.atomic import write_bytes
from glintrack.io.orthoimages import Geotransform, check_grid
from glintrack.io.readings import report_reading
from glintrack.io.tables import parquet_bytes
from glintrack.io.times import check_rate
from glintrack.io.untrusted import read_text

# columns of the files and variables of the rows
TRACK_COLUMNS = (
    "time_s", "track_id", "east_m", "north_m", "east_speed_m_s", "north_speed_m_s", "speed_m_s",
    "east_var_m2", "north_var_m2", "east_north_cov_m2", "status",
)  # fmt: skip
# of tracks whose truth is known: vehicle that a track is matched to (−1: none), and whether it is a moving
# vehicle of the scored area, or no vehicle at all
MATCH_COLUMNS = ("vehicle_id", "valid", "false")
LABEL_FILE_COLUMNS = ("time_s", "vehicle_id", "east_m", "north_m", "frame", "asked")  # labels by hand
TRUTH_COLUMNS = (
    "time_s", "vehicle_id", "east_m", "north_m", "east_speed_m_s", "north_speed_m_s", "speed_m_s", "up_m",
    "heading_rad", "class", "length_m", "width_m", "height_m", "visible_fraction", "inside", "moving",
)  # fmt: skip
BOX_M = 5.0  # side of a track's box in MOTChallenge, about the length of a car
_VEHICLES = _CAR, _MOTORCYCLE = 3, 5  # classes of MOTChallenge
_VISDRONE_VEHICLES = 4, 5, 6, 9, 10  # car, van, truck, bus, motor
_MAX_FRAME = 1_000_000
_PIXEL_ERROR, _METRE_ERROR = 0.02, 1e-3  # of rounded boxes and positions


def track_table(rows: xr.Dataset) -> pd.DataFrame:
    """Table of tracks with `TRACK_COLUMNS`, and with `MATCH_COLUMNS` where the truth is known."""
    return _table(rows, TRACK_COLUMNS, MATCH_COLUMNS)


def truth_table(rows: xr.Dataset) -> pd.DataFrame:
    """Table of truth with those of `TRUTH_COLUMNS` that the rows have."""
    return _table(rows, TRUTH_COLUMNS)


def _table(rows: xr.Dataset, columns: tuple[str, ...], optional: tuple[str, ...] = ()) -> pd.DataFrame:
    """Table of some variables with dim ``row``, and of the speed; without rows all columns are empty."""
    if rows.sizes.get("row"):
        speeds = rows["east_speed_m_s"].values, rows["north_speed_m_s"].values
        rows = rows.assign(speed_m_s=("row", np.hypot(*speeds)))
    values = {name: rows[name].values for name in (*columns, *optional) if name in rows}
    table = pd.DataFrame(values if values else {name: np.empty(0) for name in columns})
    return table.astype({map_files.id_column(table): np.int64})


def write_tables(
    folder: Path, table: pd.DataFrame, stem: str, place: map_files.TrackGeoreference
) -> list[str]:
    """Write tracks or truth in every format of `WRITERS`.

    Parameters
    ----------
    folder
        Existing folder.
    table
        From `track_table` or `truth_table`.
    stem
        Stem of the file names.
    place
        Position and times.

    Returns
    -------
    Names of the files, without files for maps if there is no CRS.

    Raises
    ------
    ValueError
        If the CRS is invalid, not in metres on the ground, or the positions are outside it.
    """
    names = []
    for ending, write in WRITERS.items():
        data = write(table, place)
        if data is not None:
            write_bytes(folder / f"{stem}{ending}", data)
            names.append(f"{stem}{ending}")
    return names


def read_mot(path: Path, name: str, rate_hz: float | None, grid: Geotransform | None) -> pd.DataFrame:
    """Read MOTChallenge text as a table of ``time_s``, ``id``, and ``east_m`` and ``north_m`` of the boxes.

    Parameters
    ----------
    path, name
        File of frame, id, left, top, width, height and more; and its name in error messages. ``truth`` of
        nine columns ends in flag, class and ``visible_fraction``; motor vehicles with a flag are used.
    rate_hz
        Frame rate; frame 1 is at 0 s. [Hz]
    grid
        Position of the pixels. It may be left out if columns 8 and 9 are east and north, as `write_tables`
        writes them. [m]

    Raises
    ------
    ValueError
        If the file is no such text, or the rate or the position of the pixels is unknown.
    """
    text = read_text(path, name)
    try:
        sep = "," if "," in text else None
        values = np.loadtxt(text.splitlines(), delimiter=sep, ndmin=2) if text.strip() else np.empty((0, 10))
    except ValueError as error:
        raise ValueError(f"`{name}` must be MOTChallenge text of numbers; got {path}: {error}") from error
    columns, boxes = values.shape[1], values[:, :6]
    is_frame = (boxes[:, 0] >= 1) & (boxes[:, 0] <= _MAX_FRAME) & (boxes[:, 0] % 1 == 0)
    fits = is_frame & (boxes[:, 4:] > 0).all(axis=1)
    if columns < 6 or not (np.isfinite(boxes).all() and fits.all()):
        raise ValueError(
            f"`{name}` must be MOTChallenge text: frame of 1 to {_MAX_FRAME:,}, id, left, top, and width and "
            f"height above 0; got others in {path}. Add 1 to frames that count from 0."
        )
    if rate_hz is None:
        raise ValueError(f"`rate` must be given with frame numbers; got none for {path}. Give --rate HZ.")
    check_rate(rate_hz)
    frame, ident, left, top, wide, high = boxes.T
    x, y = left - 1 + wide / 2, top - 1 + high / 2
    if grid is not None:
        check_grid(grid, "`geotransform`")
        east, north = grid.west_m + grid.gsd_m * x, grid.north_m - grid.gsd_m * y
    elif columns == 10 and _agree(x - 1j * y, values[:, 7] + 1j * values[:, 8]):
        east, north = values[:, 7:9].T
    else:
        raise ValueError(
            f"`geotransform` must be given for boxes in pixels without east and north in columns 8 and 9; "
            f"got none for {path}. Give --geotransform WEST NORTH GSD."
        )
    table = pd.DataFrame({"time_s": (frame - 1) / rate_hz, "id": ident, "east_m": east, "north_m": north})
    used, gone = np.ones(len(table), bool), {}
    notes = [f"frame 1 is 0 s; {rate_hz:g} frames a second"]
    if name == "truth" and columns >= 7:
        marked, layout, classes = values[:, 6] != 0, "", ()
        if columns == 9:
            if not ((values[:, 8] >= 0) & (values[:, 8] <= 1)).all():
                raise ValueError(
                    "`truth` must have the visible fraction, 0 to 1, in column 9 as MOT16 has; got "
                    f"{values[:, 8].max():g} in {path}. Leave out columns 7 to 9 of another layout."
                )
            if not np.isin(values[:, 6], (0, 1)).all():
                raise ValueError(
                    "`truth` must have a flag of 0 or 1, a class and a visible fraction in columns 7 to 9 as "
                    f"MOT16 has; got those of another layout, such as UAVDT's, in {path}. Leave out columns "
                    "7 to 9, and rows of what is no motor vehicle."
                )
            table["visible_fraction"], layout, classes = values[:, 8], "MOT16", _VEHICLES
        elif columns == 10 and _is_visdrone(values):
            layout, classes = "VisDrone", _VISDRONE_VEHICLES
        used = marked & (np.isin(values[:, 7], classes) if classes else True)
        other = f"class of no motor vehicle ({', '.join(map(str, classes))} are)"
        gone = {"flag 0": int((~marked).sum()), other: int((marked & ~used).sum())}
        notes += [f"columns 7 and 8 are flag and class of {layout}"] if layout else []
        if len(used) and not used.any():
            kinds = f"class {' or '.join(map(str, classes))}, with " if classes else ""
            raise ValueError(f"`truth` must hold boxes of {kinds}flag 1; got none in {path}.")
    report_reading(path, "boxes", len(used), int(used.sum()), gone, notes)
    return table.iloc[np.flatnonzero(used)].sort_values("time_s", kind="stable").reset_index(drop=True)


def _is_visdrone(values: Array) -> bool:
    """Return True if columns 7 to 10 are VisDrone's flag, class, truncation and occlusion.

    Class 0, ignored regions, has flag 0.
    """
    more = values[:, 6:]
    fits = (more >= 0) & (more <= np.array([1, 11, 1, 2])) & (more % 1 == 0)
    return bool(fits.all() and not ((more[:, 0] == 1) & (more[:, 1] == 0)).any())


def _agree(pixels: Array, places_m: Array) -> bool:
    """Return True if places, as east + i north, are those of pixels, as x − i y, by one scale and shift."""
    if not len(pixels):
        return True
    pixels, places_m = pixels - pixels.mean(), places_m - places_m.mean()
    gsd_m = np.vdot(pixels, places_m).real / (np.vdot(pixels, pixels).real or np.inf)
    apart_m = np.abs(places_m - gsd_m * pixels).max()
    return bool(gsd_m > _METRE_ERROR and apart_m <= _PIXEL_ERROR * gsd_m + _METRE_ERROR)


def _csv(table: pd.DataFrame, place: map_files.TrackGeoreference) -> bytes:
    times = table["time_s"].map("{:.15g}".format)  # of a clock that counts from 1970 too
    flags = {name: int for name in table.select_dtypes(bool)}
    return table.assign(time_s=times).astype(flags).to_csv(index=False, float_format="%.9g").encode()


def _parquet(table: pd.DataFrame, place: map_files.TrackGeoreference) -> bytes:
    """Table in the coordinates of the CSV file, whose CRS and origin are metadata."""
    return parquet_bytes(table, {name: str(value) for name, value in place.attributes().items()})


def _mot(table: pd.DataFrame, place: map_files.TrackGeoreference) -> bytes:
    """MOTChallenge text: frames, ids and pixels count from 1.

    Tracks: frame, id, left, top, width, height [pixel], 1, east, north [m], 0. Truth within the frames: 1,
    class (3 a car or a larger vehicle, 5 a motorcycle) and visible fraction after the height.
    """
    if map_files.id_column(table) == "track_id":
        frames, (x, y) = _frames(table, place), table[["east_m", "north_m"]].to_numpy(float).T
        sides = np.full(len(table), BOX_M)
        rows = zip(frames, table["track_id"], _boxes(x, y, sides, sides, place), x, y, strict=True)
        return "".join(f"{f},{i + 1},{box},1,{e:.3f},{n:.3f},0\n" for f, i, box, e, n in rows).encode()
    if table.empty:
        return b""
    west, south, east, north = place.area_m
    inside = table["east_m"].between(west, east) & table["north_m"].between(south, north)
    table = table.take(np.flatnonzero(inside).tolist())
    sine, cosine = np.abs(np.sin(table["heading_rad"])), np.abs(np.cos(table["heading_rad"]))
    wide = table["length_m"] * sine + table["width_m"] * cosine
    high = table["length_m"] * cosine + table["width_m"] * sine
    boxes = _boxes(table["east_m"], table["north_m"], wide, high, place)
    kinds = table["class"] if "class" in table else [""] * len(table)
    rows = zip(
        _frames(table, place), table["vehicle_id"], boxes, kinds, table["visible_fraction"], strict=True
    )
    classes = {"motorcycle": _MOTORCYCLE}
    return "".join(
        f"{f},{i + 1},{box},1,{classes.get(k, _CAR)},{v:.3f}\n" for f, i, box, k, v in rows
    ).encode()


def _on_map(
    layer: Callable[[pd.DataFrame, map_files.TrackGeoreference], Any],
    write: Callable[[Any, map_files.TrackGeoreference], bytes],
    table: pd.DataFrame,
    place: map_files.TrackGeoreference,
) -> bytes | None:
    return None if place.crs is None else write(layer(table, place), place)


WRITERS: Mapping[str, Callable[[pd.DataFrame, map_files.TrackGeoreference], bytes | None]] = {
    ".csv": _csv,
    ".parquet": _parquet,
    "_mot.txt": _mot,
    "_points.geojson": partial(_on_map, map_files.points_layer, map_files.write_geojson),
    "_lines.geojson": partial(_on_map, map_files.lines_layer, map_files.write_geojson),
    "_points.parquet": partial(_on_map, map_files.points_layer, map_files.write_geoparquet),
    "_lines.parquet": partial(_on_map, map_files.lines_layer, map_files.write_geoparquet),
    "_points.kml": partial(_on_map, map_files.points_layer, map_files.write_kml),
    "_lines.kml": partial(_on_map, map_files.lines_layer, map_files.write_kml),
    ".czml": partial(_on_map, lambda table, place: table, map_files.write_czml),
}


def _frames(table: pd.DataFrame, place: map_files.TrackGeoreference) -> np.ndarray:
    """Frame number of each row, from 1."""
    times_s = table["time_s"].to_numpy(float)
    epochs = np.unique(place.times_s if len(place.times_s) else times_s)
    return np.searchsorted(epochs, times_s - 1e-9) + 1


def _boxes(east, north, wide_m, high_m, place: map_files.TrackGeoreference) -> list[str]:
    """Left, top, width and height of boxes around positions. [pixel]"""
    west, _, _, top = place.area_m
    left = (east - wide_m / 2 - west) / place.cell_m + 1
    upper = (top - north - high_m / 2) / place.cell_m + 1
    sides = np.stack([left, upper, wide_m / place.cell_m, high_m / place.cell_m], axis=-1)
    return [",".join(f"{v:.2f}" for v in box) for box in sides]
