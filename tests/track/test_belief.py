"""Which of the tracks that are followed are reported."""

from dataclasses import replace

import numpy as np
import pytest

from glintrack import track
from glintrack.track import belief
from glintrack.track.initiation import newborn, select

CHANNELS = ("pan", "dolp", "all")
AREA = track.Grid((40, 40), (-300.0, 300.0), 15.0)
INTERVAL_S = 0.5
EXISTENCE = {"reporting.method": "existence", "reporting.lag_s": 0.0}


def followed(east_m, speed_m_s=10.0, trust: float | np.ndarray = 2.0):
    """Confirmed targets that have driven north side by side for 5 s."""
    n = len(east_m)
    place = np.stack([np.asarray(east_m, float), np.zeros(n)], axis=-1)
    found = track.Detections(place, np.repeat(np.eye(2)[None], n, 0), np.ones(n), np.ones(n))
    design = track.TrackDesign()
    new = newborn(design, found, (np.full((n, design.identity.bins), np.nan), np.full((n, 2), np.nan)),
                  np.arange(n), 0)  # fmt: skip
    mean = new.mean.copy()
    mean[:, 3] = speed_m_s
    return replace(
        new, mean=mean, mode_mean=mean[:, None], born=place - [0.0, 5.0 * speed_m_s], age_s=np.full(n, 5.0),
        confirmed=np.ones(n, bool), trust=np.broadcast_to(trust, n).astype(float),
    )  # fmt: skip


@pytest.mark.parametrize("channel", CHANNELS)
def test_what_speaks_for_a_vehicle_raises_the_odds(channel):
    usual = belief.log_odds(channel, followed([0.0]))[0]
    assert belief.log_odds(channel, followed([0.0], trust=-2.0))[0] < usual
    assert belief.log_odds(channel, replace(followed([0.0]), misses=np.array([2])))[0] < usual
    assert belief.log_odds(channel, followed([0.0], speed_m_s=1.0))[0] < usual
    stayed = replace(followed([0.0]), born=np.zeros((1, 2)))
    assert belief.log_odds(channel, stayed)[0] < usual


@pytest.mark.parametrize("channel", CHANNELS)
def test_neighbours_count_within_their_reach_and_more_if_they_move_alike(channel):
    alone = belief.log_odds(channel, followed([0.0]))[0]
    assert belief.log_odds(channel, followed([0.0, belief.NEAR_M + 0.1]))[0] == pytest.approx(alone)
    beside = followed([0.0, 6.0])
    assert belief.log_odds(channel, beside)[0] < alone
    opposite = replace(beside, mean=beside.mean * np.array([[1, 1, 1, 1], [1, 1, 1, -1]]))
    assert belief.log_odds(channel, beside)[0] < belief.log_odds(channel, opposite)[0] < alone
    unconfirmed = replace(beside, confirmed=np.array([True, False]))
    assert belief.log_odds(channel, unconfirmed)[0] == pytest.approx(alone)


def test_neighbours_are_those_of_all_pairs():
    rng = np.random.default_rng(2)
    targets = followed(rng.uniform(0, 150, 40))
    targets = replace(targets, mean=targets.mean + rng.normal(0, 2, targets.mean.shape))
    escorted, crowded = belief._nearness(targets)
    apart = np.hypot(*(targets.position[:, None] - targets.position).transpose(2, 0, 1))
    near = np.where(np.eye(40, dtype=bool) | (apart > belief.NEAR_M), 0.0, 1 - apart / belief.NEAR_M)
    speeds = targets.mean[:, None, 2:] - targets.mean[:, 2:]
    alike = np.where(np.hypot(*speeds.transpose(2, 0, 1)) < belief.ALIKE_M_S, near, 0.0)
    np.testing.assert_allclose(crowded, near.max(axis=1))
    np.testing.assert_allclose(escorted, alike.max(axis=1))


def reported_of(channel, targets, candidate, leader, false_share):
    odds = belief.led_odds(channel, targets, leader)
    return belief.surest(odds, candidate & (leader == np.arange(len(targets))), false_share)


def test_such_a_share_is_reported_as_may_be_false_the_likeliest_first():
    targets = followed(50.0 * np.arange(30), trust=np.linspace(-4.0, 4.0, 30))
    odds, all_, own = belief.log_odds("pan", targets), np.ones(30, bool), np.arange(30)
    false = 1 / (1 + np.exp(odds))
    counts = []
    for share in (0.04, 0.06, 0.1):
        told = reported_of("pan", targets, all_, own, share)
        assert false[told].mean() <= share
        assert odds[told].min() >= odds[~told].max()
        assert (false[told].sum() + false[~told].min()) / (told.sum() + 1) > share
        counts.append(told.sum())
    assert counts == sorted(set(counts))
    assert not reported_of("pan", targets, all_, own, 0.0).any()
    np.testing.assert_array_equal(reported_of("pan", targets, all_, own, 1.0), odds >= belief.LEAST_ODDS)
    turned = select(targets, np.arange(30)[::-1])
    np.testing.assert_array_equal(
        reported_of("pan", turned, all_, own, 0.1)[::-1],
        reported_of("pan", targets, all_, own, 0.1),
    )


def test_one_is_reported_for_all_on_its_vehicle_as_the_likeliest_of_them():
    targets = followed([0.0, 50.0, 100.0], trust=np.array([-4.0, 4.0, -4.0]))
    leader, all_ = np.array([0, 0, 2]), np.ones(3, bool)
    told = reported_of("pan", targets, all_, leader, 1.0)
    np.testing.assert_array_equal(told, [True, False, False])


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
    design = track.TrackDesign().replace(
        {"query.policy": "none", "initiation.coast_s": 4.0} | EXISTENCE | {"reporting.max_false_share": 0.15}
    )
    ids = reported([3.0] * 10 + [None] * 4 + [3.0] * 8, design)
    assert ids[9] and ids[21] == ids[9]
    assert [] in ids[10:14]


def test_all_are_reported_where_detections_say_nothing_of_themselves():
    found = track.Detections(np.zeros((1, 2)), np.eye(2)[None], np.ones(1), np.ones(1))
    design = track.TrackDesign().replace(
        {"query.policy": "none", "reporting.max_false_share": 0.0} | EXISTENCE
    )
    state = track.step_detections(track.start(design), found, 0.0, AREA)
    state = replace(state, targets=replace(state.targets, confirmed=np.ones(1, bool)))
    assert track.report(state).sizes["track"] == 1


def test_at_first_sight_only_what_stands_apart_is_confirmed():
    design = track.TrackDesign().replace({"query.policy": "none", "initiation.confirm_ratio": 2.0})
    known = followed([0.0])
    place = np.array([[3.9, 0.0], [4.1, 0.0], [50.0, 0.0]])
    found = track.Detections(
        place, np.repeat(np.eye(2)[None], 3, 0), np.ones(3), np.ones(3),
        log_likelihood_ratio=np.array([3.0, 3.0, 1.0]),
    )  # fmt: skip
    features = np.full((3, design.identity.bins), np.nan), np.full((3, 2), np.nan)
    born = newborn(design, found, features, np.arange(3), 7, apart_from=known)
    np.testing.assert_array_equal(born.confirmed, [False, True, False])


@pytest.mark.parametrize(
    ("method", "key", "value"),
    [
        ("existence", "initiation.confirm_hits", 4),
        ("existence", "initiation.confirm_travel_m", 3.0),
        ("confirmation", "reporting.max_false_share", 0.2),
        ("confirmation", "reporting.lag_s", 0.0),
    ],
)
def test_keys_that_the_reporting_method_ignores_are_refused(method, key, value):
    other = {"existence": "confirmation", "confirmation": "existence"}[method]
    assert track.TrackDesign().replace({"reporting.method": other, key: value})
    with pytest.raises(ValueError, match=rf"`{key}` must be left out with reporting.method = '{method}'"):
        track.TrackDesign().replace({"reporting.method": method, key: value})
