"""North, sun and scale of a picture against closed forms of the pinhole camera."""

import math

import numpy as np
import pytest
from matplotlib.figure import Figure

from glintrack.camera import Camera, Pose, look_at
from glintrack.results.figures.frame import azimuth_of, draw_bearings, in_view, on_map, round_length

HEIGHT_M = 1000.0


@pytest.fixture
def camera():
    return Camera(rows=101, columns=201, pitch_m=10e-6, focal_length_m=50e-3)


def unit(direction):
    return np.array(direction) / math.hypot(*direction)


def test_straight_down_with_the_nose_north_north_is_up(camera):
    pose = Pose(0.0, 0.0, HEIGHT_M, 0.0, 0.0, 0.0)
    found = in_view(camera, pose, math.radians(90))
    assert found is not None
    np.testing.assert_allclose(unit(found.north), [0, 1], atol=1e-9)
    np.testing.assert_allclose(unit(found.sun), [1, 0], atol=1e-9)  # in the east, on the right
    assert found.units_per_m == pytest.approx(50e-3 / 10e-6 / HEIGHT_M)


@pytest.mark.parametrize("azimuth_deg", [0.0, 75.0, 251.0])
def test_looking_toward_the_sun_it_stands_ahead(camera, azimuth_deg):
    """Up in the picture, and lengths across shrink with the slant range."""
    azimuth, off_nadir = math.radians(azimuth_deg), math.radians(50)
    reach_m = HEIGHT_M * math.tan(off_nadir)
    place = -reach_m * math.sin(azimuth), -reach_m * math.cos(azimuth)
    pose = look_at(Pose(*place, HEIGHT_M, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    found = in_view(camera, pose, azimuth)
    assert found is not None
    np.testing.assert_allclose(unit(found.sun), [0, 1], atol=1e-6)
    slant_m = HEIGHT_M / math.cos(off_nadir)
    assert found.units_per_m == pytest.approx(50e-3 / 10e-6 / slant_m, rel=1e-3)  # 20 m beside 1.5 km
    ahead = math.cos(azimuth) * found.north[1]  # north is ahead or behind as the sun is
    assert ahead >= 0


def test_a_view_of_the_sky_has_no_bearings(camera):
    pose = look_at(Pose(0.0, 0.0, HEIGHT_M, 0.0, 0.0, 0.0), (1000.0, 0.0, 2000.0))
    assert in_view(camera, pose, 0.0) is None


def test_on_a_map_the_arrow_points_to_the_sun():
    azimuth = azimuth_of(np.array([-0.6, 0.0, 0.8]))  # in the west
    np.testing.assert_allclose(on_map(azimuth).sun, [-1, 0], atol=1e-12)
    assert on_map(None).sun is None


@pytest.mark.parametrize(("most", "length"), [(132.0, 100.0), (99.0, 50.0), (2.0, 2.0), (0.3, 0.2)])
def test_a_round_length(most, length):
    assert round_length(most) == pytest.approx(length)


@pytest.mark.parametrize("down", [False, True])
def test_the_bar_is_as_long_as_it_says(down):
    """On a map in metres, and on a picture whose rows count down."""
    figure = Figure()
    ax = figure.add_subplot()
    ax.set(xlim=(0, 660), ylim=(420, 0) if down else (0, 420))
    draw_bearings(ax, on_map(1.0))
    x, y = (np.asarray(v) for v in ax.lines[0].get_data())
    assert x.max() - x.min() == pytest.approx(100.0)
    assert ax.get_xlim() == (0, 660) and (y > 210).all() == down  # at the foot of the picture
    assert {"N", "sun", "100 m"} <= {text.get_text() for text in ax.texts}
