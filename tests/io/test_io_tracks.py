"""Ways of tracks and of the truth as lines on the map."""

import json

import pytest
import xarray as xr

from glintrack.io.tracks import write_geojson, write_tracks

ORIGIN_M = (500_000.0, 5_500_000.0)


@pytest.fixture
def rows():
    """One vehicle driving east over two frames, and one seen once."""
    places = {"east": [-10.0, 0.0, 20.0], "north": [20.0, 20.0, -5.0]}
    other = ("east_speed", "north_speed", "east_var", "north_var", "east_north_cov", "coasted")
    ids = {"time_s": [0.0, 0.5, 0.5], "vehicle_id": [0, 0, 7], "track_id": [0, 0, 7]}
    columns = ids | places | dict.fromkeys(other, [1.0, 1.0, 1.0])
    return xr.Dataset({name: ("row", values) for name, values in columns.items()})


def features_of(path):
    return json.loads(path.read_text())["features"]


def test_lines_lie_in_longitude_and_latitude(tmp_path, rows):
    write_geojson(tmp_path / "t.geojson", rows, "EPSG:32632", ORIGIN_M, "vehicle_id")
    line, point = features_of(tmp_path / "t.geojson")
    assert line["properties"] == {"vehicle_id": 0, "time_s": [0.0, 0.5]}
    assert line["geometry"]["type"] == "LineString" and point["geometry"]["type"] == "Point"
    # easting 500 km is the zone's middle, 9° east; ten metres there are 1.4e-4 degrees of longitude at 49.6°
    longitudes = [c[0] for c in line["geometry"]["coordinates"]]
    assert longitudes[1] == pytest.approx(9.0, abs=1e-6)
    assert longitudes[1] - longitudes[0] == pytest.approx(1.4e-4, rel=0.02)


def test_a_run_and_the_tracker_alone_write_the_same_lines(tmp_path, rows):
    write_geojson(tmp_path / "run.geojson", rows, "EPSG:32632", ORIGIN_M)
    write_tracks(tmp_path, rows, "alone", "EPSG:32632", ORIGIN_M)
    assert features_of(tmp_path / "run.geojson") == features_of(tmp_path / "alone.geojson")


def test_without_a_crs_metres_stay_metres(tmp_path, rows):
    write_geojson(tmp_path / "t.geojson", rows, None, ORIGIN_M)
    assert features_of(tmp_path / "t.geojson")[0]["geometry"]["coordinates"][0] == [499_990.0, 5_500_020.0]
    assert "no CRS" in (tmp_path / "t.geojson").read_text()


def test_nobody_is_an_empty_collection(tmp_path):
    write_geojson(tmp_path / "t.geojson", xr.Dataset(), "EPSG:32632", ORIGIN_M)
    assert features_of(tmp_path / "t.geojson") == []


def test_an_unknown_crs_is_said(tmp_path, rows):
    with pytest.raises(ValueError, match="`crs` must be a coordinate reference system"):
        write_geojson(tmp_path / "t.geojson", rows, "EPSG:nothing", ORIGIN_M)
