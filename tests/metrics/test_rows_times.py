"""Tracks and truth at different rates are scored at their common times."""

import numpy as np
import pytest
import xarray as xr

from glintrack import score
from glintrack.metrics import score_rows


def table(times, name, count=2):
    time_s, k = (grid.ravel() for grid in np.meshgrid(times, np.arange(count), indexing="ij"))
    columns = {"time_s": time_s, name: k, "east_m": 5.0 * time_s, "north_m": 20.0 * k}
    columns |= {"east_speed_m_s": np.full(len(k), 5.0), "north_speed_m_s": np.zeros(len(k))}
    return xr.Dataset({key: ("row", values) for key, values in columns.items()})


@pytest.mark.parametrize(
    ("tracks_s", "truth_s", "warning"),
    [
        (np.arange(21) / 2, np.arange(101) / 10, r"one in 5 of the truth's 101 times: scored at 21"),
        (np.arange(101) / 10, np.arange(21) / 2, r"101 times, 80 of which are not the truth's"),
        (np.arange(31) / 3, np.arange(101) / 10, r"one in 10 of the truth's 101 times: scored at 11"),
    ],
)
def test_perfect_tracks_at_another_rate_are_complete(tracks_s, truth_s, warning):
    with pytest.warns(UserWarning, match=warning):
        scores = score_rows(table(tracks_s, "track_id"), table(truth_s, "vehicle_id"))
    assert scores["completeness"] == 1 and scores["purity"] == 1


def test_epochs_without_tracks_count_at_the_same_rate(recwarn):
    times = np.arange(20) / 2
    some = table(times[[3, 4, 5, 7, 8, 9, 12, 13, 14, 15]], "track_id")
    scores = score_rows(some, table(times, "vehicle_id"))
    assert scores["completeness"] == pytest.approx(0.5) and not recwarn.list


def test_a_track_beyond_the_box_on_a_vehicle_at_its_edge_counts():
    """54 of 60 vehicle positions are tracked, without a false track: MOTA = 1 − 6/60."""
    truth = table(np.arange(20) / 2, "vehicle_id", 3)
    tracks = truth.rename(vehicle_id="track_id").isel(row=np.arange(60) % 10 > 0)
    off = tracks.assign(north_m=tracks["north_m"] + np.where(tracks["track_id"] == 0, -1.2, 0.2))
    scores = score_rows(off, truth)
    assert scores["mota"] == pytest.approx(0.9) and scores["completeness"] == pytest.approx(0.9)


def still(places, name, speed=0.0, times=10):
    """The same places at each time."""
    time_s, k = (
        grid.ravel() for grid in np.meshgrid(np.arange(times) / 2, np.arange(len(places)), indexing="ij")
    )
    east, north = np.asarray(places, float)[k].T
    columns = {"time_s": time_s, name: k, "east_m": east, "north_m": north}
    columns |= {"east_speed_m_s": np.full(len(k), speed), "north_speed_m_s": np.zeros(len(k))}
    return xr.Dataset({key: ("row", values) for key, values in columns.items()})


@pytest.mark.parametrize("speed", [0.0, 5.0])
def test_tracks_just_beyond_the_outermost_vehicles_are_on_them(speed):
    corners = np.array([[0, 0], [0, 90], [90, 0], [90, 90]], float)
    outward = corners + 0.5 * np.sign(corners - 45)
    scores = score_rows(still(outward, "track_id"), still(corners, "vehicle_id", speed))
    assert scores["mota"] == scores["idf1"] == 1
    assert scores["ospa_m"] == pytest.approx(0.5**0.5)


def test_tracks_outside_a_users_area_are_not_false():
    car, clutter = [[50.0, 50.0]], [[500.0 + 20 * k, 500.0] for k in range(50)]
    scores = score(still(car + clutter, "track_id"), still(car, "vehicle_id", 5.0), (0.0, 0.0, 100.0, 100.0))
    assert scores["false_per_km2"] == 0 and scores["idf1_moving"] == 1
