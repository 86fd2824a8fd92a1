"""Motion during the exposure: its path, its kernel, its blur."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from glintrack.camera import Camera, Pose
from glintrack.sensor import image_motion, smear
from glintrack.sensor.navigation import motion_kernel

CAMERA = Camera(0.068, 17e-6, 40, 60)


def flying_east(time_s, speed=100.0):
    return Pose(speed * time_s, 0.0, 3000.0)


def test_flight_over_ground_moves_the_image_by_its_share():
    """100 m/s for 60 ms over elements of 0.75 m: eight elements, to the left."""
    path = image_motion(CAMERA, flying_east, 5.0, 0.06)
    np.testing.assert_allclose(path[:, 0], 0, atol=1e-9)
    np.testing.assert_allclose(np.diff(path[:, 1]), -8.0 / 33, rtol=1e-6)
    np.testing.assert_allclose(path.mean(axis=0), 0, atol=1e-12)
    higher = image_motion(CAMERA, flying_east, 5.0, 0.06, ground_m=1000.0)
    np.testing.assert_allclose(np.ptp(higher[:, 1]), 1.5 * np.ptp(path[:, 1]), rtol=1e-6)


def test_a_camera_above_the_horizon_has_a_path_too():
    def turning(time_s):
        return Pose(0, 0, 100.0, heading_rad=time_s, gimbal_depression_rad=-0.1)

    assert np.isfinite(image_motion(CAMERA, turning, 0.0, 0.01)).all()


def test_the_kernel_is_a_box_for_steady_motion_and_keeps_the_first_moments():
    path = np.stack([np.zeros(1001), np.linspace(-3, 3, 1001)], axis=1)
    kernel = motion_kernel(path)
    assert kernel.sum() == pytest.approx(1) and kernel.shape[0] % 2 == 1
    middle = kernel.shape[0] // 2
    np.testing.assert_allclose(kernel[middle, middle - 2 : middle + 3], 1 / 6, rtol=0.01)
    np.testing.assert_allclose(np.delete(kernel, middle, axis=0), 0)
    random = np.random.default_rng(1).normal(0, 1.5, (200, 2)) + [0.3, -0.2]
    kernel = motion_kernel(random)
    place = np.arange(kernel.shape[0]) - kernel.shape[0] // 2
    centroid = [kernel.sum(axis=1) @ place, kernel.sum(axis=0) @ place]
    np.testing.assert_allclose(centroid, random.mean(axis=0), atol=1e-12)


def point_of_light(channels, pixels=None):
    values = np.zeros((40, 60, 1, 3))
    values[20, 30, 0] = 6.0, 3.0, 1.5
    if pixels is not None:
        return xr.DataArray(values[pixels[:, 0], pixels[:, 1]])
    return xr.DataArray(values, dims=("y", "x", "channel", "stokes"))


def test_a_point_becomes_its_own_path():
    path = np.array([[0.0, 2.0], [-3.0, 0.0], [0.0, -1.0]])
    light = smear(point_of_light, path)(None).values[:, :, 0]
    for row, column in path.astype(int):
        np.testing.assert_allclose(light[20 + row, 30 + column], [2.0, 1.0, 0.5])
    np.testing.assert_allclose(light.sum(axis=(0, 1)), [6.0, 3.0, 1.5])


def test_little_motion_changes_nothing_and_pixels_are_left():
    assert smear(point_of_light, np.full((5, 2), 0.01) * [[1], [-1], [0], [1], [-1]]) is point_of_light
    moved = smear(point_of_light, np.array([[0.0, 2.0], [0.0, -2.0]]))
    np.testing.assert_allclose(moved(None, pixels=np.array([[20, 30]])).values[0, 0], [6.0, 3.0, 1.5])


def test_a_still_camera_has_no_path():
    path = image_motion(CAMERA, lambda t: replace(flying_east(0.0), up_m=2000.0), 1.0, 0.1)
    np.testing.assert_allclose(path, 0, atol=1e-9)


def test_a_long_path_is_a_box_and_not_separate_images():
    path = image_motion(CAMERA, flying_east, 5.0, 0.6)  # eighty elements
    line = motion_kernel(path).sum(axis=0)
    inside = line[8:-8]
    np.testing.assert_allclose(inside, inside.mean(), rtol=0.15)
