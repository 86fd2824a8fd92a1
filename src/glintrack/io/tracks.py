"""Tracks as files: CSV, MOTChallenge, Parquet, GeoJSON, KML and CZML; the truth's ways as GeoJSON too."""

import html
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pyproj
import pyproj.exceptions
import xarray as xr

from glintrack.io.files import write_text

# column of the file -> variable of the rows
TRACK_COLUMNS: Mapping[str, str] = {
    "time_s": "time_s",
    "track_id": "track_id",
    "east_m": "east",
    "north_m": "north",
    "east_speed_m_s": "east_speed",
    "north_speed_m_s": "north_speed",
    "east_var_m2": "east_var",
    "north_var_m2": "north_var",
    "east_north_cov_m2": "east_north_cov",
}


def track_frame(rows: xr.Dataset) -> pd.DataFrame:
    """Rows of tracks as a table with the columns of `TRACK_COLUMNS` and ``status``."""
    empty = np.empty(0)
    columns = {c: np.asarray(rows[v].values) if v in rows else empty for c, v in TRACK_COLUMNS.items()}
    table = pd.DataFrame(columns)
    table["track_id"] = table["track_id"].astype(np.int64)
    coasted = np.asarray(rows["coasted"].values) > 0 if "coasted" in rows else np.empty(0, bool)
    table["status"] = np.where(coasted, "coasted", "measured")
    return table


def write_tracks(
    folder: Path,
    rows: xr.Dataset,
    stem: str = "tracks",
    crs: str | None = None,
    origin_m: tuple[float, float] = (0.0, 0.0),
) -> list[str]:
    """Tracks in every form that somebody opens.

    Parameters
    ----------
    folder
        Existing folder.
    rows
        One row per confirmed track and frame.
    stem
        Of the file names.
    crs, origin_m
        Projected CRS of east and north, and where their origin lies in it [m]; without it GeoJSON holds
        metres as they are, and KML and CZML, which must be geographic, are left out.

    Returns
    -------
    Names of the files: ``.csv``, ``_mot.txt`` (MOTChallenge), ``.parquet``, ``.geojson``, ``.kml`` and
    ``.czml``.
    """
    table = track_frame(rows)
    write_text(folder / f"{stem}.csv", table.to_csv(index=False, float_format="%.9g"))
    write_text(folder / f"{stem}_mot.txt", mot_lines(table))
    names = [f"{stem}.csv", f"{stem}_mot.txt"]
    table.to_parquet(folder / f"{stem}.parquet", index=False)
    lines = _lines(rows, crs, origin_m, "track_id")
    write_text(folder / f"{stem}.geojson", json.dumps(_geojson(lines, crs, "track_id")))
    names += [f"{stem}.parquet", f"{stem}.geojson"]
    if crs is not None:
        write_text(folder / f"{stem}.kml", _kml(lines, stem))
        write_text(folder / f"{stem}.czml", json.dumps(_czml(lines, stem)))
        names += [f"{stem}.kml", f"{stem}.czml"]
    return names


def write_geojson(
    path: Path,
    rows: xr.Dataset,
    crs: str | None,
    origin_m: tuple[float, float] = (0.0, 0.0),
    ident_name: str = "track_id",
) -> None:
    """Ways of tracks or vehicles as GeoJSON lines in WGS 84 longitude and latitude (RFC 7946).

    Parameters
    ----------
    path
        Where to write.
    rows
        One row per track or vehicle and epoch.
    crs, origin_m
        As in `write_tracks`.
    ident_name
        Column that says which rows belong together; each line has it and the times of its points.
    """
    write_text(path, json.dumps(_geojson(_lines(rows, crs, origin_m, ident_name), crs, ident_name)))


def mot_lines(table: pd.DataFrame, box_m: float = 5.0) -> str:
    """Tracks as MOTChallenge results: frame, id, left, top, width, height, confidence, x, y, z.

    Frames and ids count from 1. Boxes are ``box_m`` wide about the position, in metres with the row axis
    pointing south from the first track's north; x and y are east and north. [m]
    """
    if table.empty:
        return ""
    frame = np.unique(table["time_s"].to_numpy(), return_inverse=True)[1] + 1
    top = table["north_m"].max() + box_m
    out = []
    for f, ident, east, north in zip(
        frame, table["track_id"], table["east_m"], table["north_m"], strict=True
    ):
        left, upper = east - box_m / 2, top - north - box_m / 2
        out.append(f"{f},{ident + 1},{left:.3f},{upper:.3f},{box_m:g},{box_m:g},1,{east:.3f},{north:.3f},0")
    return "\n".join(out) + "\n"


@dataclass(frozen=True)
class _Line:
    ident: int
    time_s: list[float]
    points: list[list[float]]


def _lines(rows: xr.Dataset, crs: str | None, origin_m: tuple[float, float], ident_name: str) -> list[_Line]:
    if not rows.sizes.get("row"):
        return []
    x, y = rows["east"].values + origin_m[0], rows["north"].values + origin_m[1]
    digits = 3
    if crs is not None:
        try:
            to_geographic = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
        except pyproj.exceptions.CRSError as error:
            raise ValueError(
                f"`crs` must be a coordinate reference system such as EPSG:32618, got {crs!r}"
            ) from error
        x, y = to_geographic.transform(x, y)
        digits = 8
    ids, t = rows[ident_name].values, rows["time_s"].values
    out = []
    for ident in np.unique(ids):
        mine = np.flatnonzero(ids == ident)
        points = [[round(float(x[k]), digits), round(float(y[k]), digits)] for k in mine]
        out.append(_Line(int(ident), [round(float(t[k]), 6) for k in mine], points))
    return out


def _geojson(lines: list[_Line], crs: str | None, ident_name: str) -> dict:
    features = []
    for line in lines:
        shape = {"type": "LineString", "coordinates": line.points}
        if len(line.points) == 1:
            shape = {"type": "Point", "coordinates": line.points[0]}
        properties = {ident_name: line.ident, "time_s": line.time_s}
        features.append({"type": "Feature", "geometry": shape, "properties": properties})
    out: dict = {"type": "FeatureCollection", "features": features}
    if crs is None:
        out["coordinates"] = "east and north in metres, no CRS was given"
    return out


def _kml(lines: list[_Line], name: str) -> str:
    placemarks = []
    for line in lines:
        points = " ".join(f"{x:.8f},{y:.8f},0" for x, y in line.points)
        shape = "LineString" if len(line.points) > 1 else "Point"
        placemarks.append(
            f"<Placemark><name>track {line.ident}</name><{shape}><coordinates>{points}</coordinates>"
            f"</{shape}></Placemark>"
        )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Document>'
        f"<name>{html.escape(name)}</name>{''.join(placemarks)}</Document></kml>\n"
    )


def _czml(lines: list[_Line], name: str) -> list[dict]:
    """Cesium's time-dynamic form; second 0 is an epoch of its own, since a run has no calendar."""
    epoch = "2000-01-01T00:00:00Z"
    packets: list[dict] = [{"id": "document", "name": name, "version": "1.0"}]
    for line in lines:
        samples = [v for t, (x, y) in zip(line.time_s, line.points, strict=True) for v in (t, x, y, 0.0)]
        packets.append(
            {
                "id": f"track-{line.ident}",
                "position": {"epoch": epoch, "cartographicDegrees": samples},
                "point": {"pixelSize": 6, "heightReference": "CLAMP_TO_GROUND"},
            }
        )
    return packets
