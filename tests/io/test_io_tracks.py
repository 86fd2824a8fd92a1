"""Tracks in every format: one table, one frame of reference with the truth."""

import json

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from glintrack.io.detections import read_detections, read_tracks, read_truth
from glintrack.io.orthoimages import Geotransform
from glintrack.io.readings import collect_readings
from glintrack.io.tracks import (
    BOX_M,
    TRACK_COLUMNS,
    WRITERS,
    TrackGeoreference,
    track_table,
    write_mot_truth,
    write_paths,
    write_tracks,
)

ORIGIN_M = (500_000.0, 5_500_000.0)
AREA_M = (-100.0, -50.0, 100.0, 50.0)
PLACE = TrackGeoreference("EPSG:32632", ORIGIN_M, (-100.0, 50.0), 0.5, (0.0, 0.5))


@pytest.fixture
def rows():
    """One vehicle driving east over two frames, and one seen once."""
    places = {"east_m": [-10.0, 0.0, 20.0], "north_m": [20.0, 20.0, -5.0]}
    other = (
        "east_speed_m_s",
        "north_speed_m_s",
        "east_var_m2",
        "north_var_m2",
        "east_north_cov_m2",
    )
    ids = {"time_s": [0.0, 0.5, 0.5], "vehicle_id": [0, 0, 7], "track_id": [0, 0, 7]}
    columns = ids | places | {key: [1.0, 1.0, 1.0] for key in other} | {"status": ["coasted"] * 3}
    return xr.Dataset({name: ("row", values) for name, values in columns.items()})


def features_of(path):
    return json.loads(path.read_text())["features"]


def test_every_format_is_written_and_those_of_the_map_need_a_crs(tmp_path, rows):
    assert write_tracks(tmp_path, rows, "t", PLACE) == [f"t{ending}" for ending in WRITERS]
    assert all((tmp_path / f"t{ending}").stat().st_size > 0 for ending in WRITERS)
    written = write_tracks(tmp_path, rows, "u", TrackGeoreference())
    assert {"u.csv", "u.parquet", "u_mot.txt"} <= set(written)
    assert not any(name.endswith((".geojson", ".kml", ".czml")) for name in written)


def test_csv_and_parquet_hold_one_table(tmp_path, rows):
    write_tracks(tmp_path, rows, "t", PLACE)
    table = track_table(rows)
    assert list(table) == list(TRACK_COLUMNS) and set(table["status"]) == {"coasted"}
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "t.csv"), table, check_dtype=False)
    pd.testing.assert_frame_equal(pd.read_parquet(tmp_path / "t.parquet"), table)


def test_times_of_a_clock_since_1970_stay_apart(tmp_path, rows):
    write_tracks(tmp_path, rows.assign(time_s=rows["time_s"] + 1.7e9), "t", TrackGeoreference())
    assert pd.read_csv(tmp_path / "t.csv")["time_s"].tolist() == [1.7e9, 1.7e9 + 0.5, 1.7e9 + 0.5]


def test_lines_lie_in_longitude_and_latitude(tmp_path, rows):
    write_tracks(tmp_path, rows, "t", PLACE)
    line, point = features_of(tmp_path / "t.geojson")
    assert line["properties"] == {"track_id": 0, "time_s": [0.0, 0.5], "status": ["coasted"] * 2}
    assert line["geometry"]["type"] == "LineString" and point["geometry"]["type"] == "Point"
    # easting 500 km is the zone's middle, 9° east; ten metres there are 1.4e-4 degrees of longitude at 49.6°
    longitudes = [c[0] for c in line["geometry"]["coordinates"]]
    assert longitudes[1] == pytest.approx(9.0, abs=1e-6)
    assert longitudes[1] - longitudes[0] == pytest.approx(1.4e-4, rel=0.02)


def test_the_truths_ways_are_those_of_its_vehicles(tmp_path, rows):
    write_paths(tmp_path / "truth.geojson", rows, PLACE)
    write_tracks(tmp_path, rows, "t", PLACE)
    mine, theirs = features_of(tmp_path / "truth.geojson"), features_of(tmp_path / "t.geojson")
    assert [f["geometry"] for f in mine] == [f["geometry"] for f in theirs]
    assert [f["properties"]["vehicle_id"] for f in mine] == [0, 7]


def test_nobody_is_an_empty_file_in_every_format(tmp_path):
    write_paths(tmp_path / "truth.geojson", xr.Dataset(), PLACE)
    write_mot_truth(tmp_path / "gt.txt", xr.Dataset(), AREA_M, PLACE)
    write_tracks(tmp_path, xr.Dataset(), "t", PLACE)
    assert features_of(tmp_path / "truth.geojson") == features_of(tmp_path / "t.geojson") == []
    assert (tmp_path / "t_mot.txt").read_text() == (tmp_path / "gt.txt").read_text() == ""
    assert len(pd.read_csv(tmp_path / "t.csv")) == len(pd.read_parquet(tmp_path / "t.parquet")) == 0


@pytest.mark.parametrize(
    ("crs", "sentence"),
    [
        ("EPSG:nothing", "must be a coordinate reference system"),
        ("EPSG:4326", "must be projected and in metres"),
        ("EPSG:2263", "must be projected and in metres"),  # feet
    ],
)
def test_a_crs_that_is_none_or_counts_degrees_is_refused(tmp_path, rows, crs, sentence):
    with pytest.raises(ValueError, match=f"`crs` {sentence}"):
        write_tracks(tmp_path, rows, "t", TrackGeoreference(crs))


def mot_lines(path):
    return [[float(v) for v in line.split(",")] for line in path.read_text().splitlines()]


def test_mot_tracks_lie_on_the_truths_boxes(tmp_path):
    """Of a perfect track, whose vehicle is as large as a track's box, both files say the same; frames too."""
    columns = {"time_s": [0.5, 1.5], "track_id": [3, 3], "vehicle_id": [3, 3]}
    columns |= {"east_m": [-10.0, 4.0], "north_m": [20.0, 20.0], "heading_rad": [0.0, np.pi / 2]}
    columns |= {"length_m": [BOX_M] * 2, "width_m": [BOX_M] * 2, "visible_fraction": [1.0, 1.0]}
    rows = xr.Dataset({name: ("row", values) for name, values in columns.items()})
    place = TrackGeoreference(north_west_m=(-100.0, 50.0), cell_m=0.5, times_s=(0.0, 0.5, 1.0, 1.5))
    write_mot_truth(tmp_path / "gt.txt", rows, AREA_M, place)
    write_tracks(tmp_path, rows, "t", place)
    truth, tracks = mot_lines(tmp_path / "gt.txt"), mot_lines(tmp_path / "t_mot.txt")
    assert [line[:6] for line in truth] == [line[:6] for line in tracks]
    assert [line[0] for line in truth] == [2, 4]  # the frames of the flight, though nobody is seen in some


def truth_rows(**columns):
    return xr.Dataset({name: ("row", np.asarray(values)) for name, values in columns.items()})


@pytest.fixture
def vehicles():
    """One vehicle driving east over two frames, one turned by 30°, and one outside."""
    return truth_rows(
        time_s=[0.0, 0.5, 0.5, 0.5],
        vehicle_id=[0, 0, 7, 8],
        east_m=[-10.0, 0.0, 20.0, 150.0],
        north_m=[20.0, 20.0, -5.0, 0.0],
        heading_rad=np.radians([90.0, 90.0, 30.0, 0.0]),
        length_m=[4.0, 4.0, 6.0, 4.0],
        width_m=[2.0, 2.0, 2.0, 2.0],
        visible_fraction=[1.0, 0.25, 0.5, 0.0],
    )


def test_mot_boxes_worked_by_hand(tmp_path, vehicles):
    write_mot_truth(tmp_path / "gt.txt", vehicles, AREA_M, PLACE)
    lines = [[float(v) for v in line.split(",")] for line in (tmp_path / "gt.txt").read_text().splitlines()]
    # 4 m by 2 m heading east about (-10, 20): from west -12 to -8 and from north 21 to 19, in cells of 0.5 m
    assert lines[0] == [1, 1, (100 - 12) / 0.5 + 1, (50 - 21) / 0.5 + 1, 8, 4, 1, 3, 1]
    assert [line[:2] for line in lines] == [[1, 1], [2, 1], [2, 8]]
    wide, high = 6 * 0.5 + 2 * np.sqrt(0.75), 6 * np.sqrt(0.75) + 2 * 0.5
    two_decimals = 0.005
    assert lines[2][4:6] == pytest.approx([wide / 0.5, high / 0.5], abs=two_decimals)
    assert [line[8] for line in lines] == [1, 0.25, 0.5]


GRID = Geotransform(*PLACE.north_west_m, PLACE.cell_m)
RATE_HZ = 2.0


def test_motchallenge_text_is_read_back(tmp_path, rows):
    write_tracks(tmp_path, rows, "t", PLACE)
    table, path = read_tracks(tmp_path / "t.csv"), tmp_path / "t_mot.txt"
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
    np.testing.assert_allclose(detections.position[:, 0], [-10, 0, 20])
    assert detections.feature_names == ()


def test_motchallenge_truth_is_read_back_in_metres(tmp_path, rows):
    size = {"heading_rad": [0.3, 0.3, 1.0], "length_m": [4.5] * 3, "width_m": [1.8] * 3}
    full = rows.assign({k: ("row", v) for k, v in {**size, "visible_fraction": [1, 0.25, 0.5]}.items()})
    write_mot_truth(tmp_path / "t.txt", full, AREA_M, PLACE)
    found = read_truth(tmp_path / "t.txt", RATE_HZ, GRID)
    np.testing.assert_array_equal(found["time_s"], full["time_s"])
    np.testing.assert_array_equal(found["visible_fraction"], [1, 0.25, 0.5])
    for axis in ("east_m", "north_m"):
        np.testing.assert_allclose(found[axis], full[axis], rtol=0, atol=0.01 * PLACE.cell_m)
    with pytest.raises(ValueError, match="`geotransform` must be given for boxes in pixels"):
        read_truth(tmp_path / "t.txt", RATE_HZ)


def test_boxes_that_do_not_count_are_left_out(tmp_path):
    """A flag of 0 and a pedestrian, as in MOT17's ground truth; boxes in the order of their ids."""
    lines = ["1,1,11,21,10,20,1,3,1", "2,1,12,21,10,20,1,3,0.5", "1,2,0,0,9,9,0,3,1", "1,3,0,0,9,9,1,1,1"]
    (tmp_path / "gt.txt").write_text("\n".join(lines))
    with collect_readings() as readings:
        found = read_truth(tmp_path / "gt.txt", 30.0, Geotransform(1000, 2000, 0.5))
    assert found["east_m"].values.tolist() == [1007.5, 1008]  # by hand: 1000 + 0.5 (11 - 1 + 10 / 2)
    assert found["north_m"].values.tolist() == [1985, 1985]
    assert found["time_s"].values.tolist() == [0, 1 / 30]
    assert dict(readings[0].left_out) == {"flag 0": 1, "class of no motor vehicle (car 3, motorbike 5)": 1}
    (tmp_path / "gt.txt").write_text("1,3,0,0,9,9,1,1,1\n")
    with pytest.raises(ValueError, match="must hold boxes of class 3 or 5"):
        read_truth(tmp_path / "gt.txt", 30.0, GRID)


@pytest.mark.parametrize(
    ("text", "options", "sentence"),
    [
        ("1,1,5,5,9,9,1,-1,-1,-1\n2,1,7,5,9,9,1,-1,-1,-1\n", {}, "`rate` must be given for frame numbers"),
        ("1,1,5,5,9,9,1,-1,-1,-1\n", {"rate_hz": 0.001}, "`rate` must be 0.1 to 1,000 Hz"),
        ("1,1,5,5,9,9,1,-1,-1,-1\n2,1,7,5,9,9,1,-1,-1,-1\n", {"rate_hz": 5}, "`geotransform` must be given"),
        ("1,1,5,5,9,9,1,4,0,0\n2,1,7,5,9,9,1,4,1,1\n", {"rate_hz": 5}, "`geotransform` must be given"),
        ("0,1,5,5,9,9,1\n", {"rate_hz": 5, "grid": GRID}, "frame from 1"),
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
