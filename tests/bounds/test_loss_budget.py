"""Detections against vehicles by hand: owners, false ones, thresholds, and what an oracle tracks."""

import numpy as np
import pytest

from glintrack.bounds.loss_budget import OracleRules, score_detections, threshold, track_by_oracle

VEHICLES = np.array([[0.0, 0.0], [6.0, 0.0], [100.0, 0.0]])
LENGTHS = np.array([4.5, 4.5, 12.0])


def test_each_detection_goes_to_the_nearest_vehicle_in_reach():
    """2.9 m and 3.1 m: the first is vehicle 0's, the second vehicle 1's; 6.9 m off a lorry is its."""
    position = np.array([[2.9, 0.0], [3.1, 0.0], [106.9, 0.0], [50.0, 0.0], [0.0, 4.5]])
    scored = score_detections(position, np.array([5.0, 7.0, 3.0, 9.0, 8.0]), VEHICLES, LENGTHS)
    assert scored.vehicle.tolist() == [5.0, 7.0, 3.0]
    assert scored.false.tolist() == [9.0]  # 4.5 m off a car is neither its nor false


def test_nothing_found_and_nothing_there():
    assert np.isneginf(score_detections(np.empty((0, 2)), np.empty(0), VEHICLES, LENGTHS).vehicle).all()
    scored = score_detections(np.zeros((1, 2)), np.ones(1), np.empty((0, 2)), np.empty(0))
    assert scored.false.tolist() == [1.0]


def test_threshold_leaves_the_number_allowed():
    """Two frames with 3 and 2 false ones; one a frame are two in all, above the third score, 5."""
    false = [np.array([9.0, 5.0, 1.0]), np.array([7.0, 3.0])]
    least = threshold(false, 1.0)
    assert least == (5.0, 0.0)
    assert least.count(np.array([9.0, 5.0, 4.0, -np.inf])).tolist() == [1.0, 0.0, 0.0, 0.0]
    assert threshold(false, 10.0) == (-np.inf, 0.0)
    with pytest.raises(ValueError, match="`false_per_frame` must be greater than 0; got 0"):
        threshold(false, 0.0)


def test_of_detections_that_tie_a_part_counts():
    """One above and four capped false ones; one a frame are two in all: a quarter of the ties."""
    false = [np.array([3.0, 2.0, 2.0]), np.array([2.0, 2.0, 1.0])]
    least = threshold(false, 1.0)
    assert least == (2.0, 0.25)
    assert sum(least.count(frame).sum() for frame in false) == 2.0
    assert least.count(np.array([3.0, 2.0, 1.0])).tolist() == [1.0, 0.25, 0.0]


def test_an_oracle_confirms_three_of_five_and_coasts_two_seconds():
    """2 Hz: hits at frames 0, 2, 4 confirm at 4 (2 s old); last hit 4, held to 8 (2 s on), lost at 9."""
    score = np.where([1, 0, 1, 0, 1, 0, 0, 0, 0, 0, 1], 1.0, -np.inf)
    held = track_by_oracle(score, 0.5 * np.arange(11), OracleRules(3, 5, 1.0, np.inf, 2.0, 0.0))
    assert held.tolist() == [False] * 4 + [True] * 5 + [False] * 2


def test_an_oracle_needs_the_least_age():
    held = track_by_oracle(np.ones(5), 0.1 * np.arange(5), OracleRules(3, 5, 0.25, np.inf, 2.0, 0.0))
    assert held.tolist() == [False, False, False, True, True]


def test_a_single_detection_with_a_high_score_confirms():
    score = np.array([1.0, -np.inf, 3.0, -np.inf, -np.inf, -np.inf])
    held = track_by_oracle(score, np.arange(6.0), OracleRules(3, 5, 1.0, 3.0, 2.0, 0.0))
    assert held.tolist() == [False, False, True, True, True, False]


def test_with_a_lag_a_vehicle_is_held_if_it_is_held_soon_after():
    score = np.array([-np.inf] * 4 + [3.0] + [-np.inf] * 3)
    held = track_by_oracle(score, 0.5 * np.arange(8), OracleRules(3, 5, 1.0, 3.0, 0.5, 1.0))
    assert held.tolist() == [False, False, True, True, True, True, False, False]
