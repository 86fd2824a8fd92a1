"""The FROC of a flight: its own detections tracked again at each threshold of reporting or initiation."""

import numpy as np
import pytest
import xarray as xr

from glintrack import metrics, track
from glintrack.results.froc import flight_froc
from glintrack.track.files import as_rows
from tests.plain import plain_case

AREA_M = (-200.0, -100.0, 200.0, 100.0)
GRID = track.Grid((200, 400), (-199.5, 99.5), 1.0)
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
        "time_s": t, "vehicle_id": ids, "east_m": -150 + SPEED_M_S * t, "north_m": np.array(LANES_M)[ids],
        "east_speed_m_s": zero + SPEED_M_S, "north_speed_m_s": zero, "visible_fraction": zero + 1,
    }  # fmt: skip
    return xr.Dataset({name: ("row", values) for name, values in columns.items()})


def detections(clutter=0, missed=0.0, seed=0, judged=False):
    """Time and detections of each frame; those of cars speak for one if they are to be judged."""
    rng, cars = np.random.default_rng(seed), truth()
    cars = cars.isel(row=np.flatnonzero(rng.uniform(size=cars.sizes["row"]) >= missed))
    false = rng.uniform(AREA_M[:2], AREA_M[2:], (clutter * len(TIMES_S), 2))
    out = []
    for t in TIMES_S:
        mine = np.flatnonzero(cars["time_s"].values == t)
        place = np.stack([cars["east_m"].values, cars["north_m"].values], axis=1)[mine]
        place = place + 0.3 * rng.standard_normal(place.shape)
        false = rng.uniform(AREA_M[:2], AREA_M[2:], (clutter, 2))
        n, one = len(place) + clutter, 0.36 * np.eye(2)
        ratio = np.r_[np.full(len(place), 3.0), np.full(clutter, -1.0)] if judged else None
        found = track.Detections(
            np.concatenate([place, false]), np.repeat(one[None], n, 0), np.ones(n), np.ones(n),
            log_likelihood_ratio=ratio,
        )  # fmt: skip
        out.append((float(t), found))
    return out


def test_cars_alone_are_tracked_from_confirmation_on():
    swept = flight_froc(plain_case({}), "pan", detections(), truth(), GRID, AREA_M, (6.0,))
    # three hits, a second and eight metres come together at 1 s, in the first frame after learning
    assert swept["completeness"].values == 1.0
    np.testing.assert_array_equal(swept["false_per_frame"].values, 0)
    np.testing.assert_array_equal(swept["purity"].values, 1)


def test_a_higher_threshold_costs_completeness_and_saves_false_tracks():
    swept = flight_froc(plain_case({}), "dolp", detections(CLUTTER, 0.2), truth(), GRID, AREA_M)
    assert swept["threshold"].values.tolist() == sorted(swept["threshold"].values)
    first, last = swept.isel(threshold=0), swept.isel(threshold=-1)
    assert first["false_per_frame"] > last["false_per_frame"]
    assert first["completeness"] > last["completeness"]


def test_the_designs_own_threshold_is_a_point():
    case = plain_case({"track": {"initiation": {"confirm_score": 7.5}}})
    swept = flight_froc(case, "pan", detections(), truth(), GRID, AREA_M, (0.0, 20.0))
    assert swept["threshold"].values.tolist() == [0.0, 7.5, 20.0]
    assert swept.attrs["own"] == 7.5


def test_an_interrupt_in_the_middle_of_a_frame():
    cut = truth().isel(row=slice(0, 3 * 20))  # the truth of a frame comes after its tracks
    swept = flight_froc(plain_case({}), "pan", detections(), cut, GRID, AREA_M, (6.0,))
    assert np.isfinite(swept["completeness"].values).all()


def test_nothing_seen_is_no_curve():
    assert not flight_froc(plain_case({}), "pan", [], truth(), GRID, AREA_M)
    assert not flight_froc(plain_case({}), "pan", detections(), xr.Dataset(), GRID, AREA_M)


def test_where_tracks_are_reported_by_existence_the_flight_as_flown_lies_on_its_curve():
    case = plain_case(
        {"track": {"reporting": {"method": "existence", "lag_s": 0.0}, "query": {"policy": "none"}}}
    )
    found = detections(CLUTTER, 0.2, judged=True)
    swept = flight_froc(case, "pan", found, truth(), GRID, AREA_M)
    assert swept["threshold"].attrs["key"] == "reporting.max_false_share"
    assert (np.diff(swept["false_per_frame"].values) >= 0).all()
    assert swept["false_per_frame"].values[-1] > swept["false_per_frame"].values[0]
    state, reports = track.start(case.track.replace({"detect.channel": "pan"})), []
    for time_s, one in found:
        state = track.step_detections(state, one, time_s, GRID)
        reports.append((time_s, track.report(state)))
    learnt_s = TIMES_S[case.track.count_learning_frames(case.flight.rate_hz)]
    flown = metrics.summarize(metrics.score_epochs(as_rows(reports), truth(), AREA_M, first_s=learnt_s))
    own = swept.sel(threshold=swept.attrs["own"])
    for name in ("completeness", "false_per_frame", "purity"):
        assert float(own[name]) == pytest.approx(flown[name])
