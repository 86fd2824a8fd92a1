"""What elements say of a vehicle's place: a smooth blob in closed form, and a car in a flight."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from glintrack import Case, simulate
from glintrack.atmosphere import solve_tables
from glintrack.bounds.accuracy import FrameTracking, FrameTruth, flight_accuracy
from glintrack.bounds.ideal_observer import assign_elements
from glintrack.bounds.loss_budget import FrameBudget
from glintrack.bounds.position import STEP_M, position_information
from glintrack.bounds.run import FlightBudget, measure_bounds
from glintrack.render import unpack_sky
from glintrack.results.verdict import accuracy_lines, format_accuracy
from glintrack.sensor import build_sensor
from tests.bounds.test_run import case
from tests.plain import plain_sensor

HECTARE = (-50.0, -50.0, 50.0, 50.0)


def test_a_smooth_blob_says_what_the_closed_form_says():
    """μ = B + A exp(−r²/2s²) in elements of pitch p: I = π A²/(2 p² (B + σ²)) each way, for A ≪ B."""
    design = plain_sensor(rows=80, columns=80)
    sensor = build_sensor(design, unpack_sky(solve_tables(Case().atmosphere), 1928.0).wavelength_um)
    pitch_m, width_m, high, ground = 0.75, 2.25, 600.0, 9000.0
    row, column = np.mgrid[:80, :80]

    def blob(east_m=0.0, north_m=0.0):
        x, y = (column - 40) * pitch_m - east_m, (40 - row) * pitch_m - north_m
        return ground + high * np.exp(-(x**2 + y**2) / (2 * width_m**2))

    on = np.where(np.hypot(row - 40, column - 40) < 6, 7, -1)
    frames = [blob(), blob(STEP_M), blob(0.0, STEP_M)]
    found = position_information("all", frames, assign_elements(on), np.array([7]), sensor)[0]
    expected = np.pi * high**2 / (2 * pitch_m**2 * (ground + sensor.design.dark_noise_e**2))
    missed = 0.05  # what changes by less than 5 % of the noise is not counted, and the step is no derivative
    np.testing.assert_allclose(np.diag(found), expected, rtol=missed)
    assert abs(found[0, 1]) < 0.02 * expected
    pan = position_information("pan", frames, assign_elements(on), np.array([7]), sensor)[0]
    np.testing.assert_allclose(pan, found / 4, rtol=0.1, atol=0.02 * expected)  # one element in four


def flight(track_offset_m=(0.3, 0.0), frames=12):
    """One vehicle driving east at 10 m/s, seen, measured once, detected with errors, and tracked."""
    rng, times = np.random.default_rng(4), 0.5 * np.arange(frames)
    one = {"length_m": np.array([4.5]), "vehicle_id": np.array([3])}
    sightings, turns = [], []
    for t in times:
        place = np.array([[10.0 * t, 5.0]])
        sightings.append(
            FrameTruth(
                float(t), np.array([0.0, -2000.0]), HECTARE, np.array([3]), place, np.array([np.pi / 2]),
                np.array([0.5]), np.array([True]), np.array([4.5]),
            )
        )  # fmt: skip
        offset = rng.standard_normal((1, 2)) * [1.5, 0.5]
        turns.append(
            FrameTracking(np.array([3]), offset, np.empty((0, 2)), np.array([8]), place + track_offset_m)
        )
    along, across = 400.0, 100.0  # were it wholly visible: in this heading east and north
    told = 0.5 * np.diag([along, across])[None]
    frame = FrameBudget(4, float(times[4]), 1, 1, one, np.ones(1), np.ones(1), told)
    return sightings, [frame], turns


def test_a_vehicle_that_is_half_seen_says_half_and_the_tracks_error_is_not_gated():
    sightings, frames, turns = flight((0.3, 0.4))
    moved = [t._replace(position=t.position + [50.0 * (k == 11), 0.0]) for k, t in enumerate(turns)]
    found = flight_accuracy(sightings, frames, moved)
    assert found["vehicle"].values.tolist() == [3]
    first = 2 / 400 + 2 / 100  # variances of the first frame, which knows no more
    latest = found["position_bound_sensor"].item() ** 2
    assert 0.5 * first < latest < first
    errors = found["position_error_tracker"].item() ** 2
    assert errors == pytest.approx((11 * 0.25 + 50.3**2 + 0.4**2) / 12)
    assert found.attrs["position_error_tracker_median_m"] == pytest.approx(0.5)
    assert found.attrs["detection_probability"] == 1.0 and found.attrs["information_reduction"] == 1.0
    assert found.attrs["detection_sigma_away_m"] == pytest.approx(1.5, rel=0.5)


def test_without_a_loop_the_sensors_bound_stands_alone():
    sightings, frames, _ = flight()
    found = flight_accuracy(sightings, frames)
    assert list(found.data_vars) == ["position_bound_sensor"]
    assert format_accuracy(found.attrs).startswith(
        "median position error of visible moving vehicles: lower bound from sensor noise 0."
    )
    assert "tracker" not in format_accuracy(found.attrs)
    assert format_accuracy({}) == "median position error of visible moving vehicles: not measured"
    tree = xr.DataTree.from_dict({"/bound/pan": found, "/bound/all": xr.Dataset()})
    assert list(accuracy_lines(tree)) == ["pan"]


def test_of_many_that_come_and_go_each_is_bounded_as_if_alone():
    """150 vehicles, of which some four are there at a time: they are bounded together, window by window."""
    rng, sightings, frames = np.random.default_rng(5), [], []
    for k in range(600):
        ids = np.arange(max(0, k // 4 - 3), min(k // 4 + 1, 150))
        place = np.stack([10.0 * (0.5 * k - 2.0 * ids), 3.0 * ids], axis=1)
        sightings.append(
            FrameTruth(
                0.5 * k, np.array([0.0, -2000.0]), HECTARE, 1000 - ids, place, ids / 10.0,
                rng.uniform(0.1, 1, len(ids)), rng.random(len(ids)) < 0.9, np.full(len(ids), 4.5),
            )
        )  # fmt: skip
        if k % 4 == 2:
            rows = {"vehicle_id": 1000 - ids}
            told = np.broadcast_to(np.diag([400.0, 100.0]), (len(ids), 2, 2))
            frames.append(FrameBudget(k, 0.5 * k, 1, 1, rows, np.ones(len(ids)), np.ones(len(ids)), told))
    found = flight_accuracy(sightings, frames)
    assert found.sizes["vehicle"] > 140
    for one in found["vehicle"].values[::13].tolist():
        own = [replace(s, counted=s.counted & (s.vehicle == one)) for s in sightings]
        alone = flight_accuracy(own, frames)
        assert alone["vehicle"].values.tolist() == [one]
        assert float(alone["position_bound_sensor"][0]) == float(
            found["position_bound_sensor"].sel(vehicle=one)
        )


def test_detections_where_nothing_drives_are_all_false():
    nothing = np.empty((0, 2))
    bare = FrameTruth(0.0, np.zeros(2), HECTARE, *(np.empty(0, int), nothing), *[np.empty(0)] * 2,
                    np.empty(0, bool), np.empty(0))  # fmt: skip
    tracks = xr.Dataset({"east_m": ("track", []), "north_m": ("track", [])}, coords={"track": []})
    made = FrameTracking.of(bare, np.array([[1.0, 2.0], [3.0, 4.0]]), tracks)
    assert len(made.found) == len(made.offset) == 0 and len(made.false) == 2


def test_three_cars_are_placed_to_centimetres_by_the_light_and_worse_by_detections(three_cars):
    design = case(bound={"every": 4}, flight={"off_nadir_deg": 0.0, "altitude_m": 3000.0, "frames": 13})
    steps = FlightBudget(design)
    one = steps.budgets(simulate(design, steps.measure))["pan"]
    assert set(one["vehicle"].values) == {11, 22, 33}
    sensor, detector = one["position_bound_sensor"].values, one["position_bound_detector"].values
    assert (sensor < 0.1).all() and (sensor > 1e-4).all()
    assert sensor.max() < 1.5 * sensor.min()  # alike but for where their edges lie among the elements
    assert (sensor < detector).all() and (one["position_error_tracker"].values < 3 * detector).all()
    alone = measure_bounds(design)["pan"]
    np.testing.assert_allclose(alone["position_bound_sensor"], sensor)


def test_frames_that_were_not_measured_do_not_dilute_the_information():
    sightings, (frame,), _ = flight()
    others = [replace(frame, time_s=s.time_s, information=np.nan * frame.information) for s in sightings]
    all_of_them = [frame if k == 4 else other for k, other in enumerate(others)]
    found = flight_accuracy(sightings, all_of_them)["position_bound_sensor"].item()
    assert found == flight_accuracy(sightings, [frame])["position_bound_sensor"].item()
