"""MOTA, IDF1 and HOTA against TrackEval, OSPA against Stone Soup, GOSPA against a case worked by hand."""

import tracemalloc

import numpy as np
import pytest

from glintrack import metrics
from glintrack.metrics.multi_object import Similarity

parity = 1e-6  # the issue's; both compute in doubles


def a_run(seed, epochs=30, vehicles=8):
    """Vehicles that come and go, tracks that miss, swap and are false."""
    rng = np.random.default_rng(seed)
    place, step = rng.uniform(0, 60, (vehicles, 2)), rng.normal(0, 2, (vehicles, 2))
    name = np.arange(vehicles) + 100
    out = []
    for k in range(epochs):
        here = np.flatnonzero(rng.random(vehicles) < 0.9)
        held = here[rng.random(len(here)) < 0.8]
        if k % 7 == 6:
            name = rng.permutation(name)
        false = rng.integers(0, 3)
        tracks = np.concatenate([name[held], 500 + rng.permutation(5)[:false]])
        at = place + k * step
        spots = np.concatenate(
            [at[held] + rng.normal(0, 1.5, (len(held), 2)), rng.uniform(0, 60, (false, 2))]
        )
        if k in (4, 11):  # an epoch without tracks, and one without vehicles
            tracks, spots = tracks[:0], spots[:0]
        if k == 11:
            here = here[:0]
        out.append(metrics.point_similarity(here, at[here], tracks, spots, 5.0))
    return out


@pytest.mark.parametrize("seed", range(4))
def test_parity_with_trackeval(seed):
    trackeval = pytest.importorskip("trackeval", reason="trackeval (extra dev) is not installed")
    epochs = a_run(seed)
    vehicle_ids = np.unique(np.concatenate([e.vehicles for e in epochs]))
    track_ids = np.unique(np.concatenate([e.tracks for e in epochs]))
    data = {
        "num_gt_ids": len(vehicle_ids),
        "num_tracker_ids": len(track_ids),
        "num_gt_dets": sum(len(e.vehicles) for e in epochs),
        "num_tracker_dets": sum(len(e.tracks) for e in epochs),
        "num_timesteps": len(epochs),
        "gt_ids": [np.searchsorted(vehicle_ids, e.vehicles) for e in epochs],
        "tracker_ids": [np.searchsorted(track_ids, e.tracks) for e in epochs],
        "similarity_scores": [e.similarity for e in epochs],
    }
    quiet = {"PRINT_CONFIG": False}
    clear = trackeval.metrics.CLEAR(quiet).eval_sequence(data)
    identity = trackeval.metrics.Identity(quiet).eval_sequence(data)
    hota = trackeval.metrics.HOTA().eval_sequence(data)
    ours = metrics.multi_object_scores(epochs)
    assert ours["mota"] == pytest.approx(clear["MOTA"], abs=parity)
    assert ours["motp"] == pytest.approx(clear["MOTP"], abs=parity)
    assert ours["idf1"] == pytest.approx(identity["IDF1"], abs=parity)
    for name in ("HOTA", "DetA", "AssA"):
        assert ours[name.lower()] == pytest.approx(np.mean(hota[name]), abs=parity)


def test_a_long_flight_takes_no_more_than_its_rows():
    """Thousands of vehicles and of tracks, of which ten at a time meet: tables of all by all took GB."""
    epochs = [
        Similarity(ids := np.arange(10 * k, 10 * k + 10), ids, np.where(np.eye(10), 0.9, 0.0))
        for k in range(300)
    ]
    tracemalloc.start()
    scores = metrics.multi_object_scores(epochs)
    _, most_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert scores["idf1"] == 1.0 and scores["motp"] == pytest.approx(0.9)
    table_bytes = 8 * 3000**2  # one table of all vehicles by all tracks; HOTA had nineteen
    assert most_bytes < table_bytes / 10


def test_perfect_tracks_score_one():
    ids, spots = np.arange(3), np.array([[0.0, 0.0], [20.0, 0.0], [0.0, 20.0]])
    scores = metrics.multi_object_scores([metrics.point_similarity(ids, spots, ids + 7, spots, 5.0)] * 4)
    assert all(value == 1.0 for value in scores.values())


def test_nothing_at_all_is_no_error():
    none = Similarity(np.empty(0, int), np.empty(0, int), np.empty((0, 0)))
    assert metrics.multi_object_scores([none]) == dict.fromkeys(
        ("mota", "motp", "idf1", "hota", "deta", "assa"), 0
    )
    assert metrics.multi_object_scores([])["hota"] == 0


@pytest.mark.parametrize("seed", range(4))
def test_ospa_against_stone_soup(seed):
    pytest.importorskip("stonesoup", reason="stonesoup (extra dev) is not installed")
    from stonesoup.measures import Euclidean
    from stonesoup.metricgenerator.ospametric import OSPAMetric
    from stonesoup.types.state import State

    rng = np.random.default_rng(seed)
    a, b = rng.uniform(0, 30, (rng.integers(1, 9), 2)), rng.uniform(0, 30, (rng.integers(1, 9), 2))
    peer = OSPAMetric(p=2, c=10.0, measure=Euclidean())
    states = [[State(p[:, None]) for p in points] for points in (a, b)]
    theirs = peer.compute_OSPA_distance(*states).value
    assert metrics.ospa(a, b, 10.0, 2.0) == pytest.approx(theirs, abs=1e-9)


def test_gospa_worked_by_hand():
    """One pair 3 m apart, one vehicle missed, two false tracks, c = 10, p = 2: √(9 + 3·50)."""
    vehicles = np.array([[0.0, 0.0], [100.0, 0.0]])
    tracks = np.array([[3.0, 0.0], [200.0, 0.0], [300.0, 0.0]])
    assert metrics.gospa(vehicles, tracks) == pytest.approx(np.sqrt(9 + 150), abs=1e-12)
    assert metrics.gospa(vehicles, tracks[:0]) == pytest.approx(10.0, abs=1e-12)
    assert metrics.gospa(vehicles[:0], tracks[:0]) == 0
