"""Tracks of one vehicle's ends are reported as one, in the middle."""

from dataclasses import replace

import numpy as np
import pytest

from glintrack import track
from glintrack.track import companions
from glintrack.track.initiation import select

from .test_belief import AREA, EXISTENCE, INTERVAL_S, followed


def placed(place, velocity=(0.0, 10.0)):
    """Confirmed targets there, the older first, which drive north."""
    place = np.asarray(place, float).reshape(-1, 2)
    targets = followed(place[:, 0])
    mean = np.concatenate([place, np.broadcast_to(velocity, place.shape)], axis=1)
    return replace(targets, mean=mean, mode_mean=mean[:, None])


def pairs(targets):
    return companions.after(companions.no_companions(), targets).pair.tolist()


@pytest.mark.parametrize(
    ("apart", "together"),
    [
        ((0.0, 7.9), True),
        ((0.0, 8.1), False),
        ((2.9, 7.0), True),
        ((3.1, 7.0), False),
        ((6.9, 3.9), True),
        ((6.5, 4.1), False),
    ],
)
def test_one_vehicle_is_near_and_in_line_or_abreast(apart, together):
    assert bool(pairs(placed([(0, 0), apart]))) == together


def test_what_moves_otherwise_or_slowly_or_was_long_unseen_is_another():
    place = [(0, 0), (0, 6)]
    assert pairs(placed(place)) == [[0, 1]]
    assert not pairs(placed(place, [(0.0, 10.0), (0.0, 16.1)]))
    assert not pairs(placed(place, [(0.0, 10.0), (0.0, -10.0)]))
    assert not pairs(placed(place, (0.0, companions.SLOWEST_M_S - 0.1)))
    assert not pairs(replace(placed(place), misses=np.array([0, 2])))
    assert not pairs(replace(placed(place), confirmed=np.array([True, False])))


def test_pairs_are_those_of_all_pairs_however_the_scene_is_turned():
    rng = np.random.default_rng(4)
    place, velocity = rng.uniform(0, 60, (60, 2)), rng.normal(0, 1, (60, 2)) * 2.5 + [3.0, 9.0]
    targets = placed(place, velocity)
    expected = []
    for a in range(60):
        for b in range(a + 1, 60):
            r, v = place[b] - place[a], (velocity[a] + velocity[b]) / 2
            ahead, aside = abs(r @ v) / np.hypot(*v), abs(r[0] * v[1] - r[1] * v[0]) / np.hypot(*v)
            if (
                np.hypot(*r) <= companions.FOUND_M
                and np.hypot(*(velocity[a] - velocity[b])) < companions.ALIKE_M_S
                and np.hypot(*v) > companions.SLOWEST_M_S
                and (ahead <= companions.AHEAD_M or aside <= companions.ASIDE_M)
            ):
                expected.append([a, b])
    assert len(expected) > 20
    assert pairs(targets) == expected
    c, s = np.cos(1.0), np.sin(1.0)
    turned = np.array([[c, -s], [s, c]])
    assert pairs(placed(place @ turned.T, velocity @ turned.T)) == expected
    assert pairs(placed(place * [-1, 1], velocity * [-1, 1])) == expected


def test_what_went_together_for_two_frames_stays_so_while_it_is_near():
    together, apart = placed([(0, 0), (0, 7)]), placed([(0, 0), (0, 11)], [(0.0, 10.0), (0.0, 18.0)])
    once = companions.after(companions.no_companions(), together)
    assert not len(companions.after(once, apart).pair)
    twice = companions.after(once, together)
    assert twice.frames.tolist() == [2]
    assert companions.after(twice, apart).pair.tolist() == [[0, 1]]
    assert not len(companions.after(twice, placed([(0, 0), (0, 12.1)])).pair)
    assert not len(companions.after(twice, select(apart, np.array([1]))).pair)
    assert not len(companions.after(twice, select(apart, np.array([], int))).pair)


def test_the_oldest_leads_and_stands_in_the_middle_and_the_rest_stay():
    targets = placed([(0, 0), (0.1, 7.3), (100.7, 3.3), (0, -6)])
    known = companions.after(companions.no_companions(), targets)
    leader = companions.leaders(known, targets)
    assert leader.tolist() == [0, 0, 2, 0]
    moved = companions.in_the_middle(targets, leader)
    np.testing.assert_allclose(moved.position[0], [0.1 / 3, 1.3 / 3])
    np.testing.assert_array_equal(moved.mean[1:], targets.mean[1:])
    np.testing.assert_array_equal(moved.mode_mean[:, 0], moved.mean)
    np.testing.assert_array_equal(moved.mean[:, 2:], targets.mean[:, 2:])


@pytest.mark.parametrize(("gap_m", "vehicles"), [(7.0, 1), (15.0, 2)])
def test_two_ends_are_one_track_and_two_vehicles_are_two(gap_m, vehicles):
    design = track.TrackDesign().replace(
        {"query.policy": "none", "reporting.max_false_share": 0.5, "initiation.speed_sigma_m_s": 8.0}
        | EXISTENCE
    )
    state, told = track.start(design), []
    for k in range(14):
        middle = 10.0 * INTERVAL_S * k
        place = np.array([[middle - gap_m / 2, 0.0], [middle + gap_m / 2, 0.0]])
        found = track.Detections(
            place, np.repeat(0.25 * np.eye(2)[None], 2, 0), np.ones(2), np.ones(2),
            log_likelihood_ratio=np.full(2, 3.5),
        )  # fmt: skip
        state = track.step_detections(state, found, INTERVAL_S * k, AREA)
        told.append(track.report(state))
    settled = told[6:]
    assert {one.sizes["track"] for one in settled} == {vehicles}
    assert len({tuple(one["track"].values.tolist()) for one in settled}) == 1
    if vehicles == 1:
        half_a_metre = 0.5
        assert abs(float(settled[-1]["east"][0]) - 10.0 * INTERVAL_S * 13) < half_a_metre
    assert state.targets.confirmed.sum() == 2
