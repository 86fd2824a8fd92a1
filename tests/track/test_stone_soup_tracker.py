"""Stone Soup's tracker behind a detector of ours: it tracks, tells the detector, and repeats itself."""

import sys
from datetime import datetime, timedelta
from unittest import mock

import numpy as np
import pytest

from glintrack import track
from glintrack.track import stone_soup_tracker as module
from glintrack.track.stone_soup import to_detections
from glintrack.track.stone_soup_tracker import GnnSettings, StoneSoupTracker, gnn_tracker

EPOCH = datetime(2026, 6, 21, 12)
GRID = track.Grid((20, 20), (-142.5, 142.5), 15.0)
SIGMA_M, RATE_HZ, EPOCHS = 0.5, 2.0, 12


def cars(time_s):
    """Two cars on crossing ways. [m]"""
    return np.array([[-60 + 9 * time_s, 5.0], [4.0, 60 - 8 * time_s]])


def found_at(k, rng, missing=()):
    """Both cars but the missing ones, and one false detection."""
    place = np.delete(cars(k / RATE_HZ), list(missing), axis=0)
    false = [[23.0 * (5 * k % EPOCHS) - 130.0, -130.0]]  # now here, now there: never a track
    place = np.r_[place + rng.normal(0, SIGMA_M, place.shape), false]
    n = len(place)
    return track.Detections(
        place, np.repeat(SIGMA_M**2 * np.eye(2)[None], n, axis=0), np.full(n, 4.0), np.ones(n)
    )


class Told:
    """A detector that finds what it is told to, and keeps what it hears of it."""

    def __init__(self, missing=None, seed=3):
        rng = np.random.default_rng(seed)
        self.scans = [found_at(k, rng, (missing or {}).get(k, ())) for k in range(EPOCHS)]
        self.heard, self.expected = [], []

    def start(self, frame):
        return 0

    def detect(self, state, frame):
        self.expected.append(frame.expected_m)
        return self.scans[state]

    def update(self, state, frame, detections, association):
        self.heard.append(association)
        return state + 1


def followed(detector, **settings):
    """Reports of the tracker over all epochs."""
    pytest.importorskip("stonesoup", reason="needs the extra stonesoup")
    with mock.patch.dict(module.DETECTORS, {"background": lambda design: detector}):
        design = track.TrackDesign().replace({"detect.detector": "background"})
        tracker = StoneSoupTracker(design, GnnSettings(**settings))
        return [tracker.step(track.Frame(k / RATE_HZ, grid=GRID)) for k in range(EPOCHS)]


def coasted(report, car):
    """Of the tracks near a car, whether they were not seen."""
    near = np.hypot(report["east"].values - car[0], report["north"].values - car[1]) < 12.0
    return report["coasted"].values[near].tolist()


def test_it_is_stone_soups_own_loop():
    """The same tracks as Stone Soup's tracker over the same scans, called without our frames."""
    pytest.importorskip("stonesoup", reason="needs the extra stonesoup")
    detector = Told()
    scans = (
        (EPOCH + timedelta(seconds=k / RATE_HZ), set(to_detections(found, k / RATE_HZ, EPOCH)))
        for k, found in enumerate(detector.scans)
    )
    theirs = [
        sorted(float(one.state_vector[0]) for one in tracks)
        for _, tracks in gnn_tracker(scans, GnnSettings())
    ]
    reports = followed(detector, report_coasted=True)
    ours = [np.sort(report["east"].values).tolist() for report in reports]
    assert ours == theirs


def test_it_follows_two_cars_and_tells_the_detector_which_detections_are_theirs():
    detector = Told()
    reports = followed(detector)
    assert [len(r["track"]) for r in reports[:2]] == [0, 0] and len(reports[2]["track"]) == 2
    ends = np.stack([reports[-1]["east"].values, reports[-1]["north"].values], axis=1)
    for car in cars((EPOCHS - 1) / RATE_HZ):
        assert np.hypot(*(ends - car).T).min() < 3 * SIGMA_M
    assert detector.heard[-1].explained.tolist() == [True, True, False]
    np.testing.assert_allclose(np.sort(detector.heard[-1].measured_m, axis=0), np.sort(ends, axis=0))
    ahead = np.sort(detector.expected[-1], axis=0) - np.sort(cars((EPOCHS - 1) / RATE_HZ), axis=0)
    assert np.abs(ahead).max() < 3 * SIGMA_M
    assert set(reports[2]["track"].values) == {0, 1} <= set(reports[-1]["track"].values)


def test_what_is_not_seen_coasts_and_is_given_up():
    gone = {k: (1,) for k in range(5, EPOCHS)}
    reports = followed(Told(gone), report_coasted=True)
    assert [coasted(report, cars(k / RATE_HZ)[1]) for k, report in enumerate(reports)][4:] == [
        [0.0], [1.0], [1.0], [1.0], [], [], [], [],
    ]  # fmt: skip
    assert all((report["coasted"] == 0).all() for report in followed(Told(gone)))


def test_what_is_far_is_left_out_and_nothing_else(monkeypatch):
    """The same tracks to the last digit as with every pair weighed."""
    soon = followed(Told(seed=7), report_coasted=True)
    monkeypatch.setattr(module, "_Near", lambda hypothesiser: hypothesiser)
    for one, other in zip(soon, followed(Told(seed=7), report_coasted=True), strict=True):
        assert one.identical(other)


def test_the_same_frames_give_the_same_numbers():
    """Stone Soup names its tracks by chance and keeps them in sets."""
    for one, other in zip(followed(Told()), followed(Told()), strict=True):
        assert one.identical(other)


def test_time_must_advance():
    pytest.importorskip("stonesoup", reason="needs the extra stonesoup")
    with mock.patch.dict(module.DETECTORS, {"background": lambda design: Told()}):
        tracker = StoneSoupTracker(track.TrackDesign().replace({"detect.detector": "background"}))
        tracker.step(track.Frame(1.0, grid=GRID))
        with pytest.raises(ValueError, match="`time_s` must be later than the last frame's 1 s, got 1"):
            tracker.step(track.Frame(1.0, grid=GRID))


def test_says_what_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "stonesoup.tracker.simple", None)
    with pytest.raises(ValueError, match="the extra `stonesoup` must be installed to track with Stone Soup"):
        StoneSoupTracker(track.TrackDesign())
