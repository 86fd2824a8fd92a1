"""Existence model: odds of tracks, selection of reported ones, duplicates and reassigned ids."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import expit, logit

from glintrack import track
from glintrack.track import existence
from glintrack.track.calibration import read_calibration
from glintrack.track.design import TrackDesign
from glintrack.track.existence import NEIGHBOUR_M
from glintrack.track.flow import no_flow
from glintrack.track.identity import BINS
from glintrack.track.initiation import initiate, select, speed_sigma
from tests.plain import plain_tracker

CHANNELS = ("pan", "dolp", "all")
AREA = track.Grid((40, 40), (-300.0, 300.0), 15.0)
INTERVAL_S = 0.5
LIMITS = existence.duplicate_limits()
REASSIGNED_M = read_calibration("existence").constants["reassigned_m"]
EXISTENCE = {"reporting.method": "existence", "reporting.lag_s": 0.0, "initiation.rules": "change"}


def log_odds(channel, targets):
    """Log odds of targets without duplicates."""
    return existence.group_log_odds(channel, targets, np.arange(len(targets)), no_flow(), 0.0)


def followed(east_m, speed_m_s=10.0, recent_ratio: float | np.ndarray = 2.0):
    """Confirmed targets that have driven north side by side for 5 s."""
    n = len(east_m)
    place = np.stack([np.asarray(east_m, float), np.zeros(n)], axis=-1)
    found = track.Detections(place, np.repeat(np.eye(2)[None], n, 0), np.ones(n), np.ones(n))
    design = plain_tracker()
    new = initiate(design, found, np.full((n, BINS), np.nan), np.arange(n), 0, no_flow())
    mean = new.mean.copy()
    mean[:, 3] = speed_m_s
    return replace(
        new, mean=mean, mode_mean=mean[:, None], first_position=place - [0.0, 5.0 * speed_m_s],
        age_s=np.full(n, 5.0), confirmed=np.ones(n, bool),
        recent_ratio=np.broadcast_to(recent_ratio, n).astype(float),
    )  # fmt: skip


@pytest.mark.parametrize("channel", CHANNELS)
def test_what_speaks_for_a_vehicle_raises_the_odds(channel):
    usual = log_odds(channel, followed([0.0]))[0]
    assert log_odds(channel, followed([0.0], recent_ratio=-2.0))[0] < usual
    assert log_odds(channel, replace(followed([0.0]), misses=np.array([2])))[0] < usual
    assert log_odds(channel, followed([0.0], speed_m_s=1.0))[0] < usual
    stayed = replace(followed([0.0]), first_position=np.zeros((1, 2)))
    assert log_odds(channel, stayed)[0] < usual


@pytest.mark.parametrize("channel", CHANNELS)
def test_neighbours_count_within_their_reach_and_more_if_they_move_alike(channel):
    alone = log_odds(channel, followed([0.0]))[0]
    assert log_odds(channel, followed([0.0, existence.QUEUE_M + 0.1]))[0] == pytest.approx(alone)
    beside = followed([0.0, 6.0])
    assert log_odds(channel, beside)[0] < alone
    opposite = replace(beside, mean=beside.mean * np.array([[1, 1, 1, 1], [1, 1, 1, -1]]))
    assert log_odds(channel, beside)[0] < log_odds(channel, opposite)[0] < alone
    unconfirmed = replace(beside, confirmed=np.array([True, False]))
    assert log_odds(channel, unconfirmed)[0] == pytest.approx(alone)


def test_neighbours_are_those_of_all_pairs():
    rng = np.random.default_rng(2)
    targets = followed(rng.uniform(0, 300, 40))
    targets = replace(targets, mean=targets.mean + rng.normal(0, 2, targets.mean.shape))
    co_moving, any_near, count = existence._neighbours(targets, np.arange(40))
    apart = np.hypot(*(targets.position[:, None] - targets.position).transpose(2, 0, 1))
    near = np.where(np.eye(40, dtype=bool) | (apart > NEIGHBOUR_M), 0.0, 1 - apart / NEIGHBOUR_M)
    speeds = targets.mean[:, None, 2:] - targets.mean[:, 2:]
    alike = np.where(np.hypot(*speeds.transpose(2, 0, 1)) < existence.SAME_SPEED_M_S, near, 0.0)
    np.testing.assert_allclose(any_near, near.max(axis=1))
    np.testing.assert_allclose(co_moving, alike.max(axis=1))
    near = (apart <= existence.QUEUE_M) & ~np.eye(40, dtype=bool)
    same = np.hypot(*speeds.transpose(2, 0, 1)) < existence.SAME_SPEED_M_S
    np.testing.assert_array_equal(count, (near & same).sum(axis=1))


@pytest.mark.parametrize("channel", CHANNELS)
def test_a_neighbour_in_a_queue_is_another_vehicle(channel):
    """Beside one other track it is probably a second end of one vehicle."""

    def change(count):
        spread = followed(np.r_[0.0, 12.5 * np.arange(1, count)])
        close = followed(np.r_[0.0, 6.0, 12.5 * np.arange(2, count)])
        return log_odds(channel, close)[0] - log_odds(channel, spread)[0]

    assert change(2) < change(6) < 0.5


def test_two_tracks_of_a_queue_are_no_duplicates():
    assert pairs_of(followed([0.0, 3.0])) == [[0, 1]]
    assert not pairs_of(followed([0.0, 3.0, 12.0, 20.0, 30.0]))


def test_two_tracks_on_busy_lanes_are_no_duplicates():
    pair = placed([(0, 0), (1.8, 6)])  # farther across than two places of one vehicle
    place, velocity = np.zeros((9, 2)), np.tile([0.0, 10.0], (9, 1))
    for count, found in ((LIMITS["max_votes"], 1), (9, 0)):
        flow = replace(
            no_flow(), place=place[:count], velocity=velocity[:count], time_s=-3.0 * np.ones(count)
        )
        assert len(existence.update_duplicates(existence.no_duplicates(), pair, flow, 0.0).pair) == found


def test_two_tracks_nearer_than_a_driver_follows_are_one_vehicle():
    def pairs_in_a_lane(*north_m):
        return pairs_of(placed([(0.0, one) for one in north_m]))

    assert pairs_in_a_lane(0, 8, 30, 50, 70) == [[0, 1]]  # a lorry, and a queue ahead of it
    assert not pairs_in_a_lane(0, 9, 30, 50, 70)
    assert not pairs_in_a_lane(0, 8, 16, 24, 70)  # several so near are vehicles


def test_a_vehicle_does_not_lower_its_own_odds_by_its_second_track():
    targets = followed([0.0, 3.0])
    apart = existence.group_log_odds("all", targets, np.array([0, 1]), no_flow(), 0.0)
    together = existence.group_log_odds("all", targets, np.array([0, 0]), no_flow(), 0.0)
    assert together[0] > apart[0]
    assert together[0] == pytest.approx(log_odds("all", followed([0.0]))[0])


def reported_of(channel, targets, candidate, primary, false_share):
    odds = existence.group_log_odds(channel, targets, primary, no_flow(), 0.0)
    moving = np.ones(len(targets), bool)
    return existence.select_reported_tracks(
        odds, candidate & (primary == np.arange(len(targets))), moving, false_share
    )


def test_such_a_share_is_reported_as_may_be_false_the_likeliest_first():
    targets = followed(50.0 * np.arange(30), recent_ratio=np.linspace(-4.0, 4.0, 30))
    odds, all_, own = log_odds("pan", targets), np.ones(30, bool), np.arange(30)
    false = 1 / (1 + np.exp(odds))
    counts = []
    for share in (0.04, 0.06, 0.1):
        reported = reported_of("pan", targets, all_, own, share)
        assert false[reported].mean() <= share
        assert odds[reported].min() >= odds[~reported].max()
        assert (false[reported].sum() + false[~reported].min()) / (reported.sum() + 1) > share
        counts.append(reported.sum())
    assert counts == sorted(set(counts))
    assert not reported_of("pan", targets, all_, own, 0.0).any()
    np.testing.assert_array_equal(reported_of("pan", targets, all_, own, 1.0), odds >= existence.MIN_LOG_ODDS)
    turned = select(targets, np.arange(30)[::-1])
    np.testing.assert_array_equal(
        reported_of("pan", turned, all_, own, 0.1)[::-1],
        reported_of("pan", targets, all_, own, 0.1),
    )


def test_tracks_that_stand_make_no_room_for_false_ones():
    odds, share = np.r_[np.full(20, 4.0), np.full(20, 3.0), np.zeros(20)], 0.1
    every, stands = np.ones(60, bool), np.arange(60) < 20
    alike = existence.select_reported_tracks(odds, every, every, share)
    reported = existence.select_reported_tracks(odds, every, ~stands, share)
    assert reported[stands].all()
    assert reported[20:40].all()
    assert reported[40:].sum() < alike[40:].sum()
    none = existence.select_reported_tracks(odds, every, ~every, share)  # all stand: the sure ones
    np.testing.assert_array_equal(none, odds >= 3.0)


def test_one_is_reported_for_all_on_its_vehicle_as_the_likeliest_of_them():
    targets = followed([0.0, 50.0, 100.0], recent_ratio=np.array([-4.0, 4.0, -4.0]))
    primary, all_ = np.array([0, 0, 2]), np.ones(3, bool)
    reported = reported_of("pan", targets, all_, primary, 1.0)
    np.testing.assert_array_equal(reported, [True, False, False])


def reported(ratios, design):
    """Ids reported at each frame of one target that drives east; None is a miss."""
    state, out = track.start(design), []
    for k, ratio in enumerate(ratios):
        n = int(ratio is not None)
        found = track.Detections(
            np.array([[8.0 * INTERVAL_S * k, 0.0]])[:n], 0.25 * np.eye(2)[None][:n], np.ones(n), np.ones(n),
            log_likelihood_ratio=np.full(n, 0.0 if ratio is None else ratio),
        )  # fmt: skip
        state = track.step_detections(state, found, INTERVAL_S * k, AREA)
        out.append(track.report(state)["track"].values.tolist())
    return out


def test_a_doubted_track_is_followed_on_and_comes_back_as_itself():
    """Its detections speak for a vehicle, then against one, then for one again."""
    design = plain_tracker().replace(
        {"query.policy": "none", "initiation.coast_s": 4.0} | EXISTENCE | {"reporting.max_false_share": 0.15}
    )
    ids = reported([3.0] * 10 + [None] * 4 + [3.0] * 8, design)
    assert ids[9] and ids[21] == ids[9]
    assert [] in ids[10:14]


def test_all_are_reported_where_detections_say_nothing_of_themselves():
    found = track.Detections(np.zeros((1, 2)), np.eye(2)[None], np.ones(1), np.ones(1))
    design = plain_tracker().replace({"query.policy": "none", "reporting.max_false_share": 0.0} | EXISTENCE)
    with pytest.warns(UserWarning, match="detections have no log-likelihood ratio"):
        state = track.step_detections(track.start(design), found, 0.0, AREA)
    state = replace(state, targets=replace(state.targets, confirmed=np.ones(1, bool)))
    assert track.report(state).sizes["track"] == 1


def test_at_first_sight_only_what_stands_apart_is_confirmed():
    design = plain_tracker().replace({"query.policy": "none", "initiation.rules": "frames"})
    known = followed([0.0])
    place = np.array([[3.9, 0.0], [4.1, 0.0], [50.0, 0.0]])
    found = track.Detections(
        place, np.repeat(np.eye(2)[None], 3, 0), np.ones(3), np.ones(3),
        log_likelihood_ratio=np.array([7.0, 7.0, 3.0]),
    )  # fmt: skip
    features = np.full((3, BINS), np.nan)
    new = initiate(design, found, features, np.arange(3), 7, no_flow(), others=known)
    np.testing.assert_array_equal(new.confirmed, [False, True, False])


@pytest.mark.parametrize(
    ("method", "key", "value"),
    [
        ("existence", "initiation.rules", "frames"),
        ("existence", "initiation.confirm_score", 3.0),
        ("existence", "initiation.confirm_hits", 3),
        ("existence", "initiation.confirm_ratio", 4.0),
        ("confirmation", "reporting.max_false_share", 0.2),
        ("confirmation", "reporting.lag_s", 0.0),
    ],
)
def test_keys_that_the_reporting_method_ignores_are_refused(method, key, value):
    other = {"existence": "confirmation", "confirmation": "existence"}[method]
    plain = plain_tracker().replace({"initiation.rules": "change"})
    assert plain.replace({"reporting.method": other, key: value})
    with pytest.raises(ValueError, match=rf"`{key}` must be left out with reporting.method = '{method}'"):
        plain.replace({"reporting.method": method, key: value})


def placed(place, velocity=(0.0, 10.0)):
    """Confirmed targets there, the older first, which drive north."""
    place = np.asarray(place, float).reshape(-1, 2)
    targets = followed(place[:, 0])
    mean = np.concatenate([place, np.broadcast_to(velocity, place.shape)], axis=1)
    return replace(targets, mean=mean, mode_mean=mean[:, None])


def paired(before, targets):
    """Pairs after an epoch without votes."""
    return existence.update_duplicates(before, targets, no_flow(), 0.0)


def pairs_of(targets):
    return paired(existence.no_duplicates(), targets).pair.tolist()


@pytest.mark.parametrize(
    ("apart", "together"),
    [
        ((0.0, 8.4), True),
        ((0.0, 8.6), False),
        ((1.6, 6.6), True),
        ((1.6, 7.0), False),
        ((1.9, 6.5), True),
        ((2.1, 6.5), False),
        ((5.7, 3.9), True),
        ((5.5, 4.1), False),
    ],
)
def test_one_vehicle_is_near_and_in_line_or_abreast(apart, together):
    assert bool(pairs_of(placed([(0, 0), apart]))) == together


def test_what_moves_otherwise_or_slowly_or_was_long_unseen_is_another():
    place = [(0, 0), (0, 6)]
    assert pairs_of(placed(place)) == [[0, 1]]
    assert not pairs_of(placed(place, [(0.0, 10.0), (0.0, 16.1)]))
    assert not pairs_of(placed(place, [(0.0, 10.0), (0.0, -10.0)]))
    assert not pairs_of(placed(place, (0.0, LIMITS["min_speed_m_s"] - 0.1)))
    assert not pairs_of(replace(placed(place), misses=np.array([0, 2])))
    assert not pairs_of(replace(placed(place), confirmed=np.array([True, False])))


def test_pairs_are_those_of_all_pairs_however_the_scene_is_turned():
    rng = np.random.default_rng(4)
    place = np.repeat(rng.uniform(0, 700, (40, 2)), 2, axis=0) + rng.uniform(0, 8, (80, 2))
    velocity = rng.normal(0, 1, (80, 2)) * 2.5 + [3.0, 9.0]
    apart = np.hypot(*(place[:, None] - place).transpose(2, 0, 1))
    speeds = np.hypot(*(velocity[:, None] - velocity).transpose(2, 0, 1))
    alike = ((apart <= existence.QUEUE_M) & (speeds < existence.SAME_SPEED_M_S)).sum(axis=1) - 1
    targets = placed(place, velocity)
    together = {}
    for a in range(80):
        for b in range(a + 1, 80):
            r, v = place[b] - place[a], (velocity[a] + velocity[b]) / 2
            speed = np.hypot(*v)
            if speeds[a, b] < LIMITS["speed_difference_m_s"] and speed > LIMITS["min_speed_m_s"]:
                aside = abs(r[0] * v[1] - r[1] * v[0]) / speed
                together[a, b] = apart[a, b], abs(r @ v) / speed, aside, speed
    beside = [
        k for k, (far, _, aside, _) in together.items()
        if far <= LIMITS["follower_m"] and aside <= LIMITS["beside_m"]
    ]  # fmt: skip
    expected = []
    for (a, b), (far, ahead, aside, speed) in together.items():
        two = sum(a in k for k in beside) == sum(b in k for k in beside) == 1
        near = two and (a, b) in beside and aside <= LIMITS["lane_m"]
        near &= ahead <= LIMITS["car_m"] + LIMITS["headway_s"] * speed
        alone = min(alike[a], alike[b]) <= LIMITS["max_alike"]
        alone &= far <= LIMITS["distance_m"]
        if near or (alone and (ahead <= LIMITS["along_m"] or aside <= LIMITS["across_m"])):
            expected.append([a, b])
    assert len(expected) > 15
    assert pairs_of(targets) == expected
    c, s = np.cos(1.0), np.sin(1.0)
    turned = np.array([[c, -s], [s, c]])
    assert pairs_of(placed(place @ turned.T, velocity @ turned.T)) == expected
    assert pairs_of(placed(place * [-1, 1], velocity * [-1, 1])) == expected


def test_what_went_together_for_two_frames_stays_so_while_it_is_near():
    together, apart = placed([(0, 0), (0, 6.5)]), placed([(0, 0), (0, 11)], [(0.0, 10.0), (0.0, 18.0)])
    once = paired(existence.no_duplicates(), together)
    assert not len(paired(once, apart).pair)
    twice = paired(once, together)
    assert twice.frames.tolist() == [2]
    assert paired(twice, apart).pair.tolist() == [[0, 1]]
    assert not len(paired(twice, placed([(0, 0), (0, 12.1)])).pair)
    assert not len(paired(twice, select(apart, np.array([1]))).pair)
    assert not len(paired(twice, select(apart, np.array([], int))).pair)


def test_the_oldest_leads_and_stands_in_the_middle_and_the_rest_stay():
    targets = placed([(0, 0), (0.1, 6.3), (100.7, 3.3), (0, -6)])
    known = paired(existence.no_duplicates(), targets)
    primary = existence.primary_targets(known, targets)
    assert primary.tolist() == [0, 0, 2, 0]
    moved = existence.move_to_mean_position(targets, primary)
    np.testing.assert_allclose(moved.position[0], [0.1 / 3, 0.3 / 3])
    np.testing.assert_array_equal(moved.mean[1:], targets.mean[1:])
    np.testing.assert_array_equal(moved.mode_mean[:, 0], moved.mean)
    np.testing.assert_array_equal(moved.mean[:, 2:], targets.mean[:, 2:])


@pytest.mark.parametrize(("gap_m", "vehicles"), [(6.0, 1), (15.0, 2)])
def test_two_ends_are_one_track_and_two_vehicles_are_two(gap_m, vehicles):
    design = plain_tracker().replace({"query.policy": "none", "reporting.max_false_share": 0.5} | EXISTENCE)
    state, reported = track.start(design), []
    for k in range(14):
        middle = 10.0 * INTERVAL_S * k
        place = np.array([[middle - gap_m / 2, 0.0], [middle + gap_m / 2, 0.0]])
        found = track.Detections(
            place, np.repeat(0.25 * np.eye(2)[None], 2, 0), np.ones(2), np.ones(2),
            log_likelihood_ratio=np.full(2, 3.5),
        )  # fmt: skip
        state = track.step_detections(state, found, INTERVAL_S * k, AREA)
        reported.append(track.report(state))
    settled = reported[6:]
    assert {one.sizes["track"] for one in settled} == {vehicles}
    assert len({tuple(one["track"].values.tolist()) for one in settled}) == 1
    if vehicles == 1:
        half_a_metre = 0.5
        assert abs(float(settled[-1]["east_m"][0]) - 10.0 * INTERVAL_S * 13) < half_a_metre
    assert state.targets.confirmed.sum() == 2


SPEED_M_S = 8.0


def ids_told(aside_m, missed, method):
    """Ids reported of one target that drives east, out of sight for some frames, then found so far aside."""
    design = plain_tracker().replace(
        {
            "query.policy": "none",
            **EXISTENCE,
            "reporting.max_false_share": 0.5,
            "motion.acceleration_psd_m2_s3": 4.0,
            "association.gate_probability": 0.999999,
            "association.method": method,
        }
    )
    state, out = track.start(design), []
    for k in range(16 + missed):
        seen = k < 8 or k >= 8 + missed
        place = [SPEED_M_S * INTERVAL_S * k, aside_m if k >= 8 else 0.0]
        found = track.Detections(
            np.array([place])[: int(seen)], 0.25 * np.eye(2)[None][: int(seen)], np.ones(int(seen)),
            np.ones(int(seen)), log_likelihood_ratio=np.full(int(seen), 3.5),
        )  # fmt: skip
        state = track.step_detections(state, found, INTERVAL_S * k, AREA)
        out.append(track.report(state)["track"].values.tolist())
    return out


@pytest.mark.parametrize("method", ["gnn", "mht"])
def test_found_again_near_it_is_itself_and_far_off_another(method):
    near, far = (
        ids_told(0.9 * REASSIGNED_M, 2, method),
        ids_told(1.1 * REASSIGNED_M, 2, method),
    )
    assert near[7] == near[-1]
    assert len(near[-1]) == len(far[-1]) == 1
    assert far[7] == near[7]
    assert far[-1] != far[7]
    assert far[10] == far[-1], "at the frame in which it is found again"


def test_only_what_was_out_of_sight_gets_a_new_number():
    before = followed([0.0, 100.0, 200.0])
    before = replace(before, misses=np.array([1, 0, 1]))
    far = [0.0, SPEED_M_S * INTERVAL_S + REASSIGNED_M + 3]
    moved = before.mean + np.array([0.0, 0.0, 0.0, 0.0])
    moved[:, :2] += far
    after = replace(before, mean=moved, mode_mean=moved[:, None], misses=np.array([0, 0, 2]))
    assert existence.reassign_ids(before, after, INTERVAL_S, 7).tolist() == [7, 1, 2]
    tentative = replace(after, confirmed=np.array([False, True, True]))
    assert existence.reassign_ids(before, tentative, INTERVAL_S, 7).tolist() == [0, 1, 2]


ADAPTED = read_calibration("existence").constants


@pytest.mark.parametrize("more", [0.0, 0.05, 0.09])
def test_log_odds_adapt_to_a_greater_share_of_vehicles(more):
    """Features of equal covariance have linear log odds: for another share only the intercept changes."""
    rng, usual, count = np.random.default_rng(5), ADAPTED["usual_share"]["dolp"], 20000
    vehicle = rng.random(count) < usual + more
    feature = rng.normal(np.where(vehicle, 1.0, -1.0), 1.0)
    fitted = 2 * feature + logit(usual)
    adapted = existence.adapt_log_odds("dolp", fitted)
    assert adapted - fitted == pytest.approx(logit(usual + more) - logit(usual), abs=0.1)
    assert expit(adapted).mean() == pytest.approx(usual + more, abs=0.01)


@pytest.mark.parametrize("channel", CHANNELS)
def test_log_odds_never_fall_and_rise_by_no_more_than_the_limit(channel):
    doubted, sure = np.linspace(-4.0, 1.0, 200), np.full(1000, 5.0)
    np.testing.assert_array_equal(existence.adapt_log_odds(channel, doubted), doubted)
    assert existence.adapt_log_odds(channel, sure) - sure == pytest.approx(ADAPTED["max_rise"])


def test_few_targets_hardly_change_their_log_odds():
    odds = np.full(3, 4.0)
    rise = existence.adapt_log_odds("all", odds) - odds
    assert np.all((rise > 0) & (rise < 0.2))
    assert len(existence.adapt_log_odds("all", np.empty(0))) == 0


def test_the_speed_of_slow_traffic_limits_that_of_a_new_track():
    design = TrackDesign()
    limit = design.initiation.speed_sigma_m_s
    slow = replace(followed(12.0 * np.arange(200)), age_s=np.full(200, 3.0))
    slow.mean[:, 2:] = [4.0, 0.0]
    assert speed_sigma(design, None) == limit
    assert speed_sigma(design, replace(slow, age_s=np.full(200, 1.0))) == limit  # too young to tell
    assert speed_sigma(design, slow) == pytest.approx(4 / np.sqrt(2), rel=0.2)
    slow.mean[:, 2:] = [30.0, 0.0]
    assert speed_sigma(design, slow) == limit
