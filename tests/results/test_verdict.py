"""The answer in words: the loop that speaks, the figures in it, and the stage where most is lost."""

import numpy as np
import pytest
import xarray as xr

from glintrack.case.design import Case
from glintrack.results.verdict import (
    describe_other_channels,
    reservations,
    select_channel,
    verdict,
    view_facts,
)

SCORES = {
    "pan": {
        "completeness": 0.331, "completeness_visible": 0.4, "custody": 0.352, "false_per_km2": 34.4,
    },
    "dolp": {
        "completeness": 0.13, "completeness_visible": 0.15, "custody": 0.134, "false_per_km2": 29.0,
    },
}  # fmt: skip
STAGES = {
    "moving": 1.0, "in_view": 1.0, "visible": 0.9, "ideal_observer": 0.9, "known_background": 0.72,
    "predicted_background": 0.60, "reported_pose": 0.59, "detector": 0.35, "oracle_association": 0.30,
    "tracker": 0.33,
}  # fmt: skip


def tree(stages):
    budget = xr.Dataset({"of_moving": ("stage", list(stages.values()))}, coords={"stage": list(stages)})
    return xr.DataTree.from_dict({"/bound/pan": budget})


def test_the_loop_that_holds_most_speaks():
    said = verdict(xr.DataTree(), SCORES)
    assert said == (
        "Pan tracks 33 of 100 moving vehicles in the window, 40 of 100 visible ones, with 34 false tracks "
        "per km² (mean of all frames). One track stays on a vehicle for 35 % of its visible time."
    )
    assert select_channel({"pan": {"completeness": np.nan}, "dolp": {"completeness": 0.0}}) == "dolp"


@pytest.mark.parametrize(
    ("changed", "where"),
    [
        (
            {},
            ". The largest lasting loss is detection: from 59 to 35 of 100 moving vehicles.",
        ),
        (
            {"detector": 0.58},
            ". The largest lasting loss is association and reporting: from 58 to 33 of 100 moving vehicles.",
        ),
        (
            {"known_background": 0.5},
            "loss is vehicles that stand close together: from 90 to 50 of 100 moving vehicles.",
        ),
        (
            {"in_view": 0.5, "visible": 0.4, "detector": np.nan},
            "The largest lasting loss is vehicles outside the frame: from 100 to 50 of 100 moving vehicles.",
        ),
    ],
)
def test_the_largest_step_is_named(changed, where):
    assert where in verdict(tree(STAGES | changed), SCORES)


def test_what_the_sensor_would_allow_is_said_of_visible_vehicles():
    said = verdict(tree(STAGES), SCORES)
    assert ". If the background were known, 72 of 100 moving vehicles could be found. " in said


def test_what_was_not_scored_is_not_said():
    assert (
        verdict(xr.DataTree(), {"pan": {"completeness": 0.45}})
        == "Pan tracks 45 of 100 moving vehicles in the window (mean of all frames)."
    )


def test_nothing_scored_nothing_said():
    assert verdict(tree(STAGES), {}) == "" and verdict(xr.DataTree(), {"pan": {}}) == ""


def test_the_view_is_described():
    case = Case(atmosphere={"sun_zenith_deg": 40.0, "sun_azimuth_deg": 251.4}).replace(
        {"sensor.pitch_um": 17.0, "sensor.focal_length_mm": 51.0, "flight.altitude_m": 1500.0,
         "flight.off_nadir_deg": 60.0, "flight.frames": 12}
    )  # fmt: skip
    said = view_facts(case)
    assert said["sun"] == "50° high, azimuth 251°" and said["altitude"] == "1500 m"
    assert said["off nadir"].startswith("60°, ") and said["flight"].startswith("12 frames at ")
    assert said["an element sees"] == "1 m × 2 m of ground"  # 17/51 mm × 3 km, over cos 60° along the view


def test_what_a_memory_wins_back_is_not_lost():
    """The detector finds more than the frozen predictor: the close neighbours are the largest loss then."""
    stages = STAGES | {"predicted_background": 0.5, "reported_pose": 0.5, "detector": 0.62, "tracker": 0.55}
    said = verdict(tree(stages), SCORES)
    assert said.endswith(
        "The largest lasting loss is "
        "vehicles that stand close together: from 90 to 72 of 100 moving vehicles."
    )


def flown(held, stages=STAGES):
    """A result of which a channel held these shares, frame by frame."""
    times = {"time": 0.5 * np.arange(len(held))}
    groups = {"/pan": xr.Dataset({"completeness": ("time", np.asarray(held, float))}, times)}
    return xr.DataTree.from_dict(groups | {"/bound/pan": tree(stages)["bound/pan"].to_dataset()})


def test_a_field_smaller_than_the_window_is_told_with_what_holds_it():
    case = Case().replace({"flight.off_nadir_deg": 0.0, "flight.altitude_m": 3000.0})
    said = reservations(flown([0.5] * 9, STAGES | {"in_view": 0.34, "visible": 0.3}), SCORES, case)
    assert (
        len(said) == 2
        and "66 of 100 moving vehicles are outside" in said[0]
        and "`constraints.constant_field = true`" in said[0]
    )
    assert "sees about " in said[0]
    (unfitted,) = reservations(flown([0.5] * 9), SCORES, case)
    assert unfitted == said[1]
    assert unfitted.startswith("Off-nadir angle 0° is outside the range in which detector and tracker")
    assert reservations(flown([0.5] * 9), SCORES, Case()) == []


def test_a_flight_too_short_for_a_loss_budget_says_so_and_what_it_sees():
    small = {"sensor.rows": 280, "sensor.columns": 440, "flight.off_nadir_deg": 0.0, "flight.frames": 5}
    groups = {"/pan": xr.Dataset({"completeness": ("time", np.full(5, 0.5))}, {"time": np.arange(5.0)})}
    field, missing, _ = reservations(xr.DataTree.from_dict(groups), SCORES, Case().replace(small))
    assert "sees about " in field and "less than the window" in field and " of 100" not in field
    assert "more than 5 frames (`bound.every`); the case has 5" in missing


def test_frames_before_the_first_track_are_told():
    early, late = [0, 0.2, 0.3, 0.4, 0.4, 0.5, 0.5, 0.5], [0, 0, 0, 0, 0.2, 0.3, 0.3, 0.3]
    assert reservations(flown(early), SCORES, None) == []
    assert (
        "first vehicle was tracked after 4 of the 8 scored frames"
        in reservations(flown(late), SCORES, None)[0]
    )
    assert reservations(flown([0, 0, 0]), SCORES, None) == []  # the verdict is 0 of 100
    assert reservations(xr.DataTree(), {}, None) == []


def test_frames_in_which_the_background_is_learnt_do_not_count():
    of = flown([0, 0, 0.5, 0.5])
    assert "first vehicle was tracked after 2" in reservations(of, SCORES, None)[0]
    of["pan"].attrs["learning_frames"] = 2.0
    assert reservations(of, SCORES, None) == []


@pytest.mark.parametrize(
    ("frames", "rate_hz", "short"), [(13, 2.0, True), (14, 2.0, False), (40, 10.0, True)]
)
def test_a_run_too_short_is_undecided(frames, rate_hz, short):
    """12 frames and 5 s are needed after the two frames, or 0.75 s, of learning."""
    of = flown([0.0] * frames)
    of["pan"] = of["pan"].to_dataset().assign_coords(time=np.arange(frames) / rate_hz)
    of["pan"].attrs["learning_frames"] = 2.0
    assert verdict(of, SCORES).startswith("Undecided: the run is too short. ") == short


def test_the_verdict_states_its_denominator():
    of = flown([0.5] * 20)
    of.attrs["area"] = "footprint"
    of["pan"].attrs |= {"completeness_window": 0.049, "frames": 18.0}
    said = verdict(of, SCORES)
    assert said.startswith("Pan tracks 33 of 100 moving vehicles in the frame (5 of 100 in the whole window)")
    assert "(mean of 18 frames)" in said
    small = Case().replace({"sensor.rows": 280, "sensor.columns": 440, "bound.every": 0})
    assert not [one for one in reservations(of, SCORES, small) if "sees about" in one]


def test_a_loss_budget_of_other_frames_than_the_scores_says_so():
    of = flown([0.5] * 9, STAGES | {"tracker": 0.41})
    (said,) = reservations(of, SCORES, None)
    assert "with 41 of 100 moving vehicles tracked. The scores use all frames" in said


def test_few_movers_are_told():
    of = flown([0.5] * 9)
    assert reservations(of, SCORES, None) == []
    of["pan"].attrs["vehicles_per_frame"] = 8.2
    assert "Only 8 vehicles move" in reservations(of, SCORES, None)[0]
    own = Case().replace({"scene": {"city": "mesh", "mesh_file": "m.glb", "traffic_file": "f.csv"}})
    own = own.replace({"bound.every": 0})
    of["pan"].attrs["vehicles_per_frame"] = 1.2
    (sentence,) = [one for one in reservations(of, SCORES, own) if one.startswith("Only")]
    assert sentence == "Only 1 vehicle moves in the window at a time: shares are not precise."
    of.attrs["area"] = "footprint"
    (sentence,) = [one for one in reservations(of, SCORES, own) if one.startswith("Only")]
    assert "Another stare point (`flight.stare_east_m`, `flight.stare_north_m`)" in sentence
    del of.attrs["area"]
    assert not [one for one in reservations(of, SCORES, own) if "less than the window" in one]


def test_what_is_told_late_says_so_and_what_was_told_at_once():
    of = flown([0.5] * 9)
    late = {"report_lag_s": 1.5, "completeness_visible_at_once": 0.352, "false_per_km2_at_once": 29.7}
    of["pan"].attrs |= late
    assert "(mean of all frames, fixed lag 1.5 s)" in verdict(of, SCORES)
    (said,) = reservations(of, SCORES, None)
    assert said.startswith(
        "Tracks are reported 1.5 s late (`track.reporting.lag_s`), so that later frames count. "
        "Reported at once, 35 of 100 visible vehicles are tracked, with 30"
    )


def test_what_the_other_channels_hold_stands_beside_the_verdict():
    pan = {"completeness": 0.5, "completeness_visible": 0.57, "false_per_km2": 13.2}
    dolp = {"completeness": 0.4, "completeness_visible": 0.46, "false_per_km2": 4.25}
    every = {"completeness": 0.6, "completeness_visible": 0.68, "false_per_km2": 20.0}
    assert describe_other_channels({"pan": pan, "dolp": dolp, "all": every}) == (
        "On the same frames: Pan tracks 57 of 100 visible vehicles, with 13 false tracks per km². "
        "DoLP tracks 46 of 100 visible vehicles, with 4.2 false tracks per km²."
    )
    for scores in ({"pan": pan}, {}, {"pan": pan, "dolp": {}}):
        assert describe_other_channels(scores) == ""


def test_where_nothing_moves_that_and_the_false_tracks_are_said():
    scores = {"pan": {"completeness": np.nan, "false_per_km2": 12.4}, "all": {"false_per_km2": 0.0}}
    assert verdict(xr.DataTree(), scores) == (
        "No vehicle moves in the window. False tracks per km²: 12 in pan, 0.0 in all elements."
    )


def test_more_false_tracks_than_asked_for_are_told():
    case = Case.model_validate({"name": "n", "track": {"reporting": {"method": "existence"}}})
    for false, is_stated in ((183.0, True), (3.0, False)):
        scores = {"all": SCORES["pan"] | {"tracked_per_km2": 12.5, "false_per_km2": false}}
        said = " ".join(reservations(xr.DataTree(), scores, case))
        limit = f"{100 * case.track.reporting.max_false_share:.0f}"
        assert (f"94 of 100 reported tracks are false, more than the limit of {limit}" in said) == is_stated
    without_ratios = xr.DataTree.from_dict({"all/detections": xr.Dataset({"contrast": ("row", [1.0])})})
    scores = {"all": SCORES["pan"] | {"tracked_per_km2": 12.5, "false_per_km2": 183.0}}
    assert "more than the limit" not in " ".join(reservations(without_ratios, scores, case))


def test_what_case_check_warns_of_is_told_with_the_answer():
    full = Case().replace({"sensor.integration_time_ms": 60.0})
    (said,) = [one for one in reservations(flown([0.5] * 9), SCORES, full) if "well" in one]
    assert "white paint in the sun fills the well" in said
    assert not any("well" in one for one in reservations(flown([0.5] * 9), SCORES, Case()))
