"""Write tracks, and paths and boxes of the truth, as files, and read MOTChallenge text.

A format of `WRITERS` is a function of the table and of its `TrackGeoreference`. Runs,
``glintrack track``, its help and the tests use all entries.
"""

import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from glintrack.core.arrays import Array
from glintrack.io.atomic import write_bytes, write_text
from glintrack.io.crs import longitude_latitude
from glintrack.io.orthoimages import Geotransform, check_grid
from glintrack.io.readings import report_reading
from glintrack.io.times import check_rate
from glintrack.io.untrusted import read_text

# columns of the file and variables of the rows
TRACK_COLUMNS = (
    "time_s", "track_id", "east_m", "north_m", "east_speed_m_s", "north_speed_m_s",
    "east_var_m2", "north_var_m2", "east_north_cov_m2", "status",
)  # fmt: skip
BOX_M = 5.0  # side of a track's box in MOTChallenge, about the length of a car
_CAR = 3  # class of MOTChallenge
_VEHICLES = (_CAR, 5)  # car, motorbike
_PIXEL_ERROR, _METRE_ERROR = 0.02, 1e-3  # of rounded boxes and positions


@dataclass(frozen=True)
class TrackGeoreference:
    """Position and times of tracks, for formats that need more than their table.

    Parameters
    ----------
    crs, origin_m
        Projected CRS in metres, and position of east and north 0 in it [m]. Without a CRS no geographic
        format is written.
    north_west_m, cell_m
        Outer corner and side of the frames' first pixel, for MOTChallenge. [m]
    times_s
        All epochs, with or without tracks: frames of MOTChallenge. By default those of the tracks. [s]
    """

    crs: str | None = None
    origin_m: tuple[float, float] = (0.0, 0.0)
    north_west_m: tuple[float, float] = (0.0, 0.0)
    cell_m: float = 1.0
    times_s: Sequence[float] = ()


def track_table(rows: xr.Dataset) -> pd.DataFrame:
    """Table of tracks with `TRACK_COLUMNS`; NaN where a column is missing."""
    missing = np.full(rows.sizes.get("row", 0), np.nan)
    columns = {c: np.asarray(rows[c].values) if c in rows else missing for c in TRACK_COLUMNS}
    table = pd.DataFrame(columns)
    table["track_id"] = table["track_id"].astype(np.int64)
    return table


def write_tracks(folder: Path, rows: xr.Dataset, stem: str, place: TrackGeoreference) -> list[str]:
    """Write tracks in every format of `WRITERS`.

    Parameters
    ----------
    folder
        Existing folder.
    rows
        One row for each confirmed track and frame.
    stem
        Stem of the file names.
    place
        Position and times.

    Returns
    -------
    Names of the files, without geographic formats if there is no CRS.

    Raises
    ------
    ValueError
        If the CRS is invalid, not in metres on the ground, or the positions are outside it.
    """
    table, names = track_table(rows), []
    for ending, write in WRITERS.items():
        data = write(table, place)
        if data is not None:
            write_bytes(folder / f"{stem}{ending}", data)
            names.append(f"{stem}{ending}")
    return names


def write_paths(path: Path, rows: xr.Dataset, place: TrackGeoreference) -> None:
    """Write paths of the truth's vehicles as GeoJSON lines in WGS 84 (RFC 7946), with their times."""
    any_rows, columns = rows.sizes.get("row"), ("time_s", "vehicle_id", "east_m", "north_m")
    table = pd.DataFrame({name: rows[name].values if any_rows else np.empty(0) for name in columns})
    write_text(path, json.dumps(_feature_collection(table, place, "vehicle_id")))


def write_mot_truth(
    path: Path, rows: xr.Dataset, area_m: tuple[float, float, float, float], place: TrackGeoreference
) -> None:
    """Write truth as MOTChallenge ground truth, in the pixels and frames of the tracks' file.

    Parameters
    ----------
    path
        File to write: frame, id, left, top, width, height, 1, class, visible fraction. Frames, ids and
        pixels count from 1; the class is 3, a car, for every vehicle.
    rows
        ``/truth`` of a result; vehicles outside the area are left out.
    area_m
        West, south, east, north of the frames. [m]
    place
        Position and times of the tracks.
    """
    lines = []
    if rows.sizes.get("row"):
        west, south, east, north = area_m
        sine, cosine = np.abs(np.sin(rows["heading_rad"].values)), np.abs(np.cos(rows["heading_rad"].values))
        length, width = rows["length_m"].values, rows["width_m"].values
        wide, high = length * sine + width * cosine, length * cosine + width * sine
        x, y = rows["east_m"].values, rows["north_m"].values
        frames, boxes = _frames(rows["time_s"].values, place), _boxes(x, y, wide, high, place)
        ident, seen = rows["vehicle_id"].values, rows["visible_fraction"].values
        inside = (x >= west) & (x <= east) & (y >= south) & (y <= north)
        for k in np.flatnonzero(inside):
            lines.append(f"{frames[k]},{int(ident[k]) + 1},{boxes[k]},1,{_CAR},{seen[k]:.3f}\n")
    write_text(path, "".join(lines))


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
        Position of the pixels. It may be left out if columns 8 and 9 are east and north, as `write_tracks`
        writes them. [m]

    Raises
    ------
    ValueError
        If the file is no such text, or the rate or the position of the pixels is unknown.
    """
    text = read_text(path, name)
    try:
        comma = "," if "," in text else None
        values = (
            np.loadtxt(text.splitlines(), delimiter=comma, ndmin=2) if text.strip() else np.empty((0, 10))
        )
    except ValueError as error:
        raise ValueError(f"`{name}` must be MOTChallenge text of numbers; got {path}: {error}") from error
    columns, boxes = values.shape[1], values[:, :6]
    fits = (boxes[:, 0] >= 1) & (boxes[:, 0] % 1 == 0) & (boxes[:, 4:] > 0).all(axis=1)
    if columns < 6 or not (np.isfinite(boxes).all() and fits.all()):
        raise ValueError(
            f"`{name}` must be MOTChallenge text: frame from 1, id, left, top, and width and height above 0; "
            f"got others in {path}. Add 1 to frames that count from 0."
        )
    if rate_hz is None:
        raise ValueError(f"`rate` must be given for frame numbers instead of times; got none for {path}.")
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
    if name == "truth" and columns == 9:
        table["visible_fraction"], marked = values[:, 8], values[:, 6] != 0
        used = marked & np.isin(values[:, 7], _VEHICLES)
        other = "class of no motor vehicle (car 3, motorbike 5)"
        gone = {"flag 0": int((~marked).sum()), other: int((marked & ~used).sum())}
        if len(used) and not used.any():
            raise ValueError(f"`truth` must hold boxes of class 3 or 5, with flag 1; got none in {path}.")
    note = f"frame 1 is 0 s; {rate_hz:g} frames a second"
    report_reading(path, "boxes", len(used), int(used.sum()), gone, [note])
    return table.iloc[np.flatnonzero(used)].sort_values("time_s", kind="stable").reset_index(drop=True)


def _agree(pixels: Array, places_m: Array) -> bool:
    """Return True if places, as east + i north, are those of pixels, as x − i y, by one scale and shift."""
    if not len(pixels):
        return True
    pixels, places_m = pixels - pixels.mean(), places_m - places_m.mean()
    gsd_m = np.vdot(pixels, places_m).real / (np.vdot(pixels, pixels).real or np.inf)
    apart_m = np.abs(places_m - gsd_m * pixels).max()
    return bool(gsd_m > _METRE_ERROR and apart_m <= _PIXEL_ERROR * gsd_m + _METRE_ERROR)


def _csv(table: pd.DataFrame, place: TrackGeoreference) -> bytes:
    times = table["time_s"].map("{:.15g}".format)  # of a clock that counts from 1970 too
    return table.assign(time_s=times).to_csv(index=False, float_format="%.9g").encode()


def _parquet(table: pd.DataFrame, place: TrackGeoreference) -> bytes:
    buffer = io.BytesIO()
    table.to_parquet(buffer, index=False)
    return buffer.getvalue()


def _mot(table: pd.DataFrame, place: TrackGeoreference) -> bytes:
    """MOTChallenge results: frame, id, left, top, width, height [pixel], 1, east, north [m], 0."""
    frames = _frames(table["time_s"].to_numpy(), place)
    east, north = table["east_m"].to_numpy(), table["north_m"].to_numpy()
    sides = np.full(len(table), BOX_M)
    rows = zip(frames, table["track_id"], _boxes(east, north, sides, sides, place), east, north, strict=True)
    return "".join(f"{f},{i + 1},{box},1,{x:.3f},{y:.3f},0\n" for f, i, box, x, y in rows).encode()


def _geojson(table: pd.DataFrame, place: TrackGeoreference) -> bytes | None:
    if place.crs is None:
        return None
    return json.dumps(_feature_collection(table, place, "track_id")).encode()


def _kml(table: pd.DataFrame, place: TrackGeoreference) -> bytes | None:
    if place.crs is None:
        return None
    placemarks = []
    for ident, _, points in _lines(table, place, "track_id"):
        text = " ".join(f"{x:.8f},{y:.8f},0" for x, y in points)
        shape = "LineString" if len(points) > 1 else "Point"
        placemarks.append(
            f"<Placemark><name>track {ident}</name><{shape}><coordinates>{text}</coordinates>"
            f"</{shape}></Placemark>"
        )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Document>'
        f"<name>tracks</name>{''.join(placemarks)}</Document></kml>\n"
    ).encode()


def _czml(table: pd.DataFrame, place: TrackGeoreference) -> bytes | None:
    """Cesium's time-dynamic form; second 0 is an arbitrary epoch, because a run has no calendar."""
    if place.crs is None:
        return None
    packets: list[dict] = [{"id": "document", "name": "tracks", "version": "1.0"}]
    for ident, times_s, points in _lines(table, place, "track_id"):
        samples = [v for t, (x, y) in zip(times_s, points, strict=True) for v in (t, x, y, 0.0)]
        position = {"epoch": "2000-01-01T00:00:00Z", "cartographicDegrees": samples}
        point = {"pixelSize": 6, "heightReference": "CLAMP_TO_GROUND"}
        packets.append({"id": f"track-{ident}", "position": position, "point": point})
    return json.dumps(packets).encode()


WRITERS: Mapping[str, Callable[[pd.DataFrame, TrackGeoreference], bytes | None]] = {
    ".csv": _csv,
    ".parquet": _parquet,
    "_mot.txt": _mot,
    ".geojson": _geojson,
    ".kml": _kml,
    ".czml": _czml,
}


def _frames(times_s: np.ndarray, place: TrackGeoreference) -> np.ndarray:
    """Frame number at each time, from 1."""
    epochs = np.unique(place.times_s if len(place.times_s) else times_s)
    return np.searchsorted(epochs, times_s - 1e-9) + 1


def _boxes(east, north, wide_m, high_m, place: TrackGeoreference) -> list[str]:
    """Left, top, width and height of boxes around positions. [pixel]"""
    west, top = place.north_west_m
    left = (east - wide_m / 2 - west) / place.cell_m + 1
    upper = (top - north - high_m / 2) / place.cell_m + 1
    sides = np.stack([left, upper, wide_m / place.cell_m, high_m / place.cell_m], axis=-1)
    return [",".join(f"{v:.2f}" for v in box) for box in sides]


def _lines(
    table: pd.DataFrame, place: TrackGeoreference, id_column: str
) -> Iterator[tuple[int, list[float], list[list[float]]]]:
    """Id, times [s] and points (longitude, latitude) [°] of each track or vehicle."""
    easting, northing = table["east_m"] + place.origin_m[0], table["north_m"] + place.origin_m[1]
    x, y = longitude_latitude(place.crs, easting.to_numpy(), northing.to_numpy())
    t, points = table["time_s"].to_numpy(float).round(6), np.round(np.column_stack([x, y]), 8)
    for ident, rows in table.groupby(id_column).indices.items():
        yield int(str(ident)), t[rows].tolist(), points[rows].tolist()


def _feature_collection(table: pd.DataFrame, place: TrackGeoreference, id_column: str) -> dict:
    features, statuses = [], table.groupby(id_column)["status"].agg(list) if "status" in table else {}
    for ident, times_s, points in _lines(table, place, id_column):
        shape = {"type": "LineString", "coordinates": points}
        if len(points) == 1:
            shape = {"type": "Point", "coordinates": points[0]}
        properties = {id_column: ident, "time_s": times_s}
        if ident in statuses:
            properties["status"] = statuses[ident]
        features.append({"type": "Feature", "geometry": shape, "properties": properties})
    return {"type": "FeatureCollection", "features": features}
