"""Signed change around a peak: closed forms, symmetries, and what separates vehicles; one peak for each."""

import numpy as np
import pytest

from glintrack.track.calibration import read_calibration
from glintrack.track.detect.footprint import footprints, peaks, window_means
from glintrack.track.detect.mosaic_model import ElementPrediction
from glintrack.track.detect.mosaic_peaks import (
    MIN_RATIO,
    SEARCHES,
    select_peaks,
)
from glintrack.track.detect.mosaic_windows import (
    CAR_M,
    FREEDOM,
    WINDOW_FEATURES,
    evidence_on_ground,
    window_features,
)

CELL_M = 0.75
SAME_M, LANE_M = (read_calibration("mosaic").constants["one_vehicle"][name] for name in ("reach_m", "lane_m"))
SHAPE, MIDDLE = (41, 41), (20, 20)
ROW, COLUMN = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)
EXPECTED_E, NOISE_E = 1000.0, 50.0
PAIR = np.array([[0.0, 0.0], [0.0, 4.0]])
QUEUE = np.array([[x, y] for x in np.arange(-36.0, 37.0, 12.0) if x for y in (0.0, 4.0)])


def features_of(*changes, element=(ROW, COLUMN)):
    """Features at the middle by name, for a change of each kind of element, where elements are cells. [e]"""
    change = [np.broadcast_to(np.asarray(one, np.float32), SHAPE) for one in changes]
    fitted = np.zeros((*SHAPE, 5), np.float32)
    fitted[..., 0] = EXPECTED_E
    flat = np.full(SHAPE, NOISE_E**2, np.float32)
    n = len(change)
    z2 = tuple(np.square(one) / flat for one in change)
    seen = ElementPrediction(
        readings=tuple(np.float32(EXPECTED_E) + one for one in change), fitted=(fitted,) * n,
        noise=(flat,) * n, var=(flat,) * n, z2=z2, x=COLUMN, y=ROW, moved_m=(0.0, 0.0),
    )  # fmt: skip
    places = np.zeros((n, 2))
    evidence = evidence_on_ground(z2, places, 1, element)
    found = window_features(np.array([MIDDLE]), evidence, seen, (places, 1, CELL_M), element)
    return dict(zip(WINDOW_FEATURES, found[0], strict=True))


def car(turn=0.0):
    """Cells of a car's size about the middle."""
    x, y = CELL_M * (COLUMN - MIDDLE[1]), CELL_M * (ROW - MIDDLE[0])
    along, across = x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn)
    return (np.abs(along) < CAR_M[0] / 2 + CELL_M) & (np.abs(across) < CAR_M[1] / 2 + CELL_M)


@pytest.mark.parametrize("change_e", [-300.0, 300.0])
def test_a_change_everywhere_is_the_same_in_window_and_ring(change_e):
    found = features_of(change_e, change_e)
    evidence = np.log1p((change_e / NOISE_E) ** 2 / FREEDOM)
    contrast = abs(change_e) / (EXPECTED_E + change_e / 2)
    expected = {
        "evidence": evidence, "signed": np.copysign(evidence, change_e), "contrast": contrast,
        "contrast_root": np.sqrt(contrast), "disagreement": 0.0, "disagreement_root": 0.0,
    }  # fmt: skip
    a_rounded_variance = 1e-3
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, abs=a_rounded_variance, rel=1e-5)
        assert found[f"ring_{name}"] == pytest.approx(value, abs=a_rounded_variance, rel=1e-5)
    assert found["across_root"] == pytest.approx(np.sqrt(evidence))


@pytest.mark.parametrize("turn", [0.0, np.pi / 6, np.pi / 2])
def test_a_car_fills_its_window_and_not_the_ring_in_any_direction(turn):
    found, whole = features_of(400.0 * car(turn)), features_of(400.0)
    assert found["evidence"] == pytest.approx(whole["evidence"])
    assert found["ring_evidence"] < 0.3 * found["evidence"]
    assert found["across_root"] < 0.95 * whole["across_root"]


def test_kinds_that_change_in_opposite_ways_disagree():
    found = features_of(200.0 * car(), -200.0 * car())
    bright, dark = 200 / 1100, -200 / 900
    assert found["signed"] == pytest.approx(0.0, abs=1e-6)
    assert found["contrast"] == pytest.approx(-(bright + dark) / 2, rel=1e-4)
    assert found["disagreement"] == pytest.approx((bright - dark) / 2, rel=1e-4)


def test_unknown_elements_do_not_count():
    element = np.where(ROW > MIDDLE[0], np.nan, ROW), COLUMN
    found, whole = features_of(300.0, element=element), features_of(300.0)
    assert found["contrast"] == pytest.approx(whole["contrast"])
    assert found["ring_contrast"] == pytest.approx(whole["contrast"])


def test_a_peak_at_the_corner_of_the_grid_has_features():
    seen = ElementPrediction(
        *((np.ones((3, 3), np.float32),), (np.ones((3, 3, 5), np.float32),)),
        *((np.ones((3, 3), np.float32),) for _ in range(3)), ROW, COLUMN, (0.0, 0.0),
    )  # fmt: skip
    grid = ROW[:3, :3], COLUMN[:3, :3]
    found = window_features(np.array([[0, 2]]), ROW[:3, :3], seen, (np.zeros((1, 2)), 1, CELL_M), grid)
    assert np.isfinite(found).all()


def test_cars_in_adjacent_lanes_are_two_peaks():
    lane_m, sigma_m = 3.2, (1.6, 0.8)  # of cars blurred by lens and superpixels
    x, y = CELL_M * (COLUMN - MIDDLE[1]), CELL_M * (ROW - MIDDLE[0])
    cars = [np.exp(-0.5 * ((x / sigma_m[0]) ** 2 + ((y - at) / sigma_m[1]) ** 2)) for at in (0, lane_m)]
    search = SEARCHES["all"]
    means = window_means(2.0 * np.maximum(*cars), footprints(*search.window_m, CELL_M))
    found = peaks(means, 0.5, search.apart_m, CELL_M)
    assert np.ptp(found[:, 0]) * CELL_M == pytest.approx(lane_m, abs=CELL_M) and len(found) == 2


def selected(place, ratio, channel="all"):
    """Indices selected of peaks that all move east."""
    return select_peaks(place, np.tile([9.0, 0.0], (len(place), 1)), np.asarray(ratio), channel).tolist()


def test_of_two_near_peaks_in_sparse_traffic_the_likelier_is_selected():
    assert selected(PAIR, [2.0, 3.0]) == [1]
    assert selected(PAIR, [2.0, 3.0], "pan") == [1, 0]


def test_in_dense_traffic_both_are_selected_unless_nearer_than_lanes():
    ratio = np.full(len(QUEUE) + 2, 4.0)
    assert len(selected(np.concatenate([PAIR, QUEUE]), ratio)) == len(QUEUE) + 2
    near = np.concatenate([PAIR * (0.9 * LANE_M / 4.0), QUEUE])
    assert len(selected(near, ratio)) == len(QUEUE) + 1


@pytest.mark.parametrize(("along_m", "count"), [(0.9 * SAME_M, 1), (1.1 * SAME_M, 2)])
def test_front_and_rear_of_a_long_vehicle_are_one_in_any_traffic(along_m, count):
    pair = np.array([[-along_m / 2, 0.0], [along_m / 2, 0.5]])
    assert len(selected(np.concatenate([pair, QUEUE]), np.full(len(QUEUE) + 2, 4.0))) == len(QUEUE) + count


def test_peaks_farther_apart_than_a_vehicle_are_all_selected_by_falling_ratio():
    place = np.array([[0.0, 0.0], [SAME_M + 0.1, 0.0], [0.0, SAME_M + 0.1]])
    assert selected(place, [2.0, 4.0, 3.0]) == [1, 2, 0]


def test_unlikely_peaks_are_left_out():
    assert selected(PAIR, [MIN_RATIO, MIN_RATIO - 1]) == []
    assert selected(np.empty((0, 2)), []) == []
