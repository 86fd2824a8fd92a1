"""Custody on hand-made tracks: each number is worked out beside it. Here the definitions are frozen."""

import math

import numpy as np
import pytest

from glintrack import metrics
from tests.metrics.test_tracks import AREA, FAST, STOPPED, tracks, truth


def flight(held, speeds=None, step_s=1.0, visible=None):
    """One vehicle at the origin, under the track of each epoch's number (0 for none)."""
    out = []
    for k, track in enumerate(held):
        rows = [(track, 0.0, 0.0)] if track else []
        speed = FAST if speeds is None else speeds[k]
        seen = None if visible is None else [visible[k]]
        vehicle = truth((1, 0, 0, speed), visible=seen)
        out.append(metrics.score_epoch(tracks(*rows), vehicle, AREA, time_s=k * step_s))
    return out


def test_the_definitions_are_frozen():
    assert (metrics.MOVING_SPEED_M_S, metrics.VISIBLE_FRACTION, metrics.MATCH_DISTANCE_M) == (1.0, 0.25, 5.0)
    vehicles = truth((1, 0, 0, 1.0), (2, 100, -100, 0.99), (3, 100.1, 0, 9.0), visible=[0.25, 0.249, 1.0])
    assert metrics.is_moving(vehicles).tolist() == [True, False, True]
    assert metrics.is_in_area(vehicles, AREA).tolist() == [True, True, False]
    assert metrics.is_visible(vehicles).tolist() == [True, False, True]
    assert metrics.area_km2(AREA) == pytest.approx(0.04)
    assert metrics.HEADLINE == (
        "tracked_per_km2", "completeness", "completeness_visible", "custody", "false_per_km2"
    )  # fmt: skip


def test_custody_counts_the_longest_track_of_all_visible_time():
    """Ten visible epochs: four under track 7, two under 8, three more under 7, one lost: 7/10."""
    broken = flight([7, 7, 7, 7, 8, 8, 7, 7, 7, 0])
    assert metrics.custody(broken) == pytest.approx(0.7)
    assert metrics.summarize(broken)["completeness"] == pytest.approx(0.9)


def test_custody_leaves_hidden_and_stopped_time_out():
    """Hidden at two epochs, stopped at one: five visible epochs are left, three of them under 7."""
    held = flight([7, 7, 7, 7, 7, 0, 0, 7], [FAST] * 7 + [STOPPED], visible=[1, 1, 1, 0.2, 0.2, 1, 1, 1])
    assert metrics.custody(held) == pytest.approx(3 / 5)


def test_broken_tracks_keep_completeness_and_purity_but_not_custody():
    anew = flight(list(range(1, 21)))
    scores = metrics.summarize([e for e in anew for _ in (0, 1)])
    assert scores["completeness"] == 1 and scores["purity"] == 1
    assert metrics.custody(anew) == pytest.approx(1 / 20)


def test_median_time_to_loss_by_the_product_limit():
    """Track 7 from 0 s to its loss at 3 s, track 8 from 4 s to 5 s, track 9 from 6 s to the end, not lost.

    Times 1 s (lost), 3 s (lost), 1 s (kept): S(1) = 2/3, S(3) = 0, so the median is 3 s.
    """
    assert metrics.median_time_to_loss(flight([7, 7, 7, 0, 8, 0, 9, 9])) == 3.0
    assert math.isnan(metrics.median_time_to_loss(flight([7, 7, 7])))  # never lost
    stopped = flight([7, 7, 0], [FAST, FAST, STOPPED])  # it stood: not lost
    assert math.isnan(metrics.median_time_to_loss(stopped))


def test_same_track_after_ten_seconds():
    """At 2 Hz, 24 epochs, track 8 from the 14th on: of the 4 pairs 10 s apart none; with 7 throughout all."""
    assert metrics.same_track_after(flight([7] * 13 + [8] * 11, step_s=0.5)) == 0.0
    assert metrics.same_track_after(flight([7] * 24, step_s=0.5)) == 1.0
    assert metrics.same_track_after(flight([7] * 21 + [8] * 3, step_s=0.5)) == pytest.approx(1 / 4)
    assert math.isnan(metrics.same_track_after(flight([7] * 5)))


@pytest.mark.parametrize(
    ("ids", "share"),
    [
        ([7, 7] + [7] * 10 + [7, 7], 1.0),
        ([7, 7] + [0] * 10 + [7, 7], 1.0),  # no track while it stands
        ([7, 7] + [7] * 10 + [0, 7], 1.0),  # found again a little later
        ([7, 7] + [7] * 10 + [8, 7], 0.0),
        ([7, 7] + [7] * 10 + [0, 0], 0.0),
        ([7, 0] + [7] * 10 + [7, 7], math.nan),  # no track when it stopped
    ],
)
def test_same_track_after_a_stop(ids, share):
    """Two seconds of drive, ten of standing, two of drive."""
    speeds = [FAST] * 2 + [STOPPED] * 10 + [FAST] * 2
    assert metrics.same_track_after_stop(flight(ids, speeds)) == pytest.approx(share, nan_ok=True)
    short = metrics.same_track_after_stop(flight(ids, speeds), stop_s=12.0)
    assert math.isnan(short)


def test_a_hidden_vehicle_does_not_stop():
    ids, speeds = [7] * 14, [FAST] * 14
    assert math.isnan(
        metrics.same_track_after_stop(flight(ids, speeds, visible=[1] * 2 + [0] * 10 + [1] * 2))
    )


def test_idf1_of_the_moving():
    """Vehicle moves 4 epochs: 3 under track 7, 1 under 8; IDTP 3, seen 4, reported 4: 3/4. Parked: out."""
    parked = truth((1, 0, 0, FAST), (2, 50, 0, STOPPED))
    epochs = [
        metrics.score_epoch(tracks((t, 0, 0), (9, 50, 0)), parked, AREA, time_s=float(k))
        for k, t in enumerate([7, 7, 7, 8])
    ]
    assert metrics.idf1_moving(epochs) == pytest.approx(3 / 4)


def test_times_nobody_told_say_nothing_of_time():
    silent = [metrics.score_epoch(tracks((7, 0, 0)), truth((1, 0, 0, FAST)), AREA) for _ in range(3)]
    scores = metrics.summarize(silent)
    assert scores["custody"] == 1.0 and np.isnan(scores["same_track_after_10s"])


def test_a_track_that_is_held_through_a_stop_is_lost_at_its_end():
    """Track 7 drives to 10 s and stands to 40 s; then track 8 takes over, to 60 s and not lost."""
    held, speeds = [7] * 41 + [8] * 20, [FAST] * 11 + [STOPPED] * 30 + [FAST] * 20
    assert metrics.median_time_to_loss(flight(held, speeds)) == pytest.approx(41.0)


@pytest.mark.parametrize("rate_hz", [2.0, 2.7183, 3.333, 12.37])
def test_the_same_track_later_at_any_frame_rate(rate_hz):
    held = flight([7] * int(40 * rate_hz), step_s=1 / rate_hz)
    assert metrics.same_track_after(held) == 1.0
