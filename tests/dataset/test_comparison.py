"""Matching of positions with labels, and the numbers of a small painted sequence."""

import numpy as np
import pandas as pd
import pytest

from glintrack.dataset.comparison import Measured, comparison_table, measure
from glintrack.dataset.sequences import (
    LABEL_COLUMNS,
    LabelledSequence,
    count_switches,
    match_positions,
    with_speeds,
)
from tests.track.detect.test_median_motion import CARS, INTERVAL_S, SIDE, sequence, where

COUNT = 8
STEP_S = INTERVAL_S


@pytest.fixture(scope="module")
def painted():
    """Three cars in frames of textured ground, and their labels."""
    frames = np.array(sequence(COUNT, 1))
    rows = [(k, v, True, e, n - SIDE) for k in range(COUNT) for v, (e, n) in enumerate(where(k))]
    labels = pd.DataFrame(rows, columns=LABEL_COLUMNS)
    inside = labels["east_m"].between(4, SIDE - 4) & labels["north_m"].between(4 - SIDE, -4)
    times_s = STEP_S * np.arange(COUNT)
    labels = with_speeds(labels[inside].reset_index(drop=True), times_s)
    return LabelledSequence(times_s, frames, 1.0, labels, {"all": np.ones((SIDE, SIDE), bool)})


def test_speeds_of_labels_and_standing_ones(painted):
    """The speed over the frames about a label; one that stands is not asked."""
    for vehicle, (_, _, u, v, _) in enumerate(CARS):
        speeds = painted.labels.query(f"vehicle_id == {vehicle}")["speed_m_s"]
        assert speeds.to_numpy() == pytest.approx(np.hypot(u, v))
    still = painted.labels.assign(east_m=5.0, north_m=-5.0)
    assert not with_speeds(still, painted.times_s)["asked"].any()


def test_positions_are_right_false_or_neither(painted):
    """Right on a label, neither beside one that is not asked, false elsewhere; a change of track counts."""
    rows = painted.labels.assign(track_id=painted.labels["vehicle_id"] + 10 * (painted.labels["frame"] > 3))
    labels = painted.labels.assign(asked=painted.labels["vehicle_id"] != 2)
    scene = LabelledSequence(painted.times_s, painted.frames, 1.0, labels, painted.areas)
    stray = pd.DataFrame({"frame": [0, 1], "track_id": [99, 99], "east_m": 120.0, "north_m": -10.0})
    rows = pd.concat([rows[["frame", "track_id", "east_m", "north_m"]], stray], ignore_index=True)
    found = match_positions(scene, rows, "all")
    assert found.labels["found"].all()
    assert found.false["track_id"].tolist() == [99, 99] and len(found.false_tracks) == 1
    assert count_switches(found.labels) == 2  # of the two vehicles that are asked
    asked = len(found.labels)
    assert found.f1 == pytest.approx(2 * asked / (2 * asked + 2))


def test_tracks_that_pass_each_other_keep_their_vehicles(painted):
    """Two vehicles 3 m apart whose positions are 2 m off, each toward the other: no identity changes."""
    places = [(k, v, True, 20.0 + 3 * v + 8 * k, -20.0) for k in range(3) for v in range(2)]
    labels = with_speeds(pd.DataFrame(places, columns=LABEL_COLUMNS), painted.times_s)
    scene = LabelledSequence(painted.times_s, painted.frames, 1.0, labels, painted.areas)
    rows = labels.assign(track_id=labels["vehicle_id"])
    toward = np.where(rows["frame"] == 1, 2.0 - 4.0 * rows["vehicle_id"], 0.0)
    found = match_positions(scene, rows.assign(east_m=rows["east_m"] + toward), "all")
    assert found.labels["found"].all() and count_switches(found.labels) == 0
    other = rows.assign(track_id=rows["track_id"] + 10 * (rows["frame"] > 0))
    assert count_switches(match_positions(scene, other, "all").labels) == 2


def test_a_painted_sequence_is_measured(painted):
    """All cars are detected and tracked, and the table has one line for each number."""
    numbers = measure(painted, "all")
    by_name = {one.name: one for one in numbers}
    assert by_name["probability of detection"].value == 1
    assert by_name["completeness"].value > 0.9 and by_name["purity"].value == 1
    assert by_name["false tracks"].value == 0
    assert 0.3 < by_name["residual, 50 % quantile"].value < 0.67  # that of noise, which the median follows
    table = comparison_table({"one": numbers, "other": numbers}).splitlines()
    assert len(table) == len(numbers) + 2 and table[0] == "| quantity | one | other |"
    assert Measured("f", "m", 1234.5, 1.0, 2.0).text == "1,230 (1 to 2)"


def test_bright_vehicles_are_counted(painted):
    """A vehicle with a pixel of many times the ground is bright."""
    name, frames = "bright vehicles among labels on bright ground", painted.frames.copy()
    row, column = painted.cells(painted.labels[["east_m", "north_m"]].to_numpy(float)).T
    frames[painted.labels["frame"], row, column] = 10 * frames.max()
    bright = LabelledSequence(painted.times_s, frames, 1.0, painted.labels, painted.areas)
    share = {one.name: one.value for one in measure(bright, "all")}[name]
    assert share == 1 > {one.name: one.value for one in measure(painted, "all")}[name]
