"""The ROC of a flight: its own detections tracked again at each threshold of initiation."""

import numpy as np
import pytest
import xarray as xr

from glintrack import Case
from glintrack.results.roc import flight_roc

AREA_M = (-200.0, -100.0, 200.0, 100.0)
TIMES_S = 0.5 * np.arange(30)
LANES_M = (-60.0, 0.0, 60.0)
SPEED_M_S = 10.0
CLUTTER = 40  # false detections a frame


def truth():
    """Three cars that drive east, far apart."""
    t = np.repeat(TIMES_S, 3)
    ids = np.tile([0, 1, 2], len(TIMES_S))
    zero = np.zeros(len(t))
    columns = {
        "time_s": t, "vehicle_id": ids, "east": -150 + SPEED_M_S * t, "north": np.array(LANES_M)[ids],
        "east_speed": zero + SPEED_M_S, "north_speed": zero, "visible_fraction": zero + 1,
    }  # fmt: skip
    return xr.Dataset({name: ("row", values) for name, values in columns.items()})


def detections(clutter=0, missed=0.0, seed=0):
    rng, cars = np.random.default_rng(seed), truth()
    cars = cars.isel(row=np.flatnonzero(rng.uniform(size=cars.sizes["row"]) >= missed))
    false = rng.uniform(AREA_M[:2], AREA_M[2:], (clutter * len(TIMES_S), 2))
    t = np.concatenate([cars["time_s"].values, np.repeat(TIMES_S, clutter)])
    order = np.argsort(t, kind="stable")
    noise = 0.3 * rng.standard_normal((cars.sizes["row"], 2))
    place = np.stack([cars["east"].values, cars["north"].values], axis=1) + noise
    place = np.concatenate([place, false])[order]
    one = np.ones(len(t))
    columns = {
        "time_s": t[order], "east": place[:, 0], "north": place[:, 1], "east_var": 0.36 * one,
        "north_var": 0.36 * one, "east_north_cov": 0 * one,
    }  # fmt: skip
    return xr.Dataset({name: ("row", values) for name, values in columns.items()})


def test_cars_alone_are_tracked_from_confirmation_on():
    swept = flight_roc(Case(), "pan", detections(), truth(), AREA_M, (6.0,))
    unconfirmed = 2  # frames before three hits, a second and eight metres, which come together at 1 s
    assert swept["completeness"].values == pytest.approx(1 - unconfirmed / len(TIMES_S))
    np.testing.assert_array_equal(swept["false_per_epoch"].values, 0)
    np.testing.assert_array_equal(swept["purity"].values, 1)


def test_a_higher_threshold_costs_completeness_and_saves_false_tracks():
    swept = flight_roc(Case(), "dolp", detections(CLUTTER, 0.2), truth(), AREA_M)
    assert swept["confirm_score"].values.tolist() == sorted(swept["confirm_score"].values)
    first, last = swept.isel(confirm_score=0), swept.isel(confirm_score=-1)
    assert first["false_per_epoch"] > last["false_per_epoch"]
    assert first["completeness"] > last["completeness"]


def test_the_designs_own_threshold_is_a_point():
    case = Case(track={"initiation": {"confirm_score": 7.5}})
    swept = flight_roc(case, "pan", detections(), truth(), AREA_M, (0.0, 20.0))
    assert swept["confirm_score"].values.tolist() == [0.0, 7.5, 20.0]
    assert swept.attrs["flown_confirm_score"] == 7.5


def test_an_interrupt_in_the_middle_of_a_frame():
    cut = truth().isel(row=slice(0, 3 * 20))  # the truth of a frame comes after its tracks
    swept = flight_roc(Case(), "pan", detections(), cut, AREA_M, (6.0,))
    assert np.isfinite(swept["completeness"].values).all()


def test_nothing_seen_is_no_curve():
    assert not flight_roc(Case(), "pan", xr.Dataset(), truth(), AREA_M)
    assert not flight_roc(Case(), "pan", detections(), xr.Dataset(), AREA_M)
