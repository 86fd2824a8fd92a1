"""Ground heights: rasters and hills, what stands on them, and vehicles that lie along the slope."""

import math

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from glintrack.core import schema
from glintrack.core.interpolation import height_at
from glintrack.scene import SceneDesign, build_scene
from glintrack.scene.objects.layout import body_to_enu
from glintrack.scene.objects.terrain import (
    flat_terrain,
    ground_surface,
    is_level,
    read_dem,
    rolling_terrain,
    slope_at,
)

BOUNDS = (-100.0, -60.0, 100.0, 60.0)
PLACE = ("EPSG:32618", (288000.0, 4781000.0))


def write_dem(path, height, crs="EPSG:32618", half_m=600.0, cell_m=20.0, **keys):
    """A raster of ``height(east, north)`` about the embedded city's place."""
    count = int(2 * half_m / cell_m)
    offset = (np.arange(count) + 0.5) * cell_m - half_m
    values = height(*np.meshgrid(offset, -offset)).astype(np.float32)
    easting, northing = PLACE[1]
    transform = from_origin(easting - half_m, northing + half_m, cell_m, cell_m)
    profile = {"driver": "GTiff", "width": count, "height": count, "count": 1, "dtype": "float32"}
    with rasterio.open(path, "w", crs=crs, transform=transform, **profile, **keys) as file:
        file.write(values, 1)
    return path


def tilted(east, north):
    return 150.0 + 0.05 * east - 0.02 * north


def test_a_tilted_raster_is_a_tilted_ground(tmp_path):
    terrain, centre = read_dem(write_dem(tmp_path / "d.tif", tilted), BOUNDS, *PLACE)
    schema.check(terrain, "terrain")
    assert centre == pytest.approx(150.0, abs=1e-3)
    east, north = np.array([-73.0, 12.5, 99.0]), np.array([41.0, -8.0, 60.0])
    np.testing.assert_allclose(height_at(terrain, east, north), 0.05 * east - 0.02 * north, atol=1e-3)
    np.testing.assert_allclose(slope_at(terrain, east, north)[0], [0.05, -0.02], atol=1e-4)


def test_a_raster_in_degrees_is_turned_into_the_scenes_frame(tmp_path):
    source = write_dem(tmp_path / "d.tif", tilted)
    with rasterio.open(source) as file:
        transform, width, height = rasterio.warp.calculate_default_transform(
            file.crs, "EPSG:4326", file.width, file.height, *file.bounds
        )
        values = np.full((height, width), np.nan, np.float32)
        rasterio.warp.reproject(
            file.read(1),
            values,
            src_transform=file.transform,
            src_crs=file.crs,
            dst_transform=transform,
            dst_crs="EPSG:4326",
            dst_nodata=np.nan,
            resampling=rasterio.warp.Resampling.bilinear,
        )
    profile = {"driver": "GTiff", "width": width, "height": height, "count": 1, "dtype": "float32"}
    with rasterio.open(
        tmp_path / "g.tif", "w", crs="EPSG:4326", transform=transform, nodata=np.nan, **profile
    ) as file:
        file.write(values, 1)
    terrain, _ = read_dem(tmp_path / "g.tif", BOUNDS, *PLACE)
    two_resamplings_m = 0.1
    np.testing.assert_allclose(
        height_at(terrain, np.array([80.0]), np.array([-40.0])), 0.05 * 80 + 0.02 * 40, atol=two_resamplings_m
    )


def test_bad_rasters_get_one_sentence(tmp_path):
    small = write_dem(tmp_path / "s.tif", tilted, half_m=60.0)
    with pytest.raises(ValueError, match=r"`dem_file` must cover the scene; got no height in .* %"):
        read_dem(small, BOUNDS, *PLACE)
    placeless = write_dem(tmp_path / "p.tif", tilted, crs=None)
    with pytest.raises(ValueError, match=r"`dem_file` must have a CRS; got none in p.tif"):
        read_dem(placeless, BOUNDS, *PLACE)
    holed = write_dem(tmp_path / "h.tif", lambda e, n: np.where(np.hypot(e, n) < 50, -9999, 0), nodata=-9999)
    with pytest.raises(ValueError, match="`dem_file` must cover the scene"):
        read_dem(holed, BOUNDS, *PLACE)
    (tmp_path / "t.tif").write_text("not a raster")
    with pytest.raises(ValueError, match=r"`dem_file` must be a raster \(GeoTIFF, .*\); got .*t\.tif"):
        read_dem(tmp_path / "t.tif", BOUNDS, *PLACE)


def test_rolling_ground_has_its_relief_and_its_seed():
    one, again, other = (rolling_terrain(BOUNDS, 9.0, np.random.default_rng(s)) for s in (1, 1, 2))
    height = one["height"].values
    assert np.ptp(height) == pytest.approx(9.0) and not is_level(one)
    assert height.tobytes() == again["height"].values.tobytes() != other["height"].values.tobytes()
    assert height_at(one, np.zeros(1), np.zeros(1))[0] == pytest.approx(0)
    assert is_level(flat_terrain(BOUNDS))


def test_the_surface_below_faces_up_and_reaches_far():
    vertices, faces = ground_surface(rolling_terrain(BOUNDS, 9.0, np.random.default_rng(1)), 0.1)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()
    assert np.abs(vertices[:, :2]).max() >= 3000


def test_a_vehicle_on_a_slope_lies_along_it():
    slope = np.array([[0.1, 0.0]])
    (uphill,) = body_to_enu(np.zeros((1, 3)), np.array([math.pi / 2]), slope)
    np.testing.assert_allclose(uphill[:, 0], np.array([1, 0, 0.1]) / math.hypot(1, 0.1), atol=1e-12)
    np.testing.assert_allclose(uphill[:, 1], [0, 1, 0], atol=1e-12)
    (across,) = body_to_enu(np.zeros((1, 3)), np.array([0.0]), slope)  # heading north: it leans to its left
    np.testing.assert_allclose(across[:, 0], [0, 1, 0], atol=1e-12)
    for transform in (uphill, across):
        np.testing.assert_allclose(transform[:, :3] @ transform[:, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(transform[:, :3]) == pytest.approx(1)
    (level,) = body_to_enu(np.zeros((1, 3)), np.array([0.7]), np.zeros((1, 2)))
    np.testing.assert_allclose(level, body_to_enu(np.zeros((1, 3)), np.array([0.7]))[0], atol=1e-12)


@pytest.fixture(scope="module")
def draped(tmp_path_factory):
    path = write_dem(tmp_path_factory.mktemp("dem") / "d.tif", tilted)
    return build_scene(SceneDesign(dem_file=str(path), trees=False))


@pytest.mark.slow
def test_a_city_over_a_raster_is_draped(draped):
    assert draped.origin_height_m == pytest.approx(150.0, abs=1e-3)
    vertices = draped.static.vertices.astype(float)
    ground = height_at(draped.terrain, vertices[:, 0], vertices[:, 1])
    names = list(draped.materials["material"].values)
    asphalt = np.unique(draped.static.faces[draped.static.material == names.index("asphalt")])
    near = np.abs(vertices[asphalt, :2]).max(axis=1) < 400
    np.testing.assert_allclose(vertices[asphalt, 2][near], ground[asphalt][near], atol=2e-3)
    middle = vertices[draped.static.faces[draped.static.material == names.index("asphalt")]].mean(axis=1)
    np.testing.assert_allclose(middle[:, 2], height_at(draped.terrain, middle[:, 0], middle[:, 1]), atol=0.01)


@pytest.mark.slow
def test_vehicles_of_a_draped_city_stand_on_it(draped):
    truth, snapshot = draped.truth(20.0), draped.at(20.0)
    east, north = truth["east_m"].values, truth["north_m"].values
    np.testing.assert_allclose(truth["up_m"], 0.05 * east - 0.02 * north, atol=2e-3)
    moving = snapshot.transforms[snapshot.fixed :]
    np.testing.assert_allclose(moving[:, 2, 3], truth["up_m"])
    heading = truth["heading_rad"].values
    expected = np.arctan(0.05 * np.sin(heading) - 0.02 * np.cos(heading))
    np.testing.assert_allclose(truth["pitch_rad"], expected, atol=1e-3)
    np.testing.assert_allclose(np.arcsin(moving[:, 2, 0]), expected, atol=1e-3)
