"""Eqs. (13) and (14) on hand-made tracks; every expected number is worked out beside it."""

import itertools
import math

import numpy as np
import pytest
import shapely
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from glintrack import metrics
from glintrack.metrics.tracks import connected_components

AREA = (-100.0, -100.0, 100.0, 100.0)
FAST, STOPPED = 10.0, 0.0


def tracks(*rows):
    """Dataset of tracks from (id, east, north[, status])."""
    rows = [(*row, "measured")[:4] for row in rows]
    ids = [row[0] for row in rows]
    zero = np.zeros(len(rows))
    columns = {
        "east_m": ([r[1] for r in rows], "m"),
        "north_m": ([r[2] for r in rows], "m"),
        "east_speed_m_s": (zero, "m s-1"),
        "north_speed_m_s": (zero, "m s-1"),
        "east_var_m2": (zero + 1, "m2"),
        "north_var_m2": (zero + 1, "m2"),
        "status": (np.array([r[3] for r in rows], str), "1"),
    }
    return xr.Dataset(
        {k: ("track", np.asarray(v), {"units": u}) for k, (v, u) in columns.items()},
        coords={"track": np.asarray(ids, np.int64)},
    )


def truth(*rows, visible=None):
    """Dataset of vehicles from (id, east, north, speed)."""
    zero = np.zeros(len(rows))
    columns = {
        "east_m": ([r[1] for r in rows], "m"),
        "north_m": ([r[2] for r in rows], "m"),
        "up_m": (zero, "m"),
        "east_speed_m_s": ([r[3] for r in rows], "m s-1"),
        "north_speed_m_s": (zero, "m s-1"),
        "heading_rad": (zero, "rad"),
        "length_m": (zero + 4.5, "m"),
        "width_m": (zero + 1.8, "m"),
        "height_m": (zero + 1.5, "m"),
    }
    if visible is not None:
        columns["visible_fraction"] = (visible, "1")
    return xr.Dataset(
        {k: ("vehicle", np.asarray(v, float), {"units": u}) for k, (v, u) in columns.items()},
        coords={"vehicle": np.asarray([r[0] for r in rows], np.int64)},
    )


def score(tracks_now, truth_now):
    return metrics.score_epoch(tracks_now, truth_now, AREA)


def test_eq13_counts_moving_vehicles_inside_the_area():
    """Five vehicles: 1, 2 should be tracked; 3 is stopped, 4 outside. Track 7 is on 1 only: 1/2."""
    e = score(
        tracks((7, 1.0, 0.0)),
        truth((1, 0, 0, FAST), (2, 50, 0, FAST), (3, 0, 50, STOPPED), (4, 150, 0, FAST)),
    )
    assert e.completeness() == 0.5
    assert e.completeness("all") == pytest.approx(1 / 3)  # vehicle 4 is outside
    np.testing.assert_array_equal(metrics.completeness([e, e]), [0.5, 0.5])


def test_slowest_moving_vehicle_and_edge_of_area_count():
    e = score(tracks(), truth((1, 100, 100, 1.0), (2, 0, 0, 0.999)))
    assert e.should.tolist() == [True, False]


def test_occluded_vehicles_count_in_the_primary_figure_only():
    e = score(tracks((7, 0.0, 0.0)), truth((1, 0, 0, FAST), (2, 50, 0, FAST), visible=[0.25, 0.2]))
    assert e.completeness() == 0.5
    assert e.completeness("visible") == 1.0


def test_coasted_track_is_valid():
    e = score(tracks((7, 4.9, 0.0, "coasted")), truth((1, 0, 0, FAST)))
    assert e.valid.all() and e.completeness() == 1.0


def test_match_ends_at_five_metres():
    assert score(tracks((7, 5.0, 0.0)), truth((1, 0, 0, FAST))).valid.tolist() == [True]
    beyond = score(tracks((7, 5.0001, 0.0)), truth((1, 0, 0, FAST)))
    assert beyond.false.tolist() == [True] and beyond.completeness() == 0.0


@pytest.mark.parametrize("vehicle", [(1, 0, 0, STOPPED), (1, 102, 0, FAST)])
def test_track_of_a_stopped_or_outside_vehicle_is_neither(vehicle):
    """Matched, or unmatched within 5 m of it; farther off it is false."""
    on_it = score(tracks((7, vehicle[1] + 1.0, 0.0)), truth(vehicle))
    beside = score(tracks((7, vehicle[1] - 1.0, 0.0), (8, vehicle[1] - 5.0, 0.0)), truth(vehicle))
    for e in (on_it, beside):
        assert not e.valid.any() and not e.false.any()
        assert math.isnan(e.completeness())
    far_off = score(tracks((7, vehicle[1] - 5.001, 0.0)), truth(vehicle))
    assert far_off.false.all() and not far_off.valid.any()


def test_a_stopped_vehicle_far_off_excuses_nothing():
    """The nearest vehicle is stopped, 30 m away; the track is false all the same."""
    e = score(tracks((7, 0.0, 0.0)), truth((1, 30, 0, STOPPED), (2, 60, 0, FAST)))
    assert e.false.tolist() == [True]


def test_two_tracks_on_one_vehicle_make_one_valid_and_one_false():
    e = score(tracks((7, 1.0, 0.0), (8, 0.5, 0.0)), truth((1, 0, 0, FAST)))
    assert e.valid.tolist() == [False, True] and e.false.tolist() == [True, False]
    assert e.matched_track.tolist() == [8]


def test_least_total_distance_among_the_most_pairs():
    """Track 7 is nearest to vehicle 1 (1 m), yet 7→2 (3 m), 8→1 (2 m) pairs both."""
    e = score(tracks((7, 1, 0), (8, -2, 0)), truth((1, 0, 0, FAST), (2, 4, 0, FAST)))
    assert e.matched_vehicle.tolist() == [2, 1]


def test_track_on_a_stopped_vehicle_is_not_lent_to_one_that_passes():
    """The moving vehicle 2 passes 3 m away, untracked: it has no valid track."""
    e = score(tracks((7, 0.2, 0.0)), truth((1, 0, 0, STOPPED), (2, 3, 0, FAST)))
    assert e.completeness() == 0.0 and not e.false.any()


def test_false_without_any_vehicle():
    e = score(tracks((7, 0, 0)), truth())
    assert e.false.all() and math.isnan(e.completeness())
    assert math.isnan(metrics.purity([e]))


def test_eq14_switch_at_mid_time():
    """Track 7 follows vehicle 1 for 6 epochs, then 2 for 4; track 8 the reverse.

    Purity of each 6/10; vehicle 1 has 7, vehicle 2 has 8: aggregate 0.6; two switches.
    """
    epochs = []
    for k in range(10):
        a, b = (0.0, 50.0) if k < 6 else (50.0, 0.0)
        epochs.append(score(tracks((7, a, 0), (8, b, 0)), truth((1, 0, 0, FAST), (2, 50, 0, FAST))))
    assert metrics.purity(epochs) == pytest.approx(0.6)
    assert metrics.identity_switches(epochs) == 2
    running = metrics.running_purity(epochs)  # whole until the switch; of 8 epochs 6 are right
    np.testing.assert_allclose(running[[1, 5, 7, 9]], [1, 1, 6 / 8, 0.6])
    assert np.isnan(running[0])


def test_eq14_weights_a_vehicles_tracks_by_epochs():
    """Vehicle 1: track 7 matched 8 epochs, all on 1; track 8 matched 4, three on 1: (8 + 3)/(8 + 4).

    Vehicle 2: track 9, two epochs, both on 2: 1. Track 10, one epoch only, does not count.
    Mean over vehicles: (11/12 + 1)/2.
    """
    epochs = []
    for k in range(12):
        rows = [(7, 0, 0)] if k < 8 else [(8, 0, 0)] if k < 11 else [(8, 50, 0)]
        rows += [(9, 50, 0)] if k < 2 else []
        rows += [(10, 50.0, 0)] if k == 5 else []
        epochs.append(score(tracks(*rows), truth((1, 0, 0, FAST), (2, 50, 0, FAST))))
    assert metrics.vehicle_purity(epochs) == {1: pytest.approx(11 / 12), 2: 1.0}
    assert metrics.purity(epochs) == pytest.approx((11 / 12 + 1) / 2)


def test_purity_counts_epochs_at_a_red_light():
    """Matched three epochs moving and one stopped: one vehicle, purity 1 over four epochs."""
    epochs = [score(tracks((7, 0, 0)), truth((1, 0, 0, v))) for v in (FAST, FAST, STOPPED, FAST)]
    assert np.isnan(metrics.completeness(epochs)).tolist() == [False, False, True, False]


def test_summary_of_nothing_is_nan():
    summary = metrics.summarize([])
    assert math.isnan(summary["completeness"]) and math.isnan(summary["purity"])
    assert summary["identity_switches"] == 0


def test_summary():
    epochs = [
        score(tracks((7, 0, 0), (9, 60, 60)), truth((1, 3, 0, FAST), (2, 50, 0, FAST))),
        score(tracks((7, 0, 0), (8, 50, 0)), truth((1, 0, 3, FAST), (2, 50, 0, FAST))),
    ]
    s = metrics.summarize(epochs)
    assert s["completeness"] == pytest.approx(0.75)
    assert s["false_per_frame"] == 0.5 and s["tracks_per_frame"] == 2
    assert s["false_per_km2"] == pytest.approx(0.5 / 0.04)  # of a window of 200 m × 200 m
    assert s["tracked_per_km2"] == pytest.approx(1.5 / 0.04)
    assert set(metrics.HEADLINE) <= set(s)
    assert s["position_rms_m"] == pytest.approx(math.sqrt((9 + 9 + 0) / 3))


@given(st.integers(1, 4), st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_match_equals_exhaustive_search(rows, columns, seed):
    distance = np.random.default_rng(seed).uniform(0, 10, (rows, columns))
    limit, best = 5.0, (0, 0.0)
    for size in range(1, min(rows, columns) + 1):
        for chosen in itertools.combinations(range(rows), size):
            for partners in itertools.permutations(range(columns), size):
                d = distance[list(chosen), list(partners)]
                if (d <= limit).all():
                    best = max(best, (size, -d.sum()))
    near = np.argwhere(distance <= limit)
    chosen = near[metrics.match(near, distance[tuple(near.T)], limit)]
    assert all(len(set(side)) == len(chosen) for side in chosen.T.tolist())
    assert len(chosen) == best[0]
    assert distance[tuple(chosen.T)].sum() == pytest.approx(-best[1])


@given(st.integers(0, 60), st.integers(0, 60), st.integers(0, 2**32 - 1))
def test_groups_one_by_one_match_as_all_together_do(tracks, vehicles, seed):
    rng = np.random.default_rng(seed)
    near, distance = metrics.near_pairs(
        rng.uniform(0, 60, (tracks, 2)), rng.uniform(0, 60, (vehicles, 2)), 5.0
    )
    cost = np.full((tracks, vehicles), 1000.0)  # one pair more outweighs any distance
    cost[tuple(near.T)] = distance
    pairs = np.stack(linear_sum_assignment(cost), axis=1)
    together = pairs[cost[tuple(pairs.T)] < 1000.0]
    assert near[metrics.match(near, distance, 5.0)].tolist() == together.tolist()


@given(st.integers(0, 30), st.integers(0, 30), st.integers(0, 2**32 - 1))
def test_near_pairs_are_those_of_the_whole_matrix(tracks, vehicles, seed):
    rng = np.random.default_rng(seed)
    t, v = rng.integers(0, 8, (tracks, 2)) * 1.5, rng.integers(0, 8, (vehicles, 2)) * 1.5  # some right on 3 m
    distance = np.hypot(*(t[:, None] - v[None]).transpose(2, 0, 1))
    near, found = metrics.near_pairs(t, v, 3.0)
    assert near.tolist() == np.argwhere(distance <= 3.0).tolist()
    np.testing.assert_array_equal(found, distance[distance <= 3.0])


def test_errors_name_what_came():
    good = truth((1, 0, 0, FAST))
    with pytest.raises(ValueError, match=r"`area_m` must be \(west, south, east, north\)"):
        metrics.score_epoch(tracks(), good, (1, 0, -1, 2))
    with pytest.raises(ValueError, match="`track` must hold each id once; got 1 repeated"):
        score(tracks((7, 0, 0), (7, 1, 0)), good)
    with pytest.raises(ValueError, match=r"`truth.east_m` must be present"):
        score(tracks(), good.drop_vars("east_m"))
    with pytest.raises(ValueError, match="`over` must be"):
        score(tracks(), good).completeness("some")


def test_pairs_that_share_ends_are_one_group():
    left, right = np.array([0, 3, 0, 1, 5, 3]), np.array([2, 0, 1, 2, 4, 0])
    groups = {tuple(group) for group in connected_components(left, right)}
    assert groups == {(0, 2, 3), (1, 5), (4,)}
    assert connected_components(np.zeros(0, int), np.zeros(0, int)) == []


def test_a_polygon_scores_as_its_rectangle_but_leaves_out_tracks_beyond_it():
    """Two vehicles inside, one outside; a false track inside, one far outside."""
    cars = truth((1, 0, 0, FAST), (2, 50, 0, FAST), (3, 150, 0, FAST))
    found = tracks((7, 1, 0), (8, 150, 1), (9, -50, 50), (10, -150, 50))
    of_rectangle = metrics.score_epoch(found, cars, AREA)
    of_polygon = metrics.score_epoch(found, cars, shapely.box(*AREA))
    for name in ("should", "inside", "matched_track", "valid"):
        np.testing.assert_array_equal(getattr(of_polygon, name), getattr(of_rectangle, name))
    assert of_polygon.area_km2 == pytest.approx(of_rectangle.area_km2) == pytest.approx(0.04)
    assert of_rectangle.false.tolist() == [False, False, True, True]
    assert of_polygon.false.tolist() == [False, False, True, False]


def test_tables_are_scored_with_the_area_of_each_epoch():
    """The area moves over two standing places: each is inside in one of the two epochs."""
    rows = {"time_s": [0.0, 0.0, 1.0, 1.0], "vehicle_id": [1, 2, 1, 2], "east_m": [0.0, 50.0, 0.0, 50.0]}
    rows |= {"north_m": [0.0] * 4, "east_speed_m_s": [9.0] * 4, "north_speed_m_s": [0.0] * 4}
    table = xr.Dataset({name: ("row", np.array(values)) for name, values in rows.items()})
    areas = {0.0: shapely.box(-9, -9, 9, 9), 1.0: shapely.box(41, -9, 59, 9)}
    first, second = metrics.score_epochs(xr.Dataset(), table, areas.__getitem__)
    assert first.inside.tolist() == [True, False] and second.inside.tolist() == [False, True]
    (late,) = metrics.score_epochs(xr.Dataset(), table, areas.__getitem__, first_s=0.5)
    assert late.time_s == 1.0
    marked = table.assign(inside=("row", [True, False, False, True]))
    assert [one.inside.tolist() for one in metrics.score_epochs(xr.Dataset(), marked)] == [
        [True, False], [False, True]
    ]  # fmt: skip
