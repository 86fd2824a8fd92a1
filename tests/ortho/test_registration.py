"""What a navigator's error costs, and that registration takes it out."""

from dataclasses import replace

import numpy as np

from glintrack.camera import Camera, Pose, look_at, rays
from glintrack.ortho import orthorectify, register
from tests.ortho.frames import frame_of, level, plain_stokes

CAMERA = Camera(0.068, 17e-6, 240, 320)
AREA_M = (-75.0, -60.0, 75.0, 60.0)
RNG = np.random.default_rng(3)
WAVES, PHASES = RNG.normal(0, 0.06, (200, 2)), RNG.uniform(0, 6.28, 200)


def town(east, north):
    phase = 2 * np.pi * (east[..., None] * WAVES[:, 0] + north[..., None] * WAVES[:, 1])
    return 100 + np.cos(phase + PHASES).sum(axis=-1)


def seen(pose):
    places = np.stack(np.mgrid[: CAMERA.rows : 2, : CAMERA.columns : 2], axis=-1) + 0.5
    direction = rays(CAMERA, pose, places)
    ground = pose.position - pose.up_m / direction[..., 2:] * direction
    pan = town(ground[..., 0], ground[..., 1])
    return frame_of(pan, plain_stokes(pan))


def image_of(true, reported):
    return orthorectify(seen(true), CAMERA, reported, level(), 1.5, AREA_M)


def test_registration_takes_out_a_navigators_error():
    first = look_at(Pose(-1000, -2000, 2000.0, kind="reported"), (0, 0, 0))
    second = look_at(Pose(-1100, -1950, 2000.0, kind="reported"), (0, 0, 0))
    reference = image_of(first, first)
    erring = replace(second, east_m=second.east_m + 4.0, north_m=second.north_m - 2.5)
    image = image_of(second, erring)
    cured = register(image, reference)
    # a camera reported too far east puts the ground too far east: columns by 4 m, rows by 2.5 m southward
    tenth_of_a_pixel = 0.1
    np.testing.assert_allclose(cured.attrs["registration_columns"], 4 / 1.5, atol=tenth_of_a_pixel)
    np.testing.assert_allclose(cured.attrs["registration_rows"], 2.5 / 1.5, atol=tenth_of_a_pixel)
    truth = town(*np.meshgrid(image["x"].values, image["y"].values))

    def error(one):
        inner = (slice(5, -5), slice(5, -5))
        return np.sqrt(np.nanmean((one["pan"].values - truth)[inner] ** 2))

    assert error(cured) < 0.35 * error(image)


def test_a_frame_in_its_place_is_left_alone():
    pose = look_at(Pose(-1000, -2000, 2000.0, kind="reported"), (0, 0, 0))
    image = image_of(pose, pose)
    same = register(image, image)
    np.testing.assert_array_equal(same["pan"], image["pan"])
    assert same.attrs["registration_rows"] == 0


def test_without_texture_nothing_is_moved():
    pose = Pose(0, 0, 3000.0, kind="reported")
    flat = np.full((120, 160), 5.0)
    image = orthorectify(frame_of(flat, plain_stokes(flat)), CAMERA, pose, level(), 1.5, AREA_M)
    kept = register(image, image)
    np.testing.assert_array_equal(kept["pan"], image["pan"])
