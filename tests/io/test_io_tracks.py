"""Tracks and truth in every format: one table, one frame of reference."""

import datetime
import json
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pandas as pd
import pyarrow.parquet
import pyproj
import pytest
import shapely
import xarray as xr

from glintrack.core.records import Extent
from glintrack.io.detections import read_detections, read_tracks, read_truth
from glintrack.io.map_files import TrackGeoreference
from glintrack.io.orthoimages import Geotransform
from glintrack.io.readings import collect_readings
from glintrack.io.tracks import (
    BOX_M,
    MATCH_COLUMNS,
    TRACK_COLUMNS,
    TRUTH_COLUMNS,
    WRITERS,
    track_table,
    truth_table,
    write_tables,
)

CRS = "EPSG:32632"
ORIGIN_M = (500_000.0, 5_500_000.0)
AREA_M = (-100.0, -50.0, 100.0, 50.0)
NOON = datetime.datetime(2026, 7, 15, 14, 0, tzinfo=datetime.timezone(datetime.timedelta(hours=2)))
PLACE = TrackGeoreference(CRS, ORIGIN_M, AREA_M, 0.5, (0.0, 0.5), NOON)
MAP_FILES = [ending for ending in WRITERS if ending not in (".csv", ".parquet", "_mot.txt")]
KML = {"k": "http://www.opengis.net/kml/2.2"}


def rows_of(**columns):
    return xr.Dataset({name: ("row", np.asarray(values)) for name, values in columns.items()})


@pytest.fixture
def rows():
    """A track that is lost to another vehicle in its third frame, and one seen once."""
    other = ("east_var_m2", "north_var_m2", "east_north_cov_m2")
    return rows_of(
        time_s=[0.0, 0.5, 1.0, 0.5],
        track_id=[0, 0, 0, 7],
        east_m=[-10.0, 0.0, 10.0, 20.0],
        north_m=[20.0, 20.0, 20.0, -5.0],
        east_speed_m_s=[3.0, 3.0, 3.0, 0.0],
        north_speed_m_s=[4.0, 4.0, 4.0, 0.0],
        status=["measured", "measured", "coasted", "measured"],
        vehicle_id=[5, 5, -1, -1],
        valid=[True, True, False, False],
        false=[False, False, True, True],
        **{name: [1.0] * 4 for name in other},
    )


@pytest.fixture
def vehicles():
    """One vehicle driving east over two frames, one turned by 30°, and a motorcycle outside."""
    return rows_of(
        time_s=[0.0, 0.5, 0.5, 0.5],
        vehicle_id=[0, 0, 7, 8],
        east_m=[-10.0, 0.0, 20.0, 150.0],
        north_m=[20.0, 20.0, -5.0, 0.0],
        east_speed_m_s=[20.0, 20.0, 1.0, 0.0],
        north_speed_m_s=[0.0, 0.0, 2.0, 0.0],
        heading_rad=np.radians([90.0, 90.0, 30.0, 0.0]),
        **{"class": ["car", "car", "truck", "motorcycle"]},
        length_m=[4.0, 4.0, 6.0, 4.0],
        width_m=[2.0, 2.0, 2.0, 2.0],
        visible_fraction=[1.0, 0.25, 0.5, 0.0],
        inside=[True, True, True, False],
        moving=[True, True, True, False],
    )


def features_of(path):
    collection = json.loads(path.read_text())
    assert collection["type"] == "FeatureCollection" and "crs" not in collection  # RFC 7946
    return collection["features"]


def test_every_format_is_written_and_those_of_the_map_need_a_crs(tmp_path, rows):
    table = track_table(rows)
    assert write_tables(tmp_path, table, "t", PLACE) == [f"t{ending}" for ending in WRITERS]
    assert all((tmp_path / f"t{ending}").stat().st_size > 0 for ending in WRITERS)
    written = write_tables(tmp_path, table, "u", TrackGeoreference())
    assert written == ["u.csv", "u.parquet", "u_mot.txt"]


def test_csv_and_parquet_hold_one_table_in_local_coordinates(tmp_path, rows):
    table = track_table(rows)
    write_tables(tmp_path, table, "t", PLACE)
    assert list(table) == [*TRACK_COLUMNS, *MATCH_COLUMNS] and set(table["speed_m_s"]) == {5.0, 0.0}
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "t.csv"), table, check_dtype=False)
    pd.testing.assert_frame_equal(pd.read_parquet(tmp_path / "t.parquet"), table)
    schema = pyarrow.parquet.read_schema(tmp_path / "t.parquet")
    assert schema.field("east_speed_m_s").metadata == {b"units": b"m/s"}
    about = {"crs": CRS, "origin_easting_m": "500000.0", "origin_northing_m": "5500000.0"}
    assert about.items() <= {k.decode(): v.decode() for k, v in schema.metadata.items()}.items()


def test_tracks_without_truth_have_no_column_of_it(rows):
    assert list(track_table(rows.drop_vars(MATCH_COLUMNS))) == list(TRACK_COLUMNS)


def test_times_of_a_clock_since_1970_stay_apart_and_have_their_date(tmp_path, rows):
    table = track_table(rows.assign(time_s=rows["time_s"] + 1.7e9))
    write_tables(tmp_path, table, "t", TrackGeoreference(CRS, ORIGIN_M))
    assert pd.read_csv(tmp_path / "t.csv")["time_s"].tolist()[:2] == [1.7e9, 1.7e9 + 0.5]
    points = features_of(tmp_path / "t_points.geojson")
    assert points[1]["properties"]["time"] == "2023-11-14T22:13:20.500Z"


def test_without_a_date_no_file_but_czml_has_one(tmp_path, rows):
    write_tables(tmp_path, track_table(rows), "t", TrackGeoreference(CRS, ORIGIN_M))
    for kind in ("points", "lines"):
        names = set(features_of(tmp_path / f"t_{kind}.geojson")[0]["properties"])
        assert not names & {"time", "begin", "end"} and names & {"time_s", "begin_s"}
    assert "Time" not in (tmp_path / "t_lines.kml").read_text().replace("time_s", "")
    packets = json.loads((tmp_path / "t.czml").read_text())
    assert packets[0]["clock"]["currentTime"] == "2000-01-01T00:00:00.000Z"


def test_points_have_all_columns_and_the_easting_of_the_map(tmp_path, rows):
    table = track_table(rows)
    write_tables(tmp_path, table, "t", PLACE)
    points = features_of(tmp_path / "t_points.geojson")
    assert {f["geometry"]["type"] for f in points} == {"Point"} and len(points) == len(table)
    assert set(points[0]["properties"]) == {*table, "time"}
    third = points[2]["properties"]
    assert third["time"] == "2026-07-15T12:00:01.000Z" and third["status"] == "coasted"
    assert (third["valid"], third["false"], third["vehicle_id"]) == (False, True, -1)
    assert (third["east_m"], third["north_m"]) == (500_010.0, 5_500_020.0)
    # easting 500 km is the zone's middle, 9° east; ten metres there are 1.4e-4 degrees of longitude at 49.6°
    longitudes = [f["geometry"]["coordinates"][0] for f in points]
    assert longitudes[1] == pytest.approx(9.0, abs=1e-6)
    assert longitudes[1] - longitudes[0] == pytest.approx(1.4e-4, rel=0.02)


def test_lines_summarize_the_points_of_tracks_with_two_or_more(tmp_path, rows, vehicles):
    write_tables(tmp_path, track_table(rows), "t", PLACE)
    (line,) = features_of(tmp_path / "t_lines.geojson")
    assert line["geometry"]["type"] == "LineString" and len(line["geometry"]["coordinates"]) == 3
    assert line["properties"] == {
        "track_id": 0,
        "begin_s": 0.0,
        "begin": "2026-07-15T12:00:00.000Z",
        "end_s": 1.0,
        "end": "2026-07-15T12:00:01.000Z",
        "points": 3,
        "mean_speed_m_s": 5.0,
        "valid_share": pytest.approx(2 / 3, abs=1e-6),
        "false_share": pytest.approx(1 / 3, abs=1e-6),
        "measured_share": pytest.approx(2 / 3, abs=1e-6),
        "vehicle_id": 5,
    }
    write_tables(tmp_path, truth_table(vehicles), "truth", PLACE)
    (line,) = features_of(tmp_path / "truth_lines.geojson")
    found = line["properties"]
    assert (found["vehicle_id"], found["class"]) == (0, "car")
    assert (found["mean_visible_fraction"], found["inside_share"]) == (0.625, 1.0)


def test_kml_has_typed_attributes_and_times(tmp_path, vehicles):
    write_tables(tmp_path, truth_table(vehicles), "truth", PLACE)
    root = ElementTree.parse(tmp_path / "truth_points.kml").getroot()
    types = {f.get("name"): f.get("type") for f in root.iterfind(".//k:SimpleField", KML)}
    assert types["speed_m_s"] == "double" and types["inside"] == "bool" and types["class"] == "string"
    marks = root.findall(".//k:Placemark", KML)
    whens = [mark.find("k:TimeStamp/k:when", KML).text for mark in marks[:2]]
    assert whens == ["2026-07-15T12:00:00.000Z", "2026-07-15T12:00:00.500Z"]
    values = {d.get("name"): d.text for d in marks[2].iterfind(".//k:SimpleData", KML)}
    assert values["class"] == "truck" and values["inside"] == "1" and values["east_m"] == "500020.0"
    lines = ElementTree.parse(tmp_path / "truth_lines.kml").getroot()
    assert len(lines.findall(".//k:LineString", KML)) == 1
    assert lines.find(".//k:TimeSpan/k:end", KML).text == "2026-07-15T12:00:00.500Z"


@pytest.mark.parametrize(("kind", "shape"), [("points", "Point"), ("lines", "LineString")])
def test_geoparquet_holds_the_projected_crs(tmp_path, rows, kind, shape):
    write_tables(tmp_path, track_table(rows), "t", PLACE)
    table = pyarrow.parquet.read_table(tmp_path / f"t_{kind}.parquet")
    geo = json.loads(table.schema.metadata[b"geo"])
    column = geo["columns"][geo["primary_column"]]
    assert (geo["version"], column["encoding"], column["geometry_types"]) == ("1.1.0", "WKB", [shape])
    assert pyproj.CRS.from_json_dict(column["crs"]) == pyproj.CRS(CRS)
    geometry = shapely.from_wkb(table["geometry"].to_pylist())
    assert column["bbox"] == shapely.total_bounds(geometry).tolist()
    if kind == "points":
        np.testing.assert_array_equal(shapely.get_x(geometry), table["east_m"])
        assert str(table["time"].type) == "timestamp[ms, tz=UTC]"


def test_czml_samples_positions_and_ends_attributes_where_they_change(tmp_path, rows):
    write_tables(tmp_path, track_table(rows), "t", PLACE)
    document, packet, single = json.loads((tmp_path / "t.czml").read_text())
    whole = "2026-07-15T12:00:00.000Z/2026-07-15T12:00:01.000Z"
    assert (document["id"], document["version"], document["clock"]["interval"]) == ("document", "1.0", whole)
    assert (packet["id"], packet["availability"]) == ("track-0", whole)
    position, properties = packet["position"], packet["properties"]
    assert position["epoch"] == "2026-07-15T12:00:00.000Z"
    samples = np.reshape(position["cartographicDegrees"], (-1, 4))
    assert samples[:, 0].tolist() == [0.0, 0.5, 1.0] and samples[1, 1] == pytest.approx(9.0, abs=1e-6)
    assert properties["speed_m_s"]["number"] == [0.0, 5.0, 0.5, 5.0, 1.0, 5.0]
    states = [(piece["interval"][11:21], piece["string"]) for piece in properties["status"]]
    assert states == [("12:00:00.0", "measured"), ("12:00:01.0", "coasted")]
    assert [piece["boolean"] for piece in properties["valid"]] == [True, False]
    assert single["availability"].split("/")[0] == single["availability"].split("/")[1]


def test_nobody_is_an_empty_file_in_every_format(tmp_path):
    write_tables(tmp_path, truth_table(xr.Dataset()), "truth", PLACE)
    write_tables(tmp_path, track_table(xr.Dataset()), "t", PLACE)
    for stem, columns in (("truth", TRUTH_COLUMNS), ("t", TRACK_COLUMNS)):
        assert {p.name for p in tmp_path.glob(f"{stem}[._]*")} == {f"{stem}{ending}" for ending in WRITERS}
        for kind in ("points", "lines"):
            assert features_of(tmp_path / f"{stem}_{kind}.geojson") == []
            assert len(pd.read_parquet(tmp_path / f"{stem}_{kind}.parquet")) == 0
        assert (tmp_path / f"{stem}_mot.txt").read_text() == ""
        for table in (pd.read_csv(tmp_path / f"{stem}.csv"), pd.read_parquet(tmp_path / f"{stem}.parquet")):
            assert list(table) == list(columns) and len(table) == 0
        assert len(json.loads((tmp_path / f"{stem}.czml").read_text())) == 1


@pytest.mark.parametrize(
    ("crs", "sentence"),
    [
        ("EPSG:nothing", "must be a coordinate reference system"),
        ("EPSG:4326", "must be projected and in metres"),
        ("EPSG:2263", "must be projected and in metres"),  # feet
    ],
)
def test_a_crs_that_is_none_or_counts_degrees_is_refused(rows, crs, sentence):
    for ending in MAP_FILES:
        with pytest.raises(ValueError, match=f"`crs` {sentence}"):
            WRITERS[ending](track_table(rows), TrackGeoreference(crs))


def mot_lines(path):
    return [[float(v) for v in line.split(",")] for line in path.read_text().splitlines()]


def test_mot_tracks_lie_on_the_truths_boxes(tmp_path):
    """Of a perfect track, whose vehicle is as large as a track's box, both files say the same; frames too."""
    columns = {"time_s": [0.5, 1.5], "track_id": [3, 3], "vehicle_id": [3, 3]}
    columns |= {"east_m": [-10.0, 4.0], "north_m": [20.0, 20.0], "heading_rad": [0.0, np.pi / 2]}
    columns |= {"length_m": [BOX_M] * 2, "width_m": [BOX_M] * 2, "visible_fraction": [1.0, 1.0]}
    columns |= {"east_speed_m_s": [0.0, 0.0], "north_speed_m_s": [0.0, 0.0]}
    rows = rows_of(**columns)
    place = TrackGeoreference(area_m=Extent(*AREA_M), cell_m=0.5, times_s=(0.0, 0.5, 1.0, 1.5))
    write_tables(tmp_path, truth_table(rows), "truth", place)
    write_tables(tmp_path, track_table(rows), "t", place)
    truth, tracks = mot_lines(tmp_path / "truth_mot.txt"), mot_lines(tmp_path / "t_mot.txt")
    assert [line[:6] for line in truth] == [line[:6] for line in tracks]
    assert [line[0] for line in truth] == [2, 4]  # the frames of the flight, though nobody is seen in some


def test_mot_boxes_worked_by_hand(tmp_path, vehicles):
    write_tables(tmp_path, truth_table(vehicles), "truth", PLACE)
    lines = mot_lines(tmp_path / "truth_mot.txt")
    # 4 m by 2 m heading east about (-10, 20): from west -12 to -8 and from north 21 to 19, in cells of 0.5 m
    assert lines[0] == [1, 1, (100 - 12) / 0.5 + 1, (50 - 21) / 0.5 + 1, 8, 4, 1, 3, 1]
    assert [line[:2] for line in lines] == [[1, 1], [2, 1], [2, 8]]
    wide, high = 6 * 0.5 + 2 * np.sqrt(0.75), 6 * np.sqrt(0.75) + 2 * 0.5
    two_decimals = 0.005
    assert lines[2][4:6] == pytest.approx([wide / 0.5, high / 0.5], abs=two_decimals)
    assert [line[8] for line in lines] == [1, 0.25, 0.5]
    in_view = truth_table(vehicles.assign(east_m=("row", [-10.0, 0.0, 20.0, 0.0])))
    assert WRITERS["_mot.txt"](in_view, PLACE).decode().splitlines()[3].split(",")[7] == "5"  # a motorcycle


GRID = Geotransform(AREA_M[0], AREA_M[3], PLACE.cell_m)
RATE_HZ = 2.0


def test_motchallenge_text_is_read_back(tmp_path, rows):
    place = replace(PLACE, times_s=(0.0, 0.5, 1.0))
    write_tables(tmp_path, track_table(rows), "t", place)
    table, path = read_tracks(tmp_path / "t.csv").sortby("time_s"), tmp_path / "t_mot.txt"
    for grid, rounding_m in (
        (None, 5e-4),
        (GRID, 0.01 * PLACE.cell_m),
    ):  # its own metres; two digits of a pixel
        found = read_tracks(path, RATE_HZ, grid)
        np.testing.assert_array_equal(found["time_s"], table["time_s"])
        np.testing.assert_array_equal(found["track_id"], table["track_id"] + 1)
        for axis in ("east_m", "north_m"):
            np.testing.assert_allclose(found[axis], table[axis], rtol=0, atol=rounding_m)
    detections = read_detections(path, 0.5, None, RATE_HZ)
    np.testing.assert_allclose(detections.position[:, 0], [-10, 0, 20, 10])
    assert detections.feature_names == ()


def test_motchallenge_truth_is_read_back_in_metres(tmp_path, vehicles):
    write_tables(tmp_path, truth_table(vehicles), "t", PLACE)
    path, inside = tmp_path / "t_mot.txt", vehicles.isel(row=slice(3))
    found = read_truth(path, RATE_HZ, GRID)
    for name in ("time_s", "visible_fraction"):
        np.testing.assert_array_equal(found[name], inside[name])
    for axis in ("east_m", "north_m"):
        np.testing.assert_allclose(found[axis], inside[axis], rtol=0, atol=0.01 * PLACE.cell_m)
    with pytest.raises(ValueError, match="`geotransform` must be given for boxes in pixels"):
        read_truth(path, RATE_HZ)


def test_boxes_that_do_not_count_are_left_out(tmp_path):
    """A flag of 0 and a pedestrian, as in MOT17's ground truth; boxes in the order of their ids."""
    lines = ["1,1,11,21,10,20,1,3,1", "2,1,12,21,10,20,1,3,0.5", "1,2,0,0,9,9,0,3,1", "1,3,0,0,9,9,1,1,1"]
    (tmp_path / "gt.txt").write_text("\n".join(lines))
    with collect_readings() as readings:
        found = read_truth(tmp_path / "gt.txt", 30.0, Geotransform(1000, 2000, 0.5))
    assert found["east_m"].values.tolist() == [1007.5, 1008]  # by hand: 1000 + 0.5 (11 - 1 + 10 / 2)
    assert found["north_m"].values.tolist() == [1985, 1985]
    assert found["time_s"].values.tolist() == [0, 1 / 30]
    assert dict(readings[0].left_out) == {"flag 0": 1, "class of no motor vehicle (3, 5 are)": 1}
    (tmp_path / "gt.txt").write_text("1,3,0,0,9,9,1,1,1\n")
    with pytest.raises(ValueError, match="must hold boxes of class 3 or 5"):
        read_truth(tmp_path / "gt.txt", 30.0, GRID)


def test_columns_of_other_data_sets_are_known_or_refused(tmp_path):
    """VisDrone's van, pedestrian and ignored region; a flag of 0 in ten columns; a category in the ninth."""
    path = tmp_path / "gt.txt"
    path.write_text("1,1,11,21,10,20,1,5,0,2\n1,2,50,50,9,9,1,1,0,0\n1,0,80,80,40,40,0,0,0,0\n")
    with collect_readings() as readings:
        found = read_truth(path, 30.0, GRID)
    assert found["vehicle_id"].values.tolist() == [1]
    assert dict(readings[0].left_out) == {
        "flag 0": 1,
        "class of no motor vehicle (4, 5, 6, 9, 10 are)": 1,
    }
    path.write_text("1,1,11,21,10,20,1,-1,-1,-1\n1,2,50,50,9,9,0,-1,-1,-1\n")
    assert read_truth(path, 30.0, GRID)["vehicle_id"].values.tolist() == [1]
    path.write_text("1,1,11,21,10,20,1,1,1\n1,2,50,50,9,9,1,1,3\n")
    with pytest.raises(ValueError, match=r"visible fraction, 0 to 1, in column 9 as MOT16 has; got 3"):
        read_truth(path, 30.0, GRID)


@pytest.mark.parametrize(
    ("text", "options", "sentence"),
    [
        ("1,1,5,5,9,9,1,-1,-1,-1\n2,1,7,5,9,9,1,-1,-1,-1\n", {}, "`rate` must be given with frame numbers"),
        ("1,1,5,5,9,9,1,-1,-1,-1\n", {"rate_hz": 0.001}, "`rate` must be 0.1 to 1,000 Hz"),
        ("1,1,5,5,9,9,1,-1,-1,-1\n2,1,7,5,9,9,1,-1,-1,-1\n", {"rate_hz": 5}, "`geotransform` must be given"),
        ("1,1,5,5,9,9,1,4,0,0\n2,1,7,5,9,9,1,4,1,1\n", {"rate_hz": 5}, "`geotransform` must be given"),
        ("0,1,5,5,9,9,1\n", {"rate_hz": 5, "grid": GRID}, "frame of 1 to 1,000,000"),
        ("1,1,5,5,0,9,1\n", {"rate_hz": 5, "grid": GRID}, "width and height above 0"),
        ("1,1,5,5\n", {"rate_hz": 5, "grid": GRID}, "must be MOTChallenge text"),
        ("frame,id\n1,2\n", {"rate_hz": 5, "grid": GRID}, "must be MOTChallenge text of numbers"),
        ("1,1,5,5,9,9\n1,1,5,5\n", {"rate_hz": 5, "grid": GRID}, "must be MOTChallenge text of numbers"),
    ],
)
def test_other_text_is_refused_with_what_is_missing(tmp_path, text, options, sentence):
    (tmp_path / "t.txt").write_text(text)
    with pytest.raises(ValueError, match=sentence):
        read_tracks(tmp_path / "t.txt", **options)


def test_motchallenge_text_called_csv_is_recognized(tmp_path):
    (tmp_path / "t.csv").write_text("1,1,5,5,9,9,1,-1,-1,-1\n2,1,7,5,9,9,1,-1,-1,-1\n")
    with pytest.raises(ValueError, match=r"let its name end in .txt"):
        read_tracks(tmp_path / "t.csv")
    (tmp_path / "t.txt").write_text("")
    assert read_tracks(tmp_path / "t.txt", 5.0).sizes["row"] == 0


def test_flags_of_another_layout_are_refused(tmp_path):
    """Out of view of 1 to 3, occlusion, category: every car would be dropped or counted by its occlusion."""
    (tmp_path / "gt.txt").write_text("1,1,11,21,10,20,1,1,1\n2,1,12,21,10,20,2,3,1\n")
    with pytest.raises(ValueError, match="must have a flag of 0 or 1"):
        read_truth(tmp_path / "gt.txt", 30.0, Geotransform(1000, 2000, 0.5))
