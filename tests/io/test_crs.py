"""Longitude and latitude of places on the map, and the maps that are refused."""

import math

import numpy as np
import pyproj
import pytest
import rasterio
import rasterio.transform

from glintrack.io.crs import change_crs, check_not_exchanged, longitude_latitude, metric_crs
from glintrack.io.heights import read_heights


def test_a_zones_middle_meridian():
    """On a transverse Mercator's middle meridian 0.9996 of the meridian's length is the northing."""
    longitude, latitude = longitude_latitude("EPSG:32632", np.full(2, 5e5), np.array([0.0, 5e6]))
    np.testing.assert_allclose(longitude, 9.0, atol=1e-9)
    length_m = pyproj.Geod(ellps="WGS84").inv(9, 0, 9, latitude[1])[2]
    assert 0.9996 * length_m == pytest.approx(5e6, abs=1e-3)


@pytest.mark.parametrize(
    ("crs", "east_m", "north_m", "sentence"),
    [
        ("EPSG:32618", 3e7, 4.78e6, "which is nowhere in WGS 84 / UTM zone 18N"),
        ("EPSG:32618", np.nan, 4.78e6, "which is nowhere"),
        ("EPSG:3857", -8.6e6, 5.3e6, r"must count metres of the ground where .*got 0.73. m of ground"),
        ("EPSG:31467", 3e5, 4.78e6, "must count metres of the ground"),  # its zone's eastings begin with 3
        (
            "EPSG:32632",
            5792310.0,
            604120.0,
            r"Are east and north exchanged\?.* lie at 10.5.*\.$",
        ),
        ("EPSG:4326", -77.0, 43.0, "must be projected and in metres"),
    ],
)
def test_a_map_on_which_lengths_are_others_is_refused(crs, east_m, north_m, sentence):
    with pytest.raises(ValueError, match=f"`crs` .*{sentence}"):
        longitude_latitude(crs, np.array([east_m]), np.array([north_m]))


LOCAL = 'LOCAL_CS["x",UNIT["metre",1]]'


def test_a_map_that_no_other_can_be_changed_into_is_refused():
    with pytest.raises(ValueError, match="`crs` must be one that PROJ can change into another"):
        change_crs("EPSG:32618", LOCAL)


@pytest.mark.parametrize(
    ("crs", "west", "sentence"),
    [(LOCAL, 0.0, "`crs` must be one that PROJ"), ("EPSG:32618", math.nan, "`--dem` must")],
)
def test_heights_that_lie_nowhere_are_refused(tmp_path, crs, west, sentence):
    about = {"height": 9, "width": 9, "count": 1, "dtype": "float32", "crs": crs}
    corner = rasterio.transform.from_origin(west, 90.0, 10.0, 10.0)
    with rasterio.open(tmp_path / "dem.tif", "w", driver="GTiff", transform=corner, **about) as file:
        file.write(np.full((9, 9), 20.0, np.float32), 1)
    with pytest.raises(ValueError, match=sentence):
        read_heights(tmp_path / "dem.tif", "--dem", np.array([20.0]), np.array([40.0]), "EPSG:32618")


@pytest.mark.parametrize("crs", ["EPSG:32618", "+proj=utm +zone=18", "EPSG:5070", "EPSG:3035"])
def test_maps_of_zones_and_continents_are_taken(crs):
    there = (10.0, 50.0) if crs == "EPSG:3035" else (-77.0, 43.0)
    east_m, north_m = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(*there)
    longitude, latitude = longitude_latitude(crs, np.array([east_m]), np.array([north_m]))
    np.testing.assert_allclose((longitude[0], latitude[0]), there, atol=1e-7)


def test_an_exchanged_longitude_and_latitude_are_refused():
    check_not_exchanged("EPSG:32632", 10.5, 52.3, "pose")
    check_not_exchanged("EPSG:32632", 100.0, -50.0, "pose")  # off the map either way
    with pytest.raises(ValueError, match=r"`pose` must lie where .* is made for; got longitude 52\.3000°"):
        check_not_exchanged("EPSG:32632", 52.3, 10.5, "pose")


@pytest.mark.parametrize("crs", ["EPSG:2053", "EPSG:5513"])
def test_grids_that_count_westward_or_southward_are_refused(crs):
    """South Africa's Lo and Krovak: PROJ exchanges their axes and does not turn them round."""
    with pytest.raises(ValueError, match=r"`crs` must count eastward and northward; got axes"):
        metric_crs(crs)
