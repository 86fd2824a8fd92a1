"""Write tracks and truth for maps: points and lines as GeoJSON, KML and GeoParquet, and CZML for globes.

GeoJSON, KML and CZML hold longitude and latitude (WGS 84), GeoParquet the projected CRS. In all of them
``east_m`` and ``north_m`` are easting and northing in that CRS. Without a CRS nothing is written.

References
----------
RFC 7946 (GeoJSON), OGC 12-007r2 (KML 2.3), GeoParquet 1.1, the CZML Guide of CesiumJS.
"""

import datetime
import html
import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import shapely
from jaxtyping import Float
from shapely.geometry import mapping
from shapely.geometry.base import BaseGeometry

from glintrack.core.arrays import Array
from glintrack.core.records import Extent
from glintrack.io.crs import longitude_latitude, metric_crs
from glintrack.io.tables import parquet_bytes

UNIX_TIME_S = 1e9  # seconds from which times without a date count from 1970: September 2001
_NO_AREA = Extent(0.0, 0.0, 0.0, 0.0)
_UNIX_ZERO = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
_NO_DATE = datetime.datetime(2000, 1, 1, tzinfo=datetime.UTC)  # of CZML, which needs one
_DECIMALS_DEG = 8  # a millimetre
_DATES = {"time", "begin", "end"}
_SHARES = ("valid", "false", "inside", "moving")  # of a line: share of its points
_MEANS = ("speed_m_s", "visible_fraction")
_POINT = {"pixelSize": 6, "heightReference": {"heightReference": "CLAMP_TO_GROUND"}}
_KML_TYPES = {"b": "bool", "i": "int", "u": "int", "f": "double"}


@dataclass(frozen=True)
class TrackGeoreference:
    """Position and times of tracks and truth, for formats that need more than their table.

    Parameters
    ----------
    crs, origin_m
        Projected CRS in metres, and position of east and north 0 in it [m]. Without a CRS no file for maps is
        written.
    area_m
        West, south, east, north of the frames, for MOTChallenge. [m]
    cell_m
        Side of the frames' pixels, for MOTChallenge. [m]
    times_s
        All epochs, with or without tracks: frames of MOTChallenge. By default those of the tracks. [s]
    time_zero
        Date and time of second 0; None if it is not known.
    """

    crs: str | None = None
    origin_m: tuple[float, float] = (0.0, 0.0)
    area_m: Extent = _NO_AREA
    cell_m: float = 1.0
    times_s: Sequence[float] = ()
    time_zero: datetime.datetime | None = None

    def attributes(self) -> dict[str, str | float]:
        """Return CRS, origin and time zero as attributes of a file in local coordinates, if known."""
        found: dict[str, str | float] = {}
        if self.crs is not None:
            east_m, north_m = self.origin_m
            found = {"crs": self.crs, "origin_easting_m": east_m, "origin_northing_m": north_m}
        return found | ({} if self.time_zero is None else {"time_zero": self.time_zero.isoformat()})

    def dates(self, times_s: Array, otherwise: datetime.datetime | None = None) -> Array | None:
        """UTC of times as ISO 8601, to milliseconds; None if it is not known.

        Parameters
        ----------
        times_s
            Times; without `time_zero` those from `UNIX_TIME_S` on count from 1970. [s]
        otherwise
            Date of second 0 if nothing else is known.
        """
        is_unix = len(times_s) and times_s.min() >= UNIX_TIME_S
        zero = self.time_zero or (_UNIX_ZERO if is_unix else otherwise)
        if zero is None:
            return None
        start = np.datetime64(zero.astimezone(datetime.UTC).replace(tzinfo=None), "ms")
        return np.datetime_as_string(start + np.rint(1e3 * times_s).astype("timedelta64[ms]"), timezone="UTC")


@dataclass(frozen=True)
class Layer:
    """Features of one geometry, all points or all lines.

    Parameters
    ----------
    table
        Attributes, one row for each feature.
    degrees
        Points or lines in longitude and latitude. [°]
    metres
        The same in the projected CRS. [m]
    """

    table: pd.DataFrame
    degrees: Sequence[BaseGeometry]
    metres: Sequence[BaseGeometry]


def id_column(table: pd.DataFrame) -> str:
    """Column that identifies the rows of one track, or of one vehicle of the truth."""
    return "track_id" if "track_id" in table else "vehicle_id"


def _sort_by_id(table: pd.DataFrame) -> pd.DataFrame:
    """Rows of each track or vehicle one after the other, in order of time."""
    order = np.lexsort((table["time_s"].to_numpy(float), table[id_column(table)].to_numpy()))
    return table.take(order.tolist())


def points_layer(table: pd.DataFrame, place: TrackGeoreference) -> Layer:
    """Points of a table of tracks or truth, with all its columns and the ISO 8601 time."""
    metres = table[["east_m", "north_m"]].to_numpy(float) + place.origin_m
    degrees = np.column_stack(longitude_latitude(place.crs, *metres.T)).round(_DECIMALS_DEG)
    attributes = table.assign(east_m=metres[:, 0], north_m=metres[:, 1])
    if (dates := place.dates(table["time_s"].to_numpy(float))) is not None:
        attributes.insert(1, "time", dates)
    return Layer(attributes, _shapes(degrees), _shapes(metres))


def _shapes(vertices: Float[Array, "vertex 2"], ends: Array | None = None) -> list[BaseGeometry]:
    """Points at vertices, or lines that end before the given ones."""
    kind = shapely.GeometryType.POINT if ends is None else shapely.GeometryType.LINESTRING
    return shapely.from_ragged_array(kind, vertices, None if ends is None else (ends,)).tolist()


def lines_layer(table: pd.DataFrame, place: TrackGeoreference) -> Layer:
    """Lines of the tracks, or of the vehicles, that have at least two points.

    Attributes are the id, first and last time, number of points, mean speed and mean visible fraction, the
    shares of points that are measured, valid, false, inside and moving, the class, and the vehicle that a
    track follows most (−1: none), as far as the table has them.
    """
    key, table = id_column(table), _sort_by_id(table)
    size = np.asarray(table.groupby(key)[key].transform("size"))
    table = table.take(np.flatnonzero(size > 1).tolist())
    points, times_s = points_layer(table, place), table["time_s"].to_numpy(float)
    ids, first, count = np.unique(table[key].to_numpy(), return_index=True, return_counts=True)
    columns: dict[str, Any] = {key: ids}
    for name, rows in (("begin", first), ("end", first + count - 1)):
        columns[f"{name}_s"] = times_s[rows]
        if (dates := place.dates(times_s[rows])) is not None:
            columns[name] = dates
    columns["points"] = count
    means = {f"mean_{name}": table[name].to_numpy(float) for name in _MEANS if name in table}
    means |= {f"{name}_share": table[name].to_numpy(float) for name in _SHARES if name in table}
    if "status" in table:
        means["measured_share"] = (table["status"] == "measured").to_numpy(float)
    for name, values in means.items():
        columns[name] = np.add.reduceat(values, first) / count if len(ids) else np.empty(0)
    if "class" in table:
        columns["class"] = table["class"].to_numpy()[first]
    if key == "track_id" and "vehicle_id" in table:
        pieces = np.split(table["vehicle_id"].to_numpy(), first[1:]) if len(ids) else []
        columns["vehicle_id"] = [_most_frequent(piece) for piece in pieces]
    vertices = (shapely.get_coordinates(shapes) for shapes in (points.degrees, points.metres))
    return Layer(pd.DataFrame(columns), *(_shapes(xy, np.r_[0, first + count]) for xy in vertices))


def _most_frequent(ids: Array) -> int:
    """Most frequent id of vehicles, −1 if a track has none."""
    found, count = np.unique(ids[ids >= 0], return_counts=True)
    return int(found[np.argmax(count)]) if len(found) else -1


def _records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows as plain values, None for missing ones."""
    return json.loads(str(table.to_json(orient="records", double_precision=6)))


def _about(place: TrackGeoreference) -> str:
    """Sentence on the CRS of ``east_m`` and ``north_m``."""
    crs = metric_crs(place.crs)
    authority = crs.to_authority()
    name = ":".join(authority) if authority else crs.name
    return f"east_m and north_m are easting and northing in {name}"


def write_geojson(layer: Layer, place: TrackGeoreference) -> bytes:
    """Encode a layer as GeoJSON in WGS 84 (RFC 7946); its description names the CRS of ``east_m``."""
    features = [
        {"type": "Feature", "geometry": mapping(shape), "properties": row}
        for row, shape in zip(_records(layer.table), layer.degrees, strict=True)
    ]
    collection = {"type": "FeatureCollection", "description": _about(place), "features": features}
    return json.dumps(collection, separators=(",", ":"), allow_nan=False).encode()


def write_kml(layer: Layer, place: TrackGeoreference) -> bytes:
    """Encode a layer as KML with typed attributes, clamped to the ground, and times where they are known."""
    key = id_column(layer.table)
    columns = [name for name in layer.table if name not in _DATES]
    types = (_KML_TYPES.get(layer.table[name].dtype.kind, "string") for name in columns)
    fields = "".join(f'<SimpleField type="{k}" name="{n}"/>' for k, n in zip(types, columns, strict=True))
    pieces = [
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Document>',
        f"<name>{key.removesuffix('_id')}s</name><description>{html.escape(_about(place))}</description>",
        f'<Schema name="attributes" id="attributes">{fields}</Schema>',
    ]
    records = _records(layer.table.astype({name: int for name in layer.table.select_dtypes(bool)}))
    for row, shape in zip(records, layer.degrees, strict=True):
        data = "".join(
            f'<SimpleData name="{name}">{html.escape(str(row[name]))}</SimpleData>'
            for name in columns
            if row[name] is not None
        )
        when = f"<TimeStamp><when>{row['time']}</when></TimeStamp>" if "time" in row else ""
        if "begin" in row:
            when = f"<TimeSpan><begin>{row['begin']}</begin><end>{row['end']}</end></TimeSpan>"
        kind, drape = shape.geom_type, "<tessellate>1</tessellate>" if "begin_s" in row else ""
        text = " ".join(f"{x:.8f},{y:.8f},0" for x, y in shape.coords)
        pieces.append(
            f"<Placemark><name>{key.removesuffix('_id')} {row[key]}</name>{when}<ExtendedData>"
            f'<SchemaData schemaUrl="#attributes">{data}</SchemaData></ExtendedData><{kind}>{drape}'
            f"<coordinates>{text}</coordinates></{kind}></Placemark>"
        )
    return "".join([*pieces, "</Document></kml>\n"]).encode()


def write_geoparquet(layer: Layer, place: TrackGeoreference) -> bytes:
    """Encode a layer as GeoParquet in the projected CRS, with dates as timestamps where they are known."""
    table = layer.table.copy()
    for name in _DATES & set(table):
        table[name] = pd.to_datetime(table[name], utc=True).astype("datetime64[ms, UTC]")
    column: dict[str, Any] = {"encoding": "WKB", "crs": metric_crs(place.crs).to_json_dict()}
    column["geometry_types"] = sorted({shape.geom_type for shape in layer.metres})
    if layer.metres:
        column["bbox"] = shapely.total_bounds(layer.metres).tolist()
    geo = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}}
    table["geometry"] = pd.Series(list(shapely.to_wkb(layer.metres)), dtype=object)
    return parquet_bytes(table, {"geo": json.dumps(geo)})


def write_czml(table: pd.DataFrame, place: TrackGeoreference) -> bytes:
    """Encode tracks or truth as CZML: positions over time, availability, and attributes as they change.

    Second 0 is an arbitrary date, 2000-01-01, if none is known.
    """
    key, table = id_column(table), _sort_by_id(table)
    degrees, name = shapely.get_coordinates(points_layer(table, place).degrees), key.removesuffix("_id")
    times_s = table["time_s"].to_numpy(float)
    dates = place.dates(times_s, _NO_DATE)
    assert dates is not None
    document: dict[str, Any] = {"id": "document", "name": f"{name}s", "version": "1.0"}
    if len(table):
        begin, end = dates[np.argmin(times_s)], dates[np.argmax(times_s)]
        document["clock"] = {"interval": f"{begin}/{end}", "currentTime": str(begin), "multiplier": 1}
    packets = [document]
    changing = [c for c in table if table[c].dtype.kind not in "f" and c != key]
    for ident, rows in table.groupby(key).indices.items():
        after_s = (times_s[rows] - times_s[rows[0]]).round(6)
        epoch, when = str(dates[rows[0]]), dates[rows].tolist()
        samples = np.column_stack([after_s, degrees[rows], np.zeros(len(rows))])
        properties: dict[str, Any] = {
            c: _intervals(table[c].to_numpy()[rows].tolist(), when) for c in changing
        }
        for column in _MEANS:
            if column in table:
                pairs = np.column_stack([after_s, table[column].to_numpy(float)[rows].round(4)])
                properties[column] = {"epoch": epoch, "number": pairs.ravel().tolist()}
        packets.append(
            {
                "id": f"{name}-{ident}",
                "name": f"{name} {ident}",
                "availability": f"{epoch}/{when[-1]}",
                "position": {"epoch": epoch, "cartographicDegrees": samples.ravel().tolist()},
                "properties": properties,
                "point": _POINT,
            }
        )
    return json.dumps(packets, separators=(",", ":"), allow_nan=False).encode()


def _intervals(values: list[Any], dates: list[str]) -> list[dict[str, Any]]:
    """Intervals of CZML in which an attribute is constant; the last one ends with the last date."""
    starts = [k for k in range(len(values)) if k == 0 or values[k] != values[k - 1]]
    kind = {bool: "boolean", int: "number"}.get(type(values[0]), "string")
    return [
        {"interval": f"{dates[a]}/{dates[b]}", kind: values[a]}
        for a, b in itertools.pairwise([*starts, len(values) - 1])
    ]
