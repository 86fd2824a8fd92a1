"""Bumper, heading and interpolation against cases worked by hand."""

import math

import numpy as np
import pytest

from glintrack.scene.traffic import Traffic, warn_of_jam
from glintrack.scene.vehicles import VEHICLE_CLASSES, load_vehicles

CAR, HATCH = list(VEHICLE_CLASSES).index("car"), list(VEHICLE_CLASSES).index("hatch")


def driving(x, y, angle_deg, model=HATCH, step_s=0.1, first=0, steps=None):
    n = len(x)
    return Traffic(
        step_s=step_s,
        steps=steps or first + n,
        first=np.array([first]),
        count=np.array([n]),
        model=np.array([model]),
        bumper_east=np.asarray(x, float),
        bumper_north=np.asarray(y, float),
        angle=np.radians(np.asarray(angle_deg, float)),
    )


@pytest.mark.parametrize(
    ("angle_deg", "centre"),
    [(90, (8, 5)), (0, (10, 3)), (180, (10, 7)), (270, (12, 5))],
    ids=["E", "N", "S", "W"],
)
def test_centre_lies_half_a_length_behind_the_front_bumper(angle_deg, centre):
    _, states = driving([10.0], [5.0], [angle_deg]).at(0.0)
    np.testing.assert_allclose(states[0, :2], centre, atol=1e-12)


def test_hatchback_driving_east_is_where_its_bumper_says():
    traffic = driving(10 + np.arange(30) * 1.0, np.full(30, 5.0), np.full(30, 90.0))
    ids, states = traffic.at(0.0)
    assert ids.tolist() == [0] and load_vehicles()["hatch"].length_m == 4.0
    np.testing.assert_allclose(states[0], [8, 5, math.pi / 2, 10, 0], atol=1e-9)


def test_positions_between_samples_are_linear_and_speed_is_kept():
    traffic = driving(
        np.arange(30) * 1.5, np.arange(30) * -2.0, np.full(30, math.degrees(math.atan2(1.5, -2.0)))
    )
    for time_s in (0.73, 1.0, 2.345):
        _, states = traffic.at(time_s)
        heading = math.atan2(1.5, -2.0)
        expected = np.array([15 * time_s - 2 * math.sin(heading), -20 * time_s - 2 * math.cos(heading)])
        np.testing.assert_allclose(states[0, :2], expected, atol=1e-9)
        np.testing.assert_allclose(states[0, 3:], [15, -20], atol=1e-9)


def test_heading_through_north_does_not_swing_round():
    angle = np.concatenate([np.full(20, 358.0), np.full(20, 2.0)])
    traffic = driving(np.zeros(40), np.arange(40.0), angle)
    for time_s in np.linspace(0, 3.9, 79):
        _, states = traffic.at(float(time_s))
        off_north = (states[0, 2] + math.pi) % (2 * math.pi) - math.pi
        assert abs(off_north) <= math.radians(2) + 1e-9
        assert 0 <= states[0, 2] < 2 * math.pi


def test_heading_steps_are_smoothed():
    angle = np.concatenate([np.full(20, 80.0), np.full(20, 100.0)])
    traffic = driving(np.arange(40.0), np.zeros(40), angle)
    headings = np.array([traffic.at(0.1 * k)[1][0, 2] for k in range(40)])
    assert np.abs(np.diff(headings)).max() < math.radians(8)  # a step of 20° spread over 0.6 s
    assert headings[0] == pytest.approx(math.radians(80)) and headings[-1] == pytest.approx(math.radians(100))


def test_vehicle_is_there_only_from_its_first_to_its_last_sample():
    traffic = driving(np.arange(10.0), np.zeros(10), np.full(10, 90.0), first=5, steps=40)
    assert traffic.at(0.4)[0].size == 0 and traffic.at(0.5)[0].size == 1
    assert traffic.at(1.4)[0].size == 1 and traffic.at(1.5)[0].size == 0
    with pytest.raises(ValueError, match=r"`time_s` must lie within the recorded traffic, 0 to 3.9 s; got 4"):
        traffic.at(4.0)


def test_traffic_that_is_not_a_number_is_refused():
    with pytest.raises(ValueError, match="`bumper_east` must be finite"):
        driving([0, np.nan], [0, 0], [0, 0])


def many(moving, standing):
    """Vehicles on parallel lanes of the window; those that move do so at 10 m/s, eastward."""
    count, steps = moving + standing, 20
    lane = np.repeat(np.arange(count) * 5.0, steps)
    along = np.tile(np.arange(steps) * 1.0, count) * np.repeat(np.arange(count) < moving, steps)
    return Traffic(
        step_s=0.1, steps=steps, first=np.zeros(count, int), count=np.full(count, steps),
        model=np.full(count, CAR), bumper_east=along, bumper_north=lane,
        angle=np.full(count * steps, math.pi / 2),
    )  # fmt: skip


def test_a_jam_is_told():
    with pytest.warns(UserWarning, match=r"of 30 vehicles in the window 3 move .*traffic_insertion_period_s"):
        warn_of_jam(many(3, 27), (-50, -50, 500, 500))


@pytest.mark.parametrize(
    ("moving", "standing", "east_m"),
    [(9, 21, 500.0), (1, 12, 500.0), (3, 27, -40.0)],
    ids=["a third moves", "few vehicles", "the jam is outside"],
)
def test_what_is_no_jam_is_not(recwarn, moving, standing, east_m):
    warn_of_jam(many(moving, standing), (-50, -50, east_m, 500))
    assert not recwarn.list
