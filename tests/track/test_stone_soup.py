"""Stone Soup's types and ours: there and back, and either tracker in the other's loop."""

import sys
from datetime import datetime, timedelta

import numpy as np
import pytest

from glintrack import track
from glintrack.track import stone_soup
from glintrack.track.detect.detections import order
from glintrack.track.detect.frame import Grid

EPOCH = datetime(2026, 6, 21, 12)
GRID = Grid((20, 20), (-142.5, 142.5), 15.0)


def two_cars(epochs=12, seed=0):
    """Two cars on crossing ways, measured with 0.5 m."""
    rng = np.random.default_rng(seed)
    for k in range(epochs):
        t = 0.5 * k
        truth = np.array([[-60 + 9 * t, 5.0], [4.0, 60 - 8 * t]])
        found = track.Detections(
            truth + rng.normal(0, 0.5, (2, 2)),
            np.repeat(0.25 * np.eye(2)[None], 2, axis=0),
            np.array([3.0, 5.0]),
            np.array([1.2, 1.9]),
        )
        yield t, truth, found


def test_detections_come_back_as_they_were():
    pytest.importorskip("stonesoup", reason="needs the extra stonesoup")
    t, _, found = next(two_cars())
    theirs = stone_soup.to_detections(found, t, EPOCH)
    assert theirs[0].timestamp == EPOCH
    back = stone_soup.from_detections(set(theirs))
    index = order(found)
    for name in ("position", "covariance", "extent", "contrast"):
        np.testing.assert_array_equal(getattr(back, name), getattr(found, name)[index])


def test_their_tracks_in_our_scores():
    state = pytest.importorskip("stonesoup.types.state", reason="needs the extra stonesoup")
    track_of = pytest.importorskip("stonesoup.types.track", reason="needs the extra stonesoup").Track
    when, covariance = EPOCH + timedelta(seconds=2.0), np.diag([1.0, 2.0, 3.0, 4.0])
    tracks = {
        track_of([state.GaussianState(np.array([[east], [8.0], [1.0], [0.5]]), covariance, timestamp=when)])
        for east in (10.0, 40.0)
    }
    dataset = stone_soup.from_tracks(tracks, 2.0, EPOCH)
    assert sorted(dataset["east_m"].values) == [10.0, 40.0] and (dataset["north_m"].values == 1.0).all()
    assert (dataset["east_speed_m_s"].values == 8.0).all() and (dataset["north_var_m2"].values == 3.0).all()
    assert (dataset["status"].values == "coasted").all()
    assert stone_soup.from_tracks(set(), 0.0, EPOCH).sizes["track"] == 0


def test_what_cannot_be_used_is_one_sentence(monkeypatch):
    detection = pytest.importorskip("stonesoup.types.detection", reason="needs the extra stonesoup").Detection
    with pytest.raises(ValueError, match="`sigma_m` must be given"):
        stone_soup.from_detections([detection(np.zeros((2, 1)))])
    assert len(stone_soup.from_detections([detection(np.zeros((2, 1)))], sigma_m=0.5)) == 1
    with pytest.raises(ValueError, match="must hold east and north; got 3"):
        stone_soup.from_detections([detection(np.zeros((3, 1)))], sigma_m=0.5)
    monkeypatch.setitem(sys.modules, "stonesoup.types.detection", None)
    with pytest.raises(ValueError, match="the extra `stonesoup` must be installed"):
        stone_soup.to_detections(next(two_cars())[2], 0.0, EPOCH)
