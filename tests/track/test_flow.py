"""Flow of traffic: votes of straight triplets, velocity of new tracks, and what tracking gains by it."""

import numpy as np
import pytest

from glintrack import track
from glintrack.track.flow import birth_velocity, count_votes, no_flow, update_flow
from tests.plain import plain_tracker

AREA = track.Grid((280, 440), (-330.0, 210.0), 1.5)


def lane(speed_m_s, gap_m, north_m, time_s, noise_m=0.0, rng=None):
    """Vehicles of one lane along east, at irregular gaps: positions at a time."""
    gaps_m = gap_m * np.random.default_rng(7).uniform(0.6, 1.4, round(1200 / gap_m))
    east = np.cumsum(gaps_m) - 600 + speed_m_s * time_s
    places = np.stack([east, np.full(len(east), north_m)], axis=-1)
    return places if rng is None else places + rng.normal(0, noise_m, places.shape)


def learn(*lanes, interval_s=0.5, frames=8):
    """Flow after some frames of lanes (speed, gap, north)."""
    flow, rng = no_flow(), np.random.default_rng(1)
    for k in range(frames):
        places = np.concatenate([lane(*one, k * interval_s, 0.4, rng) for one in lanes])
        flow = update_flow(flow, places, k * interval_s)
    return flow


@pytest.mark.parametrize("interval_s", [0.1, 0.5])
def test_vehicles_that_move_farther_than_their_gap_give_their_velocity(interval_s):
    flow = learn((30.0, 27.0, 0.0), interval_s=interval_s, frames=round(4 / interval_s))
    velocity, trusted = birth_velocity(flow, np.array([[10.0, 0.5], [10.0, 40.0]]))
    np.testing.assert_array_equal(trusted, [True, False])  # beside the road nothing is known
    np.testing.assert_allclose(velocity[0], [30.0, 0.0], atol=1.0)


def test_flow_is_learnt_at_a_low_frame_rate_too():
    velocity, trusted = birth_velocity(learn((15.0, 80.0, 0.0), interval_s=2.0), np.array([[10.0, 0.0]]))
    assert trusted.all()
    np.testing.assert_allclose(velocity, [[15.0, 0.0]], atol=0.5)


def test_each_carriageway_has_its_own_direction():
    flow = learn((30.0, 41.0, -8.0), (-28.0, 37.0, 8.0))
    velocity, trusted = birth_velocity(flow, np.array([[0.0, -8.0], [0.0, 8.0]]))
    assert trusted.all()
    np.testing.assert_allclose(velocity, [[30, 0], [-28, 0]], atol=1.0)


def test_slow_or_contradictory_traffic_is_not_trusted():
    place = np.zeros((1, 2))
    assert not birth_velocity(learn((8.0, 15.0, 0.0)), place)[1].any()
    assert not birth_velocity(learn((30.0, 41.0, 0.0), (-30.0, 41.0, 0.0)), place)[1].any()
    assert not birth_velocity(no_flow(), place)[1].any()


def test_votes_are_those_of_other_vehicles():
    alone = learn((20.0, 1200.0, 0.0))  # one vehicle
    at = lane(20.0, 1200.0, 0.0, 3.5)
    velocity = np.array([[20.0, 0.0]])
    assert count_votes(alone, at, velocity, 3.5) == 0
    many = learn((20.0, 50.0, 0.0))
    at = lane(20.0, 50.0, 0.0, 3.5)[12:13]
    assert count_votes(many, at, velocity, 3.5) >= 4
    assert count_votes(many, at, -velocity, 3.5) == 0


def follow(flow_velocity):
    """Share of the vehicles of a motorway that keep one track for 8 s, from detections of 80 % of them."""
    design = plain_tracker().replace({"initiation.flow_velocity": flow_velocity})
    state, rng = track.start(design), np.random.default_rng(3)
    ids: dict[int, list[int]] = {}
    for k in range(36):
        places = np.concatenate([lane(30.0, 23.0, -8.0, 0.5 * k), lane(-30.0, 26.0, 8.0, 0.5 * k)])
        seen = places[rng.random(len(places)) < 0.8] + rng.normal(0, 0.4, (1, 2))
        n = len(seen)
        found = track.Detections(seen, np.repeat(0.4 * np.eye(2)[None], n, 0), np.ones(n), np.ones(n))
        state = track.step_detections(state, found, 0.5 * k, AREA)
        targets = state.targets
        if k >= 20:
            apart = np.hypot(*(targets.position[None] - places[:, None]).transpose(2, 0, 1))
            for vehicle in np.flatnonzero(np.abs(places[:, 0]) < 150):
                near = apart[vehicle].argmin()
                if apart[vehicle, near] < 4:
                    ids.setdefault(int(vehicle), []).append(int(targets.id[near]))
    long = [np.array(one) for one in ids.values() if len(one) >= 6]
    return np.mean([np.unique(one, return_counts=True)[1].max() / len(one) for one in long])


def test_tracks_of_a_motorway_keep_their_vehicles():
    assert follow(True) > 0.8 > 0.6 > follow(False)
