"""The orbit of Table 1: altitude, off-nadir angle, azimuth from the sun."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from glintrack.camera import Camera, project, rays, rotation
from glintrack.flight import Flight, FlightDesign, check_recorded

CAMERA = Camera(0.068, 17e-6, 560, 880)
HUNDREDTH_PIXEL = 0.01
MILLIMETRE = 1e-3
DESIGNS = st.builds(
    FlightDesign,
    altitude_m=st.floats(200, 20000),
    off_nadir_deg=st.floats(1, 70),
    azimuth_from_sun_deg=st.floats(-360, 360),
    speed_m_s=st.floats(0, 400),
    direction=st.sampled_from(["clockwise", "counterclockwise"]),
    stare_east_m=st.floats(-500, 500),
    stare_north_m=st.floats(-500, 500),
    start_s=st.floats(0, 100),
)
SUN_AZIMUTHS = st.floats(0, 2 * math.pi)
TIMES = st.floats(0, 300)


def stare(design):
    return np.array([design.stare_east_m, design.stare_north_m, 0.0])


def azimuth_of(direction):
    return math.atan2(direction[0], direction[1])


@given(DESIGNS, SUN_AZIMUTHS, TIMES)
def test_orbit_keeps_altitude_and_off_nadir_angle(design, sun, after_s):
    pose = Flight(design, sun).pose(design.start_s + after_s)
    away = pose.position - stare(design)
    assert pose.up_m == design.altitude_m
    off_nadir = math.atan2(math.hypot(away[0], away[1]), away[2])
    assert off_nadir == pytest.approx(math.radians(design.off_nadir_deg), abs=1e-9)
    assert pose.kind == "true"


@given(DESIGNS, SUN_AZIMUTHS, TIMES)
def test_stare_point_stays_on_the_principal_point(design, sun, after_s):
    pose = Flight(design, sun).pose(design.start_s + after_s)
    np.testing.assert_allclose(
        project(CAMERA, pose, stare(design)), CAMERA.principal_point, atol=HUNDREDTH_PIXEL
    )


@given(DESIGNS, SUN_AZIMUTHS)
def test_line_of_sight_starts_at_its_azimuth_from_the_sun(design, sun):
    pose = Flight(design, sun).pose(design.start_s)
    look = rays(CAMERA, pose, CAMERA.principal_point)
    wanted = sun + math.radians(design.azimuth_from_sun_deg)
    assert math.remainder(azimuth_of(look) - wanted, 2 * math.pi) == pytest.approx(0, abs=1e-9)


@given(DESIGNS, SUN_AZIMUTHS, TIMES)
def test_aircraft_flies_where_its_nose_points_at_its_speed(design, sun, after_s):
    flight, t, step = Flight(design, sun), design.start_s + after_s, 1e-5
    velocity = (flight.pose(t + step).position - flight.pose(t - step).position) / (2 * step)
    pose = flight.pose(t)
    nose = [math.sin(pose.heading_rad), math.cos(pose.heading_rad), 0.0]
    np.testing.assert_allclose(velocity, design.speed_m_s * np.array(nose), atol=MILLIMETRE)


@pytest.mark.parametrize(("direction", "sign"), [("clockwise", 1), ("counterclockwise", -1)])
def test_sense_is_as_seen_from_above(direction, sign):
    """Station azimuths (clockwise from north) rise on a clockwise orbit; its right side faces the centre."""
    design = FlightDesign(direction=direction)
    flight = Flight(design, 1.0)
    viewpoints = [azimuth_of(flight.pose(t).position) for t in (0.0, 1.0)]
    assert sign * math.remainder(viewpoints[1] - viewpoints[0], 2 * math.pi) > 0
    assert flight.pose(0.0).gimbal_azimuth_rad == pytest.approx(sign * math.pi / 2)


def test_looking_toward_the_sun_stands_on_the_far_side_of_it():
    pose = Flight(FlightDesign(azimuth_from_sun_deg=0), math.pi).pose(0.0)  # sun in the south
    assert pose.north_m > 0 and abs(pose.east_m) < MILLIMETRE


def test_one_turn_closes():
    design = FlightDesign(altitude_m=2000, off_nadir_deg=45, speed_m_s=100)
    flight = Flight(design, 0.3)
    turn_s = 2 * math.pi * 2000 / 100
    np.testing.assert_allclose(flight.pose(turn_s).position, flight.pose(0.0).position, atol=MILLIMETRE)
    opposite = -flight.pose(0.0).position[:2]
    np.testing.assert_allclose(flight.pose(turn_s / 2).position[:2], opposite, atol=MILLIMETRE)


def test_table_1s_altitudes_keep_a_slant_range_of_3000_m():
    for altitude, off_nadir in ((3000, 0), (2819, 20), (1928, 50)):
        pose = Flight(FlightDesign(altitude_m=altitude, off_nadir_deg=off_nadir), 0.0).pose(0.0)
        assert np.linalg.norm(pose.position) == pytest.approx(3000, abs=1)  # the table rounds to metres


def test_nadir_stare_looks_straight_down_with_north_up():
    design = FlightDesign(off_nadir_deg=0, stare_east_m=30, stare_north_m=-20, altitude_m=3000)
    for t in (0.0, 60.0):
        pose = Flight(design, 2.0).pose(t)
        np.testing.assert_array_equal(pose.position, [30, -20, 3000])
        np.testing.assert_allclose(rotation(pose), np.eye(3), atol=1e-12)


def test_times_are_the_frames_and_poses_are_at_them():
    design = FlightDesign(start_s=5, frames=4, rate_hz=2)
    flight = Flight(design, 0.7)
    np.testing.assert_allclose(flight.times_s, [5, 5.5, 6, 6.5])


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("altitude_m", 100),
        ("off_nadir_deg", 71),
        ("rate_hz", 0),
        ("frames", 0),
        ("direction", "left"),
        ("heading", 1),
    ],
)
def test_designs_refuse_what_cannot_be_flown(key, value):
    with pytest.raises(ValidationError, match=key):
        FlightDesign(**{key: value})


@pytest.mark.parametrize(("frames", "start_s"), [(242, 0.0), (22, 110.0), (1, 120.5)])
def test_a_flight_that_outlasts_its_traffic_is_refused_before_it_begins(frames, start_s):
    check_recorded(FlightDesign(frames=21, rate_hz=2.0, start_s=110.0), 120.0)
    with pytest.raises(ValueError, match=r"must (lie|end) within the recorded traffic.*traffic_duration_s"):
        check_recorded(FlightDesign(frames=frames, rate_hz=2.0, start_s=start_s), 120.0)
