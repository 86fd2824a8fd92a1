"""Candidates of straight motions: places told back, a fourth frame, shadows, what may be left out."""

from dataclasses import replace

import numpy as np
import pytest

from glintrack.track.detect import straight_candidates as candidates_of
from glintrack.track.detect.straight_candidates import StraightCandidates, find_candidates, select_candidates

SIDE, INTERVAL_S, FASTEST_M_S = 80, 0.8, 36.0
ROWS, COLUMNS = np.mgrid[:SIDE, :SIDE].astype(np.float32)


def hill(row, column, height=4.0):
    """Strength about a vehicle: smooth, some pixels wide."""
    return height * np.exp(-0.5 * ((ROWS - row) ** 2 + (COLUMNS - column) ** 2) / 1.5**2).astype(np.float32)


def layers(places, height=4.0):
    """One that moved through places, the latest first, and no dark ones."""
    return [
        [hill(row, column, height) for row, column in places],
        [np.zeros((SIDE, SIDE), np.float32)] * len(places),
    ]


def ages(count):
    return [INTERVAL_S * k for k in range(1, count + 1)]


@pytest.mark.parametrize("count", [2, 3])
def test_places_before_are_those_where_it_was(count):
    """Steps of fractions of a pixel that are not quite equal: each place is told as it was."""
    way = [(40.3, 50.2), (38.1, 44.6), (36.2, 38.7), (33.7, 33.1)][: count + 1]
    found = find_candidates(layers(way), ages(count), 1.0, FASTEST_M_S)
    assert len(found) == 1
    a_quarter_of_a_pixel = 0.25  # of a centroid cut at two pixels
    assert np.abs(found.place[0] - way[0]).max() < a_quarter_of_a_pixel
    assert np.abs(found.before[0, :count] - way[1:]).max() < a_quarter_of_a_pixel
    assert np.isnan(found.before[0, count:]).all()
    velocity = (np.array(way[0]) - way[2]) / (2 * INTERVAL_S)
    assert np.abs(found.velocity[0] - velocity).max() < 2 * a_quarter_of_a_pixel / INTERVAL_S


def test_a_fourth_frame_speaks_for_a_vehicle_or_against_it():
    way = [(40.0, 60.0 - 6 * k) for k in range(4)]
    three = find_candidates(layers(way[:3], 1.8), ages(2), 1.0, FASTEST_M_S)
    there = find_candidates(layers(way, 1.8), ages(3), 1.0, FASTEST_M_S)
    gone = [[*layers(way[:3], 1.8)[0], np.zeros((SIDE, SIDE), np.float32)], [np.zeros((SIDE, SIDE))] * 4]
    not_there = find_candidates(gone, ages(3), 1.0, FASTEST_M_S)
    assert not_there.ratio[0] < three.ratio[0] < there.ratio[0]
    assert np.isnan(not_there.before[0, 2]).all()


def test_one_that_came_onto_the_frame_is_judged_by_three():
    way = [(40.0, 14.0 - 6 * k) for k in range(4)]  # column -4 in the fourth
    found = find_candidates(layers(way), ages(3), 1.0, FASTEST_M_S)
    assert np.isnan(found.fourth).all()
    assert found.ratio == pytest.approx(find_candidates(layers(way[:3]), ages(2), 1.0, FASTEST_M_S).ratio)


def test_no_peak_that_is_left_out_could_have_counted():
    """With all that the past can show, a peak at the limit reaches the least ratio and no more."""
    least = candidates_of._min_strength()
    one = some([(0.0, 0.0)], [True], weakest=least, now=least, fourth=candidates_of.MAX_FOURTH * least)
    for mine in (one, replace(one, fourth=np.array([np.nan]))):
        assert mine.ratio[0] <= candidates_of.MIN_RATIO + 1e-9


def some(places, bright, weakest=3.0, now=3.0, fourth=np.nan):
    n = len(places)
    none = np.zeros((n, 2))
    return StraightCandidates(
        place=np.array(places, float),
        before=np.full((n, 3, 2), np.nan),
        velocity=none,
        weakest=np.full(n, weakest),
        now=now + np.arange(n)[::-1] * 0.01,
        still=np.zeros(n),
        fourth=np.full(n, fourth),
        bright=np.array(bright),
    )


def test_a_shadow_goes_and_neighbours_stay():
    """Four metres apart: bright and dark are a car and its shadow, the likelier stays; two bright are two."""
    pair = [(20.0, 20.0), (20.0, 24.0)]
    assert len(select_candidates(some(pair, [True, False]), 9, 1.0)) == 1
    assert select_candidates(some(pair, [True, False]), 9, 1.0).bright.tolist() == [True]
    assert len(select_candidates(some(pair, [True, True]), 9, 1.0)) == 2
    assert len(select_candidates(some(pair, [True, False]), 9, 2.0)) == 2  # eight metres
    assert len(select_candidates(some(pair, [True, True]), 1, 1.0)) == 1
    assert len(select_candidates(some([], []), 9, 1.0)) == 0
