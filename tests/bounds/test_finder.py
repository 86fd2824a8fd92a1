"""Templates on made evidence: places, directions, neighbours that must not merge, and nothing in noise."""

import math

import numpy as np
import pytest

from glintrack.bounds.evidence import group_planes
from glintrack.bounds.finder import CELL_M, Plane, cell_places, evidence, find_vehicles, ground_cells
from glintrack.bounds.predictor import PredictedBackground
from glintrack.camera import Pose, ground_points
from glintrack.core.spectral import wavelength_grid
from glintrack.sensor import SensorDesign, build_sensor
from glintrack.track.detect.binning import binning_factor
from tests.conftest import small_camera

AREA = (-40.0, -40.0, 40.0, 40.0)
SUN = np.array([0.0, -0.5, math.sqrt(0.75)])
HALF_A_CELL = CELL_M / 2 + 0.2


def frame(cars, strength=100.0, seed=0):
    """Evidence of cars (east, north, direction) seen from straight above, elements of 0.5 m."""
    camera, pose = small_camera(200, 200, 100.0), Pose(0.0, 0.0, 1000.7)
    row, column = np.mgrid[:200, :200]
    place = ground_points(camera, pose, np.stack([row, column], axis=-1), 0.7)
    z2 = np.random.default_rng(seed).standard_normal((200, 200)) ** 2
    for east, north, direction in cars:
        x, y = place[..., 0] - east, place[..., 1] - north
        along = x * math.cos(direction) + y * math.sin(direction)
        across = -x * math.sin(direction) + y * math.cos(direction)
        z2[(np.abs(along) <= 2.3) & (np.abs(across) <= 1.0)] += strength
    x, y = ground_cells(AREA)
    plane = Plane(evidence(z2), 0.0, 0.0, 1)
    cells = cell_places(camera, pose, np.zeros((len(y), len(x))), AREA)
    return find_vehicles([plane], cells, AREA, SUN)


@pytest.mark.parametrize("direction", [0.0, math.pi / 4, math.pi / 2])
def test_a_car_is_found_where_it_stands(direction):
    found = frame([(10.0, -5.0, direction)])
    np.testing.assert_allclose(found.position[0], [10.0, -5.0], atol=HALF_A_CELL)
    assert found.score[0] > 5 * max(found.score[1:], default=0.0)


def test_two_cars_side_by_side_are_two():
    """3.5 m apart, as in neighbouring lanes: two templates stand out, each at its car."""
    found = frame([(0.0, 0.0, 0.0), (0.0, 3.5, 0.0)])
    assert found.score[1] > 5 * max(found.score[2:], default=0.0)
    north = np.sort(found.position[:2, 1])
    np.testing.assert_allclose(north, [0.0, 3.5], atol=HALF_A_CELL)


def test_fine_elements_are_averaged_and_all_count():
    """A change of one standard deviation of the noise on each element of 0.125 m, as no single one shows."""
    design = SensorDesign(layout="pan", rows=320, columns=320, pitch_um=12.5, focal_length_mm=100.0)
    sensor, pose = build_sensor(design, wavelength_grid()), Pose(0.0, 0.0, 1000.7)
    fine = binning_factor(0.125)
    assert fine == 3
    row, column = np.mgrid[:320, :320]
    place = ground_points(sensor.camera, pose, np.stack([row, column], axis=-1), 0.7)
    car = (np.abs(place[..., 0] - 5.0) <= 2.3) & (np.abs(place[..., 1] + 3.0) <= 1.0)
    electrons = 1000.0 + 10.0 * (np.random.default_rng(0).standard_normal(car.shape) + car)
    background = PredictedBackground(np.full(car.shape, 1000.0), np.full(car.shape, 100.0))
    area = (-20.0, -20.0, 20.0, 20.0)
    x, y = ground_cells(area)
    score = {}
    for factor in (1, fine):
        planes = group_planes("pan", electrons, background, sensor, factor)
        spacing_m = 0.125 * fine if factor > 1 else CELL_M
        cells = cell_places(sensor.camera, pose, np.zeros((len(y), len(x))), area, spacing_m)
        assert cells.shape[2] == (4 if factor > 1 else 1)
        found = find_vehicles(planes, cells, area, SUN)
        near = np.hypot(*(found.position - [5.0, -3.0]).T) < HALF_A_CELL
        score[factor] = max(found.score[near], default=0.0), max(found.score[~near], default=0.0)
    assert score[3][0] > 3 * score[3][1] and score[3][0] > 2 * score[1][0]


def test_noise_alone_says_little():
    assert max(frame([]).score, default=0.0) < 0.2 * frame([(0.0, 0.0, 0.0)]).score[0]


def test_scores_fall_and_positions_lie_inside():
    found = frame([(x, 0.0, 0.3) for x in (-30.0, -10.0, 10.0, 30.0)])
    assert (np.diff(found.score) <= 1e-6).all()
    assert (np.abs(found.position) <= 40).all()
