"""A user's photograph rectified from Python: the same places as by collinearity, and files that come back."""

import numpy as np
import pytest
import rasterio
from rasterio.crs import CRS

from glintrack import rectify
from glintrack.camera import Camera, Pose, look_at, project
from glintrack.distortion import Distortion
from glintrack.io.photographs import PlacedPose, camera_file, pose_file, read_camera, read_pose
from glintrack.ortho import rectify_onto

CAMERA = Camera(0.068, 17e-6, 120, 160)
PLACED = PlacedPose(look_at(Pose(20.0, -150.0, 880.0), (0.0, 0.0, 80.0)), "EPSG:32632", (604000.0, 5792000.0))


@pytest.fixture
def photo(tmp_path):
    """A photograph of its own row and column numbers."""
    values = np.stack(np.indices((CAMERA.rows, CAMERA.columns)), axis=0).astype(np.float32)
    path = tmp_path / "photo.tif"
    with rasterio.open(path, "w", driver="GTiff", height=120, width=160, count=2, dtype="float32") as file:
        file.write(values)
    return path


def test_each_cell_shows_the_pixel_that_collinearity_names(photo):
    found = rectify(photo, CAMERA, PLACED, 80.0, gsd=2.0)
    east, north = found.grid.places(PLACED)
    places = np.stack([east, north, np.full(east.shape, 80.0)], axis=-1)
    pixels = project(CAMERA, PLACED.pose, places.reshape(-1, 3)).reshape(places.shape[:2] + (2,))
    inside = ((pixels > 0) & (pixels < [119, 159])).all(axis=-1)
    a_thousandth = 1e-3
    np.testing.assert_allclose(found.bands[inside], pixels[inside], atol=a_thousandth)
    beyond = ((pixels < -1) | (pixels > [120, 160])).any(axis=-1)
    assert inside.mean() > 0.5 and np.isnan(found.bands[beyond]).all()
    assert CRS.from_user_input(found.grid.crs).to_epsg() == 32632


def test_files_and_what_they_give_rectify_alike(photo, tmp_path):
    bent = Camera(0.068, 17e-6, 120, 160, 60.0, 79.5, Distortion(k1=0.1))
    (tmp_path / "camera.toml").write_text(camera_file(bent))
    (tmp_path / "pose.toml").write_text(pose_file(PLACED))
    from_files = rectify(photo, tmp_path / "camera.toml", tmp_path / "pose.toml", 80.0, gsd=2.0)
    direct = rectify(photo, bent, PLACED, 80.0, gsd=2.0)
    np.testing.assert_allclose(from_files.bands, direct.bands, atol=1e-3)
    from_files.write(tmp_path / "ortho.tif")
    with rasterio.open(tmp_path / "ortho.tif") as file:
        np.testing.assert_array_equal(np.moveaxis(file.read(), 0, -1), from_files.bands)
        assert file.tags()["frame"] == "photo.tif"


def test_camera_and_pose_files_come_back(tmp_path):
    bent = Camera(0.068, 17e-6, 120, 160, 60.0, 79.5, Distortion(k1=0.1))
    (tmp_path / "camera.toml").write_text(camera_file(bent))
    (tmp_path / "pose.toml").write_text(pose_file(PLACED))
    assert read_camera(tmp_path / "camera.toml") == bent
    placed = read_pose(tmp_path / "pose.toml", "photo.tif")
    shift = np.array([*placed.origin_m, 0.0]) - [*PLACED.origin_m, 0.0]
    np.testing.assert_allclose(placed.pose.position + shift, PLACED.pose.position, atol=1e-6)
    points = np.array([[0.0, 0.0, 80.0], [50.0, 30.0, 80.0]])
    np.testing.assert_allclose(
        project(bent, placed.pose, points - shift), project(bent, PLACED.pose, points), atol=1e-6
    )


def test_a_frame_above_the_horizon_is_refused(photo):
    up = PlacedPose(Pose(0.0, 0.0, 880.0, pitch_rad=1.57), PLACED.crs, PLACED.origin_m)
    with pytest.raises(ValueError, match="must look below the horizon"):
        rectify(photo, CAMERA, up, 80.0)
    with pytest.raises(ValueError, match=r"`pose.height_m` must be above the ground"):
        rectify(photo, CAMERA, PLACED, 900.0)


def test_the_nearest_pixel_is_the_kernels(photo):
    found = rectify(photo, CAMERA, PLACED, 80.0, gsd=2.0, method="nearest")
    east, north = found.grid.places(PLACED)
    with rasterio.open(photo) as file:
        values = np.moveaxis(file.read(), 0, -1)
    wanted = rectify_onto(values, CAMERA, PLACED.pose, east, north, np.full(east.shape, 80.0), "nearest")
    np.testing.assert_array_equal(found.bands, wanted)
