"""The answer in words: the loop that speaks, the figures in it, and the rung where most is lost."""

import numpy as np
import pytest
import xarray as xr

from glintrack.config import Case
from glintrack.results.verdict import best_channel, verdict, view_facts

SCORES = {
    "pan": {
        "completeness": 0.331, "completeness_visible": 0.4, "custody": 0.352, "false_per_km2": 34.4,
    },
    "dolp": {
        "completeness": 0.13, "completeness_visible": 0.15, "custody": 0.134, "false_per_km2": 29.0,
    },
}  # fmt: skip
RUNGS = {
    "moving": 1.0, "in_view": 1.0, "visible": 0.9, "ideal_observer": 0.9, "known_background": 0.72,
    "predicted_background": 0.60, "reported_pose": 0.59, "detector": 0.35, "oracle_association": 0.30,
    "tracker": 0.33,
}  # fmt: skip


def tree(rungs):
    ladder = xr.Dataset({"ladder": ("rung", list(rungs.values()))}, coords={"rung": list(rungs)})
    return xr.DataTree.from_dict({"/bound/pan": ladder})


def test_the_loop_that_holds_most_speaks():
    said = verdict(xr.DataTree(), SCORES)
    assert said == (
        "Change in pan holds 33 of 100 moving vehicles (40 of 100 visible ones), each for 35 % of its time "
        "in sight under one track, with 34 false tracks per km²."
    )
    assert best_channel({"pan": {"completeness": np.nan}, "dolp": {"completeness": 0.0}}) == "dolp"


@pytest.mark.parametrize(
    ("changed", "where"),
    [
        ({}, "Most are lost in detection: 24 of 100."),
        ({"detector": 0.58}, "Most are lost in association and confirmation: 25 of 100."),
        ({"known_background": 0.5}, "between vehicles that stand close together: 40 of 100."),
        ({"in_view": 0.5, "visible": 0.4, "detector": np.nan}, "Most are lost out of the frame: 50 of 100."),
    ],
)
def test_the_largest_step_is_named(changed, where):
    assert where in verdict(tree(RUNGS | changed), SCORES)


def test_what_the_sensor_would_allow_is_said_of_visible_vehicles():
    assert "would find 80 of 100 visible ones in a single frame" in verdict(tree(RUNGS), SCORES)


def test_nothing_scored_nothing_said():
    assert verdict(tree(RUNGS), {}) == "" and verdict(xr.DataTree(), {"pan": {}}) == ""


def test_the_view_is_described():
    said = view_facts(Case())
    assert "° off nadir" in said and "the sun stands" in said and " m of ground" in said


def test_what_a_memory_wins_back_is_not_lost():
    """The detector finds more than the frozen predictor: the close neighbours are the largest loss then."""
    rungs = RUNGS | {"predicted_background": 0.5, "reported_pose": 0.5, "detector": 0.62, "tracker": 0.55}
    assert "Most are lost between vehicles that stand close together: 18 of 100." in verdict(
        tree(rungs), SCORES
    )
