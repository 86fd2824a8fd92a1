"""Gating against brute force, assignment against SciPy's optimum."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from scipy.stats import multivariate_normal

from glintrack.track import assignment
from glintrack.track.motion import Modes, position_density

rounding = 1e-9


def as_modes(mean, covariance):
    return Modes(mean[:, None], covariance[:, None], np.ones((len(mean), 1)))


def negative_log_density(mean, covariance, tracks, detections, measured, noise):
    """Cost of each pair without clutter and detector."""
    density = position_density(as_modes(mean, covariance), tracks, detections, measured, noise)
    return -np.log(np.maximum(density[:, 0], assignment.MIN_DENSITY_M2))


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 30), st.integers(0, 30), st.floats(0.01, 1))
def test_assignment_equals_scipys(seed, tracks, detections, density):
    rng = np.random.default_rng(seed)
    possible = rng.random((tracks, detections)) < density
    rows, columns = np.nonzero(possible)
    cost, miss = rng.normal(-3, 5, len(rows)), rng.normal(2, 3, tracks)
    shuffled = rng.permutation(len(rows))
    chosen = assignment.assign(rows[shuffled], columns[shuffled], cost[shuffled], miss, detections)

    table = np.full((tracks, detections + tracks), 1e6)
    table[rows, columns] = cost
    table[np.arange(tracks), detections + np.arange(tracks)] = miss
    r, c = linear_sum_assignment(table)
    hit = chosen >= 0
    assert len(set(chosen[hit])) == hit.sum()
    assert possible[np.nonzero(hit)[0], chosen[hit]].all()
    total = table[np.nonzero(hit)[0], chosen[hit]].sum() + miss[~hit].sum()
    assert abs(total - table[r, c].sum()) < rounding * max(1, abs(total))


def test_missing_may_be_cheaper_than_a_detection():
    assert assignment.assign([0], [0], [3.0], [2.0], 1).tolist() == [-1]
    assert assignment.assign([0], [0], [1.0], [2.0], 1).tolist() == [0]


def test_a_long_chain_of_tracks_needs_no_table_of_all_pairs():
    """Each of 10 000 tracks may own its detection or the next one's: a whole table would hold 1.6 GB."""
    count = 10_000
    own = np.arange(count)
    tracks, detections = np.repeat(own, 2), np.stack([own, own + 1], 1).ravel()
    cost = np.tile([-1.0, -2.0], count)
    chosen = assignment.assign(tracks, detections, cost, np.full(count, 3.0), count + 1)
    np.testing.assert_array_equal(chosen, own + 1)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_gate_equals_brute_force(seed):
    rng = np.random.default_rng(seed)
    n, m, gate = rng.integers(0, 40), rng.integers(0, 40), 9.0
    mean, measured = rng.uniform(-20, 20, (n, 4)), rng.uniform(-20, 20, (m, 2))
    root = rng.normal(size=(n, 4, 4))
    covariance = root @ root.transpose(0, 2, 1) + np.eye(4)
    root = rng.normal(size=(m, 2, 2))
    noise = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(2)
    tracks, detections = assignment.gate(mean, covariance, measured, noise, gate)
    cost = negative_log_density(mean, covariance, tracks, detections, measured, noise)
    found = dict(zip(zip(tracks.tolist(), detections.tolist(), strict=True), cost, strict=True))
    expected = {}
    for i in range(n):
        for j in range(m):
            s, d = covariance[i, :2, :2] + noise[j], measured[j] - mean[i, :2]
            if d @ np.linalg.solve(s, d) <= gate:
                expected[i, j] = -multivariate_normal.logpdf(d, cov=s)
    assert found.keys() == expected.keys()
    assert all(abs(found[k] - expected[k]) < rounding * (1 + abs(expected[k])) for k in found)


def test_gate_grows_with_what_it_finds():
    """200 tracks on 200 detections at one point: every pair, though room is made for far fewer."""
    mean, covariance = np.zeros((200, 4)), np.repeat(np.eye(4)[None], 200, axis=0)
    noise = np.repeat(np.eye(2)[None], 200, axis=0)
    points = np.zeros((200, 2))
    tracks, detections = assignment.gate(mean, covariance, points, noise, 9.0)
    cost = negative_log_density(mean, covariance, tracks, detections, points, noise)
    assert len(tracks) == 200 * 200
    np.testing.assert_allclose(cost, np.log(2 * np.pi * 2))  # −ln N(0; 0, 2·1)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_order_of_detections_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    mean, measured = rng.uniform(-20, 20, (20, 4)), rng.uniform(-20, 20, (20, 2))
    covariance, noise = np.repeat(4 * np.eye(4)[None], 20, 0), np.repeat(np.eye(2)[None], 20, 0)
    shuffled = rng.permutation(20)
    answers = []
    for z in (measured, measured[shuffled]):
        i, j = assignment.gate(mean, covariance, z, noise, 13.8)
        cost = negative_log_density(mean, covariance, i, j, z, noise)
        chosen = assignment.assign(i, j, cost - 7.0, np.full(20, 2.0), 20)
        answers.append(np.where((chosen >= 0)[:, None], z[chosen], np.nan))
    np.testing.assert_array_equal(*answers)


def exact_marginals(possible, ratio):
    """Association probabilities by listing every one-to-one association."""
    n, m = possible.shape
    weight = np.zeros((n, m))
    total = 0.0
    for choice in itertools.product(range(-1, m), repeat=n):
        used = [j for j in choice if j >= 0]
        if len(set(used)) < len(used) or not all(possible[i, j] for i, j in enumerate(choice) if j >= 0):
            continue
        worth = np.prod([ratio[i, j] for i, j in enumerate(choice) if j >= 0])
        total += worth
        for i, j in enumerate(choice):
            if j >= 0:
                weight[i, j] += worth
    return weight / total


@pytest.mark.parametrize("seed", range(8))
def test_marginals_against_every_association(seed):
    """On a tree belief propagation is exact; with loops it is close (Williams and Lau report some 0.05)."""
    rng = np.random.default_rng(seed)
    chain = np.eye(4, 5, dtype=bool) | np.eye(4, 5, k=1, dtype=bool)  # track i sees detections i and i + 1
    for possible, tolerance in ((chain, 1e-8), (rng.random((4, 4)) < 0.8, 0.08)):
        tracks, detections = np.nonzero(possible)
        cost, miss = rng.normal(0, 2, len(tracks)), rng.normal(1, 1, 4)
        ratio = np.zeros(possible.shape)
        ratio[tracks, detections] = np.exp(miss[tracks] - cost)
        found = assignment.marginals(tracks, detections, cost, miss, possible.shape[1])
        expected = exact_marginals(possible, ratio)[tracks, detections]
        np.testing.assert_allclose(found, expected, atol=tolerance)
