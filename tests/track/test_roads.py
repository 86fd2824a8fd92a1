"""The road map: distances, costs, directions, and what it changes in the tracker."""

import numpy as np
import pytest

from glintrack import track
from glintrack.track import roads
from glintrack.track.detect.detections import Detections
from glintrack.track.detect.frame import Grid
from tests.plain import plain_tracker

LINES = [np.array([[-100.0, 0.0], [100.0, 0.0]]), np.array([[0.0, 20.0], [0.0, 120.0]])]
GRID = Grid((20, 20), (-142.5, 142.5), 15.0)


def test_cost_is_the_gaussian_of_the_way_off_the_road():
    """On the road nothing; 3 m + 2σ off it 2 nat; far off no more than the cap."""
    costs = roads.roads_of(LINES).off_road_cost(np.array([[10.5, 0.0], [10.5, -7.0], [-90.0, 80.0]]))
    np.testing.assert_allclose(costs, [0.0, 2.0, 4.0], atol=1e-9)


def test_new_targets_drive_along_their_road():
    spread = roads.roads_of(LINES).speed_covariance(np.array([[-50.0, 1.0], [1.0, 80.0]]), 8.0)
    np.testing.assert_allclose(spread[0], np.diag([64.0, 4.0]), atol=1e-9)
    np.testing.assert_allclose(spread[1], np.diag([4.0, 64.0]), atol=1e-9)


def confirmed_after(epochs, north_m, design):
    """Number of tracks of one thing that moves east at 8 m/s, so far north of the road."""
    state = track.start(design, roads=LINES)
    for k in range(epochs):
        place = np.array([[-80.0 + 4.0 * k, north_m]])
        found = Detections(place, 0.25 * np.eye(2)[None], np.ones(1), np.ones(1))
        state = track.step_detections(state, found, 0.5 * k, GRID)
    return track.report(state).sizes["track"]


def test_off_the_road_a_track_must_prove_more(monkeypatch):
    monkeypatch.setattr(roads, "MAX_COST_NAT", 8.0)
    with_map = plain_tracker().replace({"roads.prior": True, "association.clutter_density_m2": 1e-3})
    without = plain_tracker().replace({"association.clutter_density_m2": 1e-3})
    for epochs in range(2, 12):
        on, off = confirmed_after(epochs, 0.0, with_map), confirmed_after(epochs, -40.0, with_map)
        assert on >= off and on >= confirmed_after(epochs, 0.0, without)
    assert confirmed_after(11, 0.0, with_map) == 1 and confirmed_after(11, -40.0, with_map) == 0


def test_bad_roads_are_one_sentence():
    with pytest.raises(ValueError, match="`roads` must be given"):
        track.start(plain_tracker().replace({"roads.prior": True}))
    with pytest.raises(ValueError, match="`roads` must hold a line with a length"):
        roads.roads_of([np.zeros((2, 2))])
    with pytest.raises(ValueError, match="`roads` must be lines of finite points"):
        roads.roads_of([np.full((2, 2), np.nan)])
