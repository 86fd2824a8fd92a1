"""Tracks reported with a fixed lag: by what came within it, and by nothing later."""

from dataclasses import replace

import numpy as np
import pytest

from glintrack import track
from glintrack.track import reporting
from glintrack.track.calibration import read_calibration
from tests.plain import plain_tracker

from .test_existence import AREA, EXISTENCE, INTERVAL_S

LAG_S = 1.5
FRAMES = 24
DESIGN = plain_tracker().replace(
    {"query.policy": "none", "reporting.max_false_share": 0.3, "initiation.coast_s": 4.0} | EXISTENCE
)


def seen(places, ratio=3.0):
    """Detections at places, alike."""
    place = np.asarray(places, float).reshape(-1, 2)
    n = len(place)
    return track.Detections(
        place, np.repeat(0.25 * np.eye(2)[None], n, 0), np.ones(n), np.ones(n),
        log_likelihood_ratio=np.full(n, ratio),
    )  # fmt: skip


def states(found, lag_s=LAG_S):
    """The tracker after each frame."""
    state, out = track.start(DESIGN.replace({"reporting.lag_s": lag_s})), []
    for k, one in enumerate(found):
        state = track.step_detections(state, one, INTERVAL_S * k, AREA)
        out.append(state)
    return out


def lagged_reports(found, lag_s=LAG_S):
    """Tracks of each frame."""
    return list(track.report_epochs(states(found, lag_s)))


def east(k):
    """Of a car at 10 m/s."""
    return -100.0 + 10.0 * INTERVAL_S * k


def drive(k, missed=()):
    """Detections of a car that drives east, none in some frames."""
    return seen([(east(k), 0.0)] if k not in missed else [])


@pytest.mark.parametrize("lag_s", [0.0, 0.3, 0.5, 1.5, 60.0])
def test_every_frame_is_told_once_in_order(lag_s):
    found = [drive(k) for k in range(FRAMES)]
    times = [one.attrs["time_s"] for one in lagged_reports(found, lag_s)]
    np.testing.assert_allclose(times, INTERVAL_S * np.arange(FRAMES))


def test_without_a_lag_it_is_what_is_told_at_once():
    found = [drive(k, missed=(10, 11)) for k in range(FRAMES)]
    for one, state in zip(lagged_reports(found, 0.0), states(found, 0.0), strict=True):
        assert one.identical(track.report(state))


def test_what_comes_later_than_the_lag_changes_nothing():
    rng = np.random.default_rng(3)
    cut = 15
    cars = [[(east(k), 0.0)] if k not in (cut - 2, cut - 1) else np.empty((0, 2)) for k in range(FRAMES)]
    found = [seen(np.concatenate([car, rng.uniform(-250, 250, (6, 2))])) for car in cars]
    other = found[:cut] + [seen(rng.uniform(-250, 250, (6, 2))) for _ in found[cut:]]
    a, b = lagged_reports(found), lagged_reports(other)
    known = cut - round(LAG_S / INTERVAL_S)
    assert all(one.identical(two) for one, two in zip(a[:known], b[:known], strict=True))
    assert not all(one.identical(two) for one, two in zip(a[known:cut], b[known:cut], strict=True))


def test_a_gap_is_the_straight_line_between_both_measurements():
    """The car turns off while nothing sees it: where it coasts to is wrong by then."""
    found = [drive(k) if k < 12 else seen([(east(k) - 2.0, 2.0 * (k - 12.5))]) for k in range(FRAMES)]
    found[12], found[13] = seen([]), seen([])
    at_once, then = track.report(states(found)[13]), lagged_reports(found)[13]
    ident = int(at_once["track"][0])
    after = next(one for one in states(found)[14:] if (one.targets.misses == 0).any())
    assert ident in after.targets.id, "the same track is found again"
    before, again = states(found)[11], states(found)[14]
    ends = [one.targets.position[one.targets.id == ident][0] for one in (before, again)]
    place = then.sel(track=ident)
    np.testing.assert_allclose([place["east_m"], place["north_m"]], ends[0] + 2 / 3 * (ends[1] - ends[0]))
    assert str(place["status"].values) == "coasted"


def test_a_track_is_told_back_to_before_its_first_detection_and_no_farther():
    born = 8
    found = [drive(k, missed=range(born)) for k in range(FRAMES)]
    first = next(k for k, one in enumerate(lagged_reports(found)) if one.sizes["track"])
    assert born - round(reporting.MAX_BACK_S / INTERVAL_S) <= first < born
    for k in range(first, born):
        one = lagged_reports(found)[k]
        assert one.sizes["track"] == 1 and one["status"].values[0] == "coasted"
        np.testing.assert_allclose([one["east_m"][0], one["north_m"][0]], [east(k), 0.0], atol=2.0)
    live = next(k for k, one in enumerate(lagged_reports(found, 0.0)) if one.sizes["track"])
    assert live >= born


def moments_of(found):
    """What is kept of each frame."""
    moments = []
    for state in states(found):
        moments.append(reporting.pending_epoch(moments[-1] if moments else None, state, track.report(state)))
    return moments


@pytest.mark.parametrize("channel", ["pan", "dolp", "all"])
def test_what_is_never_measured_again_is_likelier_false(channel):
    odds, missed = [], 12
    for again in (missed + 1, FRAMES):
        found = [drive(k, missed=range(missed, again)) for k in range(FRAMES)]
        then = reporting.report_candidates(moments_of(found)[missed : missed + 4])
        odds.append(float(read_calibration("existence_smoothed").models[channel].log_odds(then.features)[0]))
    assert odds[0] > odds[1] + 0.5


def test_one_that_leads_back_onto_another_is_not_told_beside_it():
    born = 8
    gap_m = reporting.DUPLICATE_M - 0.5
    found = [seen([(east(k), 0.0), (east(k) + gap_m, 0.0)][: 1 + (k >= born)]) for k in range(12)]
    known = moments_of(found)[born - 1 : born + 3]
    assert (reporting._extrapolate_tracks(known).mean[:, 0] - east(born - 1) < reporting.DUPLICATE_M).all()
    assert len(reporting.report_candidates(known).ident) == 1


def test_nothing_unmeasured_is_told_if_the_design_says_so():
    found = [drive(k, missed=(10, 11)) for k in range(FRAMES)]
    design = DESIGN.replace({"reporting.lag_s": LAG_S, "reporting.coasted": False})
    quiet = list(track.report_epochs(replace(state, design=design) for state in states(found)))
    assert all((one["status"].values == "measured").all() for one in quiet)
    assert any((one["status"].values == "coasted").any() for one in lagged_reports(found))


def test_where_detections_say_nothing_of_themselves_nothing_waits():
    found = [replace(drive(k), log_likelihood_ratio=None) for k in range(FRAMES)]
    waiting = ()
    for state in states(found):
        live = track.report(state)
        waiting, out = track.advance(waiting, state, live)
        assert waiting == () and len(out) == 1 and out[0] is live
