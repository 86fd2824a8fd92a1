"""Straight lines, racetracks, fixed gimbals and jitter about the stare point."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from glintrack.camera import Camera, project, rays, rotation
from glintrack.flight import Flight, FlightDesign, build_flight

CAMERA = Camera(0.068, 17e-6, 560, 880)
HUNDREDTH_PIXEL = 0.01
MILLIMETRE = 1e-3
VIEWS = {
    "altitude_m": st.floats(500, 5000),
    "off_nadir_deg": st.floats(0, 70),
    "azimuth_from_sun_deg": st.floats(-360, 360),
    "speed_m_s": st.floats(10, 200),
    "direction": st.sampled_from(["clockwise", "counterclockwise"]),
    "stare_up_m": st.floats(-50, 500),
}
RACETRACKS = st.builds(
    FlightDesign,
    kind=st.just("racetrack"),
    leg_m=st.floats(500, 8000),
    turn_radius_m=st.floats(300, 3000),
    **VIEWS,
)
PATHS = RACETRACKS | st.builds(FlightDesign, kind=st.just("straight"), **VIEWS)
TIMES = st.floats(0, 400)
SUN = 2.3


def stare(design):
    return np.array([design.stare_east_m, design.stare_north_m, design.stare_up_m])


@given(PATHS, TIMES)
def test_the_stare_point_stays_on_the_axis_and_the_altitude_above_it(design, after_s):
    pose = Flight(design, SUN).pose(design.start_s + after_s)
    assert pose.up_m - design.stare_up_m == pytest.approx(design.altitude_m, abs=1e-9)
    np.testing.assert_allclose(
        project(CAMERA, pose, stare(design)), CAMERA.principal_point, atol=HUNDREDTH_PIXEL
    )


@given(PATHS, TIMES)
def test_the_nose_points_where_the_aircraft_flies_at_its_speed(design, after_s):
    flight, t, step = Flight(design, SUN), design.start_s + after_s, 1e-4
    velocity = (flight.pose(t + step).position - flight.pose(t - step).position) / (2 * step)
    heading = flight.pose(t).heading_rad
    nose = design.speed_m_s * np.array([math.sin(heading), math.cos(heading), 0.0])
    # a turn begins within the step at worst: half a step of its centripetal acceleration
    acceleration = design.speed_m_s**2 / design.turn_radius_m
    np.testing.assert_allclose(velocity, nose, atol=MILLIMETRE + acceleration * step)


@given(PATHS)
def test_the_viewpoint_is_passed_when_asked_with_its_off_nadir_angle_and_azimuth(design):
    pose = Flight(design, SUN).pose(design.start_s)
    away = pose.position - stare(design)
    assert math.atan2(math.hypot(*away[:2]), away[2]) == pytest.approx(
        math.radians(design.off_nadir_deg), abs=1e-9
    )
    if design.off_nadir_deg > 0.1:
        look = rays(CAMERA, pose, CAMERA.principal_point)
        wanted = SUN + math.radians(design.azimuth_from_sun_deg)
        assert math.remainder(math.atan2(look[0], look[1]) - wanted, 2 * math.pi) == pytest.approx(
            0, abs=1e-7
        )


def test_a_racetrack_closes_and_its_far_leg_lies_beyond_the_turns():
    design = FlightDesign(kind="racetrack", leg_m=3000, turn_radius_m=800, speed_m_s=100)
    flight = Flight(design, SUN)
    lap_s = (2 * 3000 + 2 * math.pi * 800) / 100
    np.testing.assert_allclose(flight.pose(lap_s).position, flight.pose(0).position, atol=MILLIMETRE)
    near, far = (np.hypot(*flight.pose(t).position[:2]) for t in (0, lap_s / 2))
    assert far - near == pytest.approx(2 * 800, abs=MILLIMETRE)
    turned = math.remainder(flight.pose(lap_s / 2).heading_rad - flight.pose(0).heading_rad, 2 * math.pi)
    assert abs(turned) == pytest.approx(math.pi, abs=1e-9)


@pytest.mark.parametrize(("direction", "sign"), [("clockwise", 1), ("counterclockwise", -1)])
def test_a_racetrack_turns_the_way_it_says(direction, sign):
    flight = Flight(FlightDesign(kind="racetrack", direction=direction, speed_m_s=100), SUN)
    in_turn_s = (2000 + 500) / 100
    headings = [flight.pose(in_turn_s + s).heading_rad for s in (0, 1)]
    assert sign * (headings[1] - headings[0]) == pytest.approx(100 / 1000)


def test_a_straight_flight_takes_its_course():
    design = FlightDesign(kind="straight", off_nadir_deg=0, course_deg=90, speed_m_s=50)
    flight = Flight(design, SUN)
    np.testing.assert_allclose(flight.pose(0).position, [0, 0, 1928], atol=MILLIMETRE)
    np.testing.assert_allclose(flight.pose(4).position, [200, 0, 1928], atol=MILLIMETRE)


def test_a_fixed_gimbal_moves_with_the_airframe():
    design = FlightDesign(
        kind="straight", course_deg=90, gimbal="fixed", gimbal_azimuth_deg=90, gimbal_depression_deg=40
    )
    pose = Flight(design, SUN).pose(3.0)
    look = rays(CAMERA, pose, CAMERA.principal_point)
    south_down = [0, -math.cos(math.radians(40)), -math.sin(math.radians(40))]
    np.testing.assert_allclose(look, south_down, atol=1e-12)


@pytest.mark.parametrize("off_nadir_deg", [0.0, 50.0])
def test_jitter_has_its_rms_about_the_stare_point_and_turns_no_image(off_nadir_deg):
    design = FlightDesign(off_nadir_deg=off_nadir_deg, jitter_rms_urad=200, speed_m_s=0)
    flight, still = Flight(design, SUN, seed=3), Flight(design.model_copy(update={"jitter_rms_urad": 0}), SUN)
    times = 0.0101 * np.arange(2_500)  # 25 s; tones that are aliased keep their variance
    pixels = np.array([project(CAMERA, flight.pose(t), stare(design)) for t in times])
    off = (pixels - CAMERA.principal_point) * CAMERA.pitch_m / CAMERA.focal_length_m
    # 24 tones over 25 s: cross terms leave under two hundredths
    np.testing.assert_allclose(off.std(axis=0), 200e-6, rtol=0.03)
    assert abs(off.mean(axis=0)).max() < 5e-6
    for t in (0.0, 0.3):
        difference = rotation(flight.pose(t)) - rotation(still.pose(t))
        assert np.abs(difference).max() < 5 * 200e-6  # no swing of the image about the line of sight


def test_jitter_is_one_function_of_time_for_one_seed():
    design = FlightDesign(jitter_rms_urad=50)
    one, same, other = (Flight(design, SUN, seed=s).pose(1.2) for s in (4, 4, 5))
    assert one == same and one != other


def test_jitter_band_is_kept():
    design = FlightDesign(jitter_rms_urad=100, speed_m_s=0)
    flight = build_flight(design, SUN, seed=1)
    times = np.arange(2048) / 256.0
    rows = np.array([project(CAMERA, flight.pose(t), stare(design))[0] for t in times])
    power = np.abs(np.fft.rfft((rows - rows.mean()) * np.hanning(2048))) ** 2
    hz = np.fft.rfftfreq(2048, 1 / 256)
    inside = (hz > 4) & (hz < 101)
    assert power[inside].sum() > 0.999 * power.sum()


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"kind": "zigzag"}, "kind"),
        ({"kind": "waypoints"}, "waypoint_file"),
        ({"waypoint_file": "a.csv"}, "waypoint_file"),
        ({"leg_m": 0}, "leg_m"),
    ],
)
def test_designs_refuse_what_cannot_be_flown(keys, message):
    with pytest.raises(ValidationError, match=message):
        FlightDesign(**keys)


def test_waypoints_must_have_been_read():
    with pytest.raises(ValueError, match="build_flight"):
        Flight(FlightDesign(kind="waypoints", waypoint_file="a.csv"), SUN)
