"""Trees of hypotheses: where the scan decides wrongly and the window does not, and against listing all."""

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from glintrack import track
from glintrack.track import hypotheses
from glintrack.track.files import DETECTIONS_DESIGN

AREA = track.Grid((40, 40), (-300.0, 300.0), 15.0)
SIGMA_M = 0.5
DT = 0.5


def follow(scans, method="gnn", changes=None):
    """Our tracker over scans of points; the state after each."""
    design = DETECTIONS_DESIGN.replace({"association.method": method, **(changes or {})})
    state, out = track.start(design), []
    for k, points in enumerate(scans):
        points = np.asarray(points, float).reshape(-1, 2)
        n = len(points)
        covariance = np.repeat(SIGMA_M**2 * np.eye(2)[None], n, axis=0)
        found = track.Detections(points, covariance, np.full(n, 4.0), np.ones(n))
        state = track.step_detections(state, found, k * DT, AREA)
        out.append(state)
    return out


def crowd(seed, scans=25, vehicles=12):
    """Vehicles that cross a small place with misses, noise and clutter."""
    rng = np.random.default_rng(seed)
    place, speed = rng.uniform(-60, 60, (vehicles, 2)), rng.normal(0, 7, (vehicles, 2))
    out = []
    for k in range(scans):
        seen = rng.random(vehicles) < 0.85
        points = (place + k * DT * speed)[seen] + rng.normal(0, SIGMA_M, (seen.sum(), 2))
        out.append(rng.permutation(np.r_[points, rng.uniform(-80, 80, (rng.poisson(4), 2))]))
    return out


def missed_at_a_decoy():
    """A car drives east at 10 m/s. It is missed once, where a false blob lies 4 m aside, then goes on.

    The scan alone must take the blob, since it is likelier than a miss; the next looks say it was none.
    """
    scans = [[[10.0 * DT * k, 0.0]] for k in range(16)]
    scans[10] = [[10.0 * DT * 10 - 1.5, 2.6]]
    return scans


def test_the_window_takes_back_what_the_scan_believed():
    one, four = (follow(missed_at_a_decoy(), "mht", {"association.scans": n}) for n in (1, 4))
    gnn = follow(missed_at_a_decoy())
    # the decoy was taken by all at first
    for states in (gnn, one, four):
        assert states[10].targets.misses[0] == 0
    truth = np.array([10.0 * DT * 11, 0.0])
    errors = [np.hypot(*(s[11].targets.position[0] - truth)) for s in (gnn, four)]
    assert four[11].targets.history[0] & 2 == 0  # the scan before is a miss now
    assert gnn[11].targets.history[0] & 2 == 2
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.parametrize("motion", ["imm", "constant-velocity"])
def test_a_window_of_one_scan_is_one_to_one_association(motion):
    scans = crowd(3)
    gnn = follow(scans, changes={"motion.model": motion})
    one = follow(scans, "mht", {"motion.model": motion, "association.scans": 1})
    for a, b in zip(gnn, one, strict=True):
        for field in dataclasses.fields(a.targets):
            np.testing.assert_array_equal(
                getattr(a.targets, field.name), getattr(b.targets, field.name), err_msg=field.name
            )


def test_order_of_detections_changes_nothing_and_again_is_the_same():
    scans = crowd(5)
    rng = np.random.default_rng(0)
    shuffled = [rng.permutation(points) for points in scans]
    runs = [follow(s, "mht")[-1].targets for s in (scans, scans, shuffled)]
    for other in runs[1:]:
        for field in dataclasses.fields(runs[0]):
            np.testing.assert_array_equal(getattr(runs[0], field.name), getattr(other, field.name))


def test_no_detection_serves_two_targets_of_the_best_hypothesis():
    for state in follow(crowd(7), "mht"):
        used = state.leaves.used[state.leaves.chosen]
        used = used[used >= 0]
        assert len(np.unique(used)) == len(used)
        assert state.leaves.chosen.sum() == len(state.targets)
        np.testing.assert_array_equal(state.leaves.targets.id[state.leaves.chosen], state.targets.id)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_best_rows_against_every_choice(seed):
    """Four trees of up to four leaves, a window of three scans: the least cost of all without a clash."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(1, 5, 4)
    starts = np.r_[0, np.cumsum(sizes)]
    cost = np.concatenate([np.sort(rng.normal(0, 3, n)) for n in sizes])
    used = np.where(rng.random((len(cost), 3)) < 0.6, rng.integers(0, 3, (len(cost), 3)) + [0, 10, 20], -1)
    used[starts[1:] - 1] = -1  # the dearest leaf of each saw nothing: there is a choice
    found = hypotheses.select_hypothesis(starts, cost, used)
    best = np.inf
    for rows in itertools.product(*(range(a, b) for a, b in itertools.pairwise(starts))):
        taken = used[list(rows)]
        taken = taken[taken >= 0]
        if len(np.unique(taken)) == len(taken):
            best = min(best, cost[list(rows)].sum())
    taken = used[found]
    taken = taken[taken >= 0]
    assert len(np.unique(taken)) == len(taken)
    rounding = 1e-8  # a gain below 1e-9 is none
    assert abs(cost[found].sum() - best) < rounding


def test_trees_stay_small():
    for state in follow(crowd(9), "mht"):
        _, leaves = np.unique(state.leaves.targets.id, return_counts=True)
        assert leaves.max(initial=0) <= hypotheses.MAX_LEAVES + 1  # the best leaf stays, however dear
