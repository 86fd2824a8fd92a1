"""Omega, phi, kappa against the textbook's matrix and against a real flight; poses from rotations."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from glintrack.camera import (
    Camera,
    Pose,
    from_omega_phi_kappa,
    from_yaw_pitch_roll,
    look_at,
    omega_phi_kappa,
    project,
    rays,
    rotate_line_of_sight,
    rotation,
    with_rotation,
)

ANGLES = st.floats(-1.5, 1.5)
TURNS = st.floats(-3.1, 3.1)
CAMERA = Camera(0.05, 10e-6, 400, 600)


@given(TURNS, ANGLES, TURNS)
def test_omega_phi_kappa_is_wolf_and_dewitts_matrix(omega, phi, kappa):
    """The nine elements as printed in Wolf & Dewitt, Elements of Photogrammetry, Appendix C."""
    so, co, sp, cp = math.sin(omega), math.cos(omega), math.sin(phi), math.cos(phi)
    sk, ck = math.sin(kappa), math.cos(kappa)
    printed = [
        [cp * ck, so * sp * ck + co * sk, -co * sp * ck + so * sk],
        [-cp * sk, -so * sp * sk + co * ck, co * sp * sk + so * ck],
        [sp, -so * cp, co * cp],
    ]
    pose = from_omega_phi_kappa((1, 2, 3), omega, phi, kappa)
    np.testing.assert_allclose(rotation(pose), printed, atol=1e-12)
    back = from_omega_phi_kappa((1, 2, 3), *omega_phi_kappa(pose))
    np.testing.assert_allclose(rotation(back), printed, atol=1e-9)


@pytest.mark.parametrize(
    ("opk_rad", "drone_yaw_deg"),
    [
        ((0.503193657104389, 0.016411311937833076, 0.03110743606009455), -2.1),
        ((-0.04761483254802487, -0.5250477895525618, -1.6358769347634716), 92.9),
        ((-0.5248342515608455, 0.03283843527910987, 3.071501846568813), -175.8),
        ((-0.013925131655390291, 0.5072673424851597, 1.571333672851661), -90.3),
    ],
)
def test_a_real_drones_compass_agrees_with_its_bundle_adjustment(opk_rad, drone_yaw_deg):
    """Four photographs of a DJI FC6310R whose gimbal was set 30° ahead of straight down.

    Yaw as the drone itself recorded it, omega, phi, kappa (PATB) as OpenDroneMap solved them from the
    pictures; both published with the orthority project. The compass is good to a few degrees.
    """
    pose = from_omega_phi_kappa((0, 0, 100), *opk_rad)
    look = rays(Camera(1, 1, 1, 1), pose, (0, 0))
    compass_deg, gimbal_deg = 3.0, 3.0
    azimuth = math.degrees(math.atan2(look[0], look[1]))
    assert abs(math.remainder(azimuth - drone_yaw_deg, 360)) < compass_deg
    assert abs(math.remainder(math.degrees(pose.heading_rad) - drone_yaw_deg, 360)) < compass_deg
    assert math.degrees(pose.pitch_rad) == pytest.approx(30, abs=gimbal_deg)
    assert math.degrees(pose.roll_rad) == pytest.approx(0, abs=gimbal_deg)


@given(TURNS, ANGLES, TURNS, TURNS, st.floats(0.1, 1.57))
def test_a_pose_from_its_rotation_is_that_pose(heading, roll, pitch, azimuth, depression):
    pose = Pose(1, 2, 3, heading, roll, pitch, azimuth, depression)
    again = with_rotation(Pose(1, 2, 3, 0, 0, 0, azimuth, depression), rotation(pose))
    np.testing.assert_allclose(rotation(again), rotation(pose), atol=1e-9)


def test_what_is_no_rotation_is_refused():
    for matrix in (2 * np.eye(3), np.diag([1.0, 1.0, -1.0])):
        with pytest.raises(ValueError, match="must be a rotation"):
            with_rotation(Pose(0, 0, 1), matrix)


@pytest.mark.parametrize("place", [(0, 0, 1000), (700, -300, 900)])
def test_a_nudge_moves_the_line_of_sight_the_right_way(place):
    pose = look_at(Pose(*place, heading_rad=0.4), (0, 0, 0))
    for right, up in ((1e-3, 0.0), (0.0, 2e-3), (-5e-4, 1e-3)):
        row, column = project(
            CAMERA,
            rotate_line_of_sight(pose, right, up),
            pose.position + rays(CAMERA, pose, CAMERA.principal_point),
        )
        scale = CAMERA.focal_length_m / CAMERA.pitch_m
        # a line of sight turned right sees its old target to the left of the centre
        assert column - CAMERA.principal_point[1] == pytest.approx(-scale * right, abs=0.01)
        assert row - CAMERA.principal_point[0] == pytest.approx(scale * up, abs=0.01)


def test_angles_of_an_inertial_system_see_the_same_ground():
    """Yaw, pitch and roll multiplied as in aerospace textbooks, with axes north, east and down."""
    yaw, pitch, roll = np.radians([30.0, 10.0, 12.0])
    (cy, cp, cr), (sy, sp, sr) = np.cos([yaw, pitch, roll]), np.sin([yaw, pitch, roll])
    about_down = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_right = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_forward = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    camera, height_m = Camera(0.035, 35e-6, 801, 801), 1000.0
    pose = from_yaw_pitch_roll(Pose(0.0, 0.0, height_m, yaw, roll, pitch))
    for right, down in ((0, 0), (300, -300), (-300, -300), (300, 300)):
        body = np.array([-down / 1000, right / 1000, 1.0])  # the camera looks down, its rows run forward
        north, east, fall = about_down @ about_right @ about_forward @ body
        ground = np.array([east, north, 0.0]) * height_m / fall
        np.testing.assert_allclose(project(camera, pose, ground), [400 + down, 400 + right], atol=1e-6)
