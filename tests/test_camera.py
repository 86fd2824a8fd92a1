"""Collinearity there and back, and the direction of every rotation (docs/conventions.md)."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from glintrack.camera import Camera, Pose, ground_points, look_at, project, rays, rotation

HUNDREDTH_PIXEL = 0.01  # issue 2's bound; float64 leaves far less
MILLIMETRE = 1e-3
CAMERA = Camera(0.068, 17e-6, 560, 880)
ANGLES = st.floats(-math.pi, math.pi)
SMALL_ANGLES = st.floats(-0.3, 0.3)


@st.composite
def staring_poses(draw):
    """Aircraft at any attitude and altitude, gimbal on the origin, up to 70° from nadir."""
    up = draw(st.floats(200, 20000))
    across = up * math.tan(draw(st.floats(0, math.radians(70))))
    azimuth = draw(ANGLES)
    pose = Pose(
        across * math.sin(azimuth),
        across * math.cos(azimuth),
        up,
        heading_rad=draw(ANGLES),
        roll_rad=draw(SMALL_ANGLES),
        pitch_rad=draw(SMALL_ANGLES),
    )
    return look_at(pose, (0.0, 0.0, 0.0))


# --- there and back --------------------------------------------------------------------------------


@given(staring_poses(), st.floats(-50, 50))
def test_collinearity_round_trip(pose, height_m):
    pixels = np.stack(np.meshgrid([0, 139.5, 559], [0.0, 333.3, 879], indexing="ij"), -1)
    ground = ground_points(CAMERA, pose, pixels, height_m)
    seen = np.isfinite(ground[..., 0])
    assert seen.any()  # at 70° the top of the frame may look over the horizon
    np.testing.assert_allclose(ground[seen][:, 2], height_m, atol=MILLIMETRE)
    np.testing.assert_allclose(project(CAMERA, pose, ground)[seen], pixels[seen], atol=HUNDREDTH_PIXEL)


@given(staring_poses())
def test_points_along_a_ray_fall_on_its_pixel(pose):
    pixels = np.array([[10.0, 20.0], [279.5, 439.5], [555.0, 800.25]])
    for distance_m in (1.0, 3000.0, 60000.0):
        points = pose.position + distance_m * rays(CAMERA, pose, pixels)
        np.testing.assert_allclose(project(CAMERA, pose, points), pixels, atol=HUNDREDTH_PIXEL)


def test_rays_are_unit_vectors_of_every_element_by_default():
    camera, pose = Camera(0.05, 1e-5, 4, 6), Pose(1.0, 2.0, 300.0, heading_rad=0.3)
    every = rays(camera, pose)
    assert every.shape == (4, 6, 3)
    np.testing.assert_allclose(np.linalg.norm(every, axis=-1), 1, atol=1e-14)
    np.testing.assert_allclose(every[3, 5], rays(camera, pose, (3, 5)), atol=1e-15)


def test_scale_of_the_standard_frame():
    """17 µm behind 68 mm is 0.75 m at 3000 m (the paper's standard frame)."""
    a, b = project(CAMERA, Pose(0.0, 0.0, 3000.0), [[0, 0, 0], [0.75, 0, 0]])
    np.testing.assert_allclose(b - a, [0, 1], atol=1e-9)


def test_an_off_centre_principal_point_shifts_the_image():
    moved = Camera(0.068, 17e-6, 560, 880, principal_row=100.0, principal_column=0.0)
    assert moved.principal_point == (100.0, 0.0)
    assert CAMERA.principal_point == (279.5, 439.5)
    pose = Pose(5.0, -7.0, 1000.0)
    np.testing.assert_allclose(project(moved, pose, (5, -7, 0)), [100, 0], atol=1e-9)
    np.testing.assert_allclose(ground_points(moved, pose, (100, 0)), [5, -7, 0], atol=1e-9)


def test_points_behind_the_lens_have_no_image():
    pose = look_at(Pose(0.0, 0.0, 1000.0), (3000.0, 0.0, 0.0))
    got = project(CAMERA, pose, [[3000, 0, 0], [-9000, 0, 4000], [0, 0, 1000]])
    assert np.isfinite(got[0]).all() and np.isnan(got[1:]).all()


def test_rays_that_never_come_down_have_no_ground_point():
    level = Pose(0.0, 0.0, 100.0, gimbal_depression_rad=0.0)
    ground = ground_points(CAMERA, level, [[0, 439.5], [200, 439.5], [559, 439.5]])
    assert np.isnan(ground[:2]).all() and np.isfinite(ground[2]).all()


# --- directions ------------------------------------------------------------------------------------


def moved(pose, enu):
    """(rows, columns) from the principal point at which a ground point falls."""
    return project(CAMERA, pose, enu) - np.array(CAMERA.principal_point)


def boresight(pose):
    return rays(CAMERA, pose, CAMERA.principal_point)


def test_zero_pose_looks_down_with_north_up_and_east_right():
    pose = Pose(0.0, 0.0, 1000.0)
    np.testing.assert_array_equal(rotation(pose), np.eye(3))
    np.testing.assert_allclose(boresight(pose), [0, 0, -1], atol=1e-15)
    row, column = moved(pose, (10, 0, 0))
    assert column > 0 and row == pytest.approx(0)
    row, column = moved(pose, (0, 10, 0))
    assert row < 0 and column == pytest.approx(0)


def test_a_car_driving_east_moves_right():
    columns = project(CAMERA, Pose(0.0, 0.0, 1000.0), [[x, 3.0, 0.5] for x in range(5)])[:, 1]
    assert np.all(np.diff(columns) > 0)


def test_right_wing_down_looks_left():
    east, north, up = boresight(Pose(0.0, 0.0, 1000.0, roll_rad=0.1))
    assert east == pytest.approx(-math.sin(0.1)) and north == pytest.approx(0, abs=1e-15) and up < 0


def test_nose_up_looks_ahead():
    east, north, up = boresight(Pose(0.0, 0.0, 1000.0, pitch_rad=0.1))
    assert north == pytest.approx(math.sin(0.1)) and east == pytest.approx(0, abs=1e-15) and up < 0


def test_heading_east_puts_east_at_the_top():
    row, column = moved(Pose(0.0, 0.0, 1000.0, heading_rad=math.pi / 2), (10, 0, 0))
    assert row < 0 and column == pytest.approx(0, abs=1e-9)


def test_roll_and_pitch_are_the_airframes_own():
    """Heading east, right wing down looks left of the nose, which is north; nose up looks east."""
    east = {"heading_rad": math.pi / 2}
    assert boresight(Pose(0.0, 0.0, 1000.0, roll_rad=0.1, **east))[1] == pytest.approx(math.sin(0.1))
    assert boresight(Pose(0.0, 0.0, 1000.0, pitch_rad=0.1, **east))[0] == pytest.approx(math.sin(0.1))


def test_order_is_heading_then_roll_then_pitch():
    """Eq. (6): pitch turns about the wing as roll has left it, so the nose rises toward its tilted up."""
    roll, pitch = 0.3, 0.2
    nose = rotation(Pose(0.0, 0.0, 1.0, roll_rad=roll, pitch_rad=pitch))[1]
    up_after_roll = np.array([math.sin(roll), 0, math.cos(roll)])
    np.testing.assert_allclose(nose, math.cos(pitch) * np.array([0, 1, 0]) + math.sin(pitch) * up_after_roll)


def test_gimbal_azimuth_is_clockwise_from_the_nose():
    pose = Pose(
        0.0, 0.0, 1000.0, heading_rad=0.4, gimbal_azimuth_rad=math.pi / 2, gimbal_depression_rad=math.pi / 4
    )
    azimuth = 0.4 + math.pi / 2
    half = math.sqrt(0.5)
    np.testing.assert_allclose(
        boresight(pose), [half * math.sin(azimuth), half * math.cos(azimuth), -half], atol=1e-12
    )


def test_image_up_is_away_from_the_aircraft_in_an_oblique():
    pose = look_at(Pose(0.0, -3000.0, 2000.0), (0.0, 0.0, 0.0))
    row, column = moved(pose, (0, 100, 0))
    assert row < 0 and column == pytest.approx(0, abs=1e-9)
    assert moved(pose, (100, 0, 0))[1] > 0
    assert moved(pose, (0, 0, 10))[0] < 0  # what is tall leans away from the lens


@given(staring_poses(), st.floats(-2000, 2000), st.floats(-2000, 2000))
def test_look_at_puts_the_target_on_the_optical_axis(pose, east_m, north_m):
    target = (east_m, north_m, 0.0)
    aimed = look_at(pose, target)
    np.testing.assert_allclose(moved(aimed, target), 0, atol=HUNDREDTH_PIXEL)
    kept = ("east_m", "north_m", "up_m", "heading_rad", "roll_rad", "pitch_rad", "kind")
    assert all(getattr(aimed, name) == getattr(pose, name) for name in kept)


def test_look_at_straight_down_keeps_the_heading_up():
    aimed = look_at(Pose(0.0, 0.0, 500.0, heading_rad=0.7, kind="reported"), (0.0, 0.0, 0.0))
    assert aimed.kind == "reported"
    np.testing.assert_allclose(rotation(aimed), rotation(Pose(0.0, 0.0, 0.0, heading_rad=0.7)), atol=1e-12)


@given(ANGLES, ANGLES, ANGLES, ANGLES, ANGLES)
def test_rotations_are_orthonormal_and_right_handed(heading, roll, pitch, azimuth, depression):
    m = rotation(Pose(0.0, 0.0, 1.0, heading, roll, pitch, azimuth, depression))
    np.testing.assert_allclose(m @ m.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(m) == pytest.approx(1)


# --- refusals --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["focal_length_m", "pitch_m", "rows", "columns"])
@pytest.mark.parametrize("value", [0, -1, math.inf, math.nan])
def test_camera_refuses_what_is_not_positive(name, value):
    design = {"focal_length_m": 0.07, "pitch_m": 1e-5, "rows": 4, "columns": 6, name: value}
    with pytest.raises(ValueError, match=f"`{name}` must be positive; got {value}"):
        Camera(**design)


def test_pose_refuses_what_is_not_a_number():
    with pytest.raises(ValueError, match=r"`pose\.roll_rad` must be finite; got nan"):
        Pose(0.0, 0.0, 1.0, roll_rad=math.nan)


def test_pose_is_true_or_reported():
    assert Pose(0.0, 0.0, 1.0).kind == "true"
    with pytest.raises(ValueError, match=r"`pose\.kind` must be 'true' or 'reported'; got 'guessed'"):
        Pose(0.0, 0.0, 1.0, kind="guessed")


def test_look_at_refuses_the_lens_itself():
    with pytest.raises(ValueError, match="`target_enu` must differ from the lens centre"):
        look_at(Pose(1.0, 2.0, 3.0), (1.0, 2.0, 3.0))
