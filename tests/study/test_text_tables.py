"""Which parameter matters: ranked by the headline, by the channel that holds most, in words."""

import numpy as np
import pandas as pd

from glintrack.study.analysis import point_scores
from glintrack.study.text_tables import NAMES, SHORT, answer, importance

COLUMNS = ["channel", "response", "axis", "level", "effect", "low", "high", "p_max_t"]
EFFECTS = pd.DataFrame(
    [
        ["pan", "tracked_per_km2", "sensor.pitch_um", "8.5 against 17", 40.0, 20.0, 60.0, 0.01],
        ["dolp", "tracked_per_km2", "sensor.pitch_um", "8.5 against 17", 30.0, 10.0, 50.0, 0.01],
        ["pan", "tracked_per_km2", "scene.seed", "2 against 1", 70.0, -10.0, 150.0, 0.3],
        ["pan", "tracked_per_km2", "flight.rate_hz", "10 against 2", -12.0, -15.0, -9.0, 0.01],
        ["pan", "completeness_visible", "sensor.pitch_um", "8.5 against 17", 0.11, 0.05, 0.2, 0.01],
        ["pan", "stage_detector", "sensor.pitch_um", "8.5 against 17", 0.2, 0.1, 0.3, 0.01],
        ["pan", "false_per_km2", "sensor.pitch_um", "8.5 against 17", 3.0, -1.0, 7.0, 0.4],
    ],
    columns=COLUMNS,
)  # fmt: skip


def test_what_is_beyond_chance_leads_and_the_larger_before():
    found = importance({"effects": EFFECTS})
    assert list(found["axis"]) == ["sensor.pitch_um", "flight.rate_hz", "scene.seed"]
    assert list(found["significant"]) == [True, True, False]
    first = found.iloc[0]
    assert (first["channel"], first["completeness_visible"], first["stage_detector"]) == ("pan", 0.11, 0.2)
    assert np.isnan(first["stage_known_background"])  # not measured


def test_the_answer_in_words():
    assert answer({"effects": EFFECTS}) == (
        "Most important: `sensor.pitch_um`, 8.5 against 17: +40 tracked vehicles per km² "
        "(+20 to +60, significant; +3 false tracks per km²) in pan. "
        "Then `flight.rate_hz`, 10 against 2: -12 tracked vehicles per km² (-15 to -9, significant) in pan. "
        "Not significant among all effects: `scene.seed`."
    )
    unsure = EFFECTS[EFFECTS["axis"] == "scene.seed"]
    assert answer({"effects": unsure}).startswith("Not significant: `scene.seed`, ")
    several = pd.concat([unsure, unsure.assign(axis="sensor.seed")])
    assert answer({"effects": several}).startswith("No significant effect; the largest is `scene.seed`")


def test_of_a_single_axis_none_matters_most():
    one = EFFECTS[EFFECTS["axis"] == "sensor.pitch_um"]
    assert answer({"effects": one}).startswith("`sensor.pitch_um`, 8.5 against 17: +40 tracked vehicles")


def test_the_channel_that_holds_most_speaks_and_the_others_stand_beside_it():
    points = pd.DataFrame(
        [["base", 90.0, "pan"], ["base", 120.0, "dolp"], ["8.5", 130.0, "pan"], ["8.5", 150.0, "dolp"]],
        columns=["point", "score", "channel"],
    ).assign(response="tracked_per_km2")
    one = EFFECTS[EFFECTS["axis"] == "sensor.pitch_um"]
    assert answer({"effects": one, "points": points}) == (
        "`sensor.pitch_um`, 8.5 against 17: +30 tracked vehicles per km² (+10 to +50, significant) in DoLP, "
        "+40 (+20 to +60, significant) in pan."
    )
    assert list(importance({"effects": EFFECTS, "points": points})["channel"]) == ["dolp", "pan", "pan"]


def test_every_share_says_of_which_vehicles_it_is():
    for name, words in (*NAMES.items(), *SHORT.items()):
        if name.startswith(("completeness", "stage_")):
            assert ("visible" in words.split(":")[0]) == (name == "completeness_visible"), words
            assert "of all" in words or "of visible" in words


def test_the_answer_ends_with_what_stands_against_what():
    rows = [["adaptive less pan", "tracked_per_km2", "base", 1.0, -1.0, 2.0, 0.4],
            ["adaptive less pan", "tracked_per_km2", "all", 23.1, 16.8, 27.8, 0.001]]  # fmt: skip
    columns = ["contrast", "response", "point", "effect", "low", "high", "p_max_t"]
    said = answer({"effects": EFFECTS, "contrasts": pd.DataFrame(rows, columns=columns)})
    assert said.endswith(" Adaptive less pan: +23.1 tracked vehicles per km² (+16.8 to +27.8, significant).")


def test_without_effects_the_best_design_answers():
    rows = [["base", 120.0, 90.0, 150.0, "pan"], ["base", 140.0, np.nan, np.nan, "all"]]
    points = pd.DataFrame(rows, columns=["point", "score", "low", "high", "channel"])
    said = answer({"points": points.assign(response="tracked_per_km2")})
    assert said == "Highest: 140 tracked vehicles per km² in all elements."
    assert answer({}) == ""


def test_each_point_has_its_score_and_interval():
    """Two replicates of two points: the mean, and Student's interval of two."""
    table = pd.DataFrame(
        {
            "point": range(4), "replicate": [0, 1, 0, 1], "channel": "pan", "status": "finished",
            "label": ["a", "a", "b", "b"], "purity": [0.4, 0.6, 0.9, 0.9], "over_time": "{}",
        }
    )  # fmt: skip
    found = point_scores(table, ["label"], "purity", "pan", np.random.default_rng(0))
    assert list(found["point"]) == ["a", "b"]
    np.testing.assert_allclose(found["score"], [0.5, 0.9])
    student_of_one = 12.706
    np.testing.assert_allclose(found["high"].iloc[0] - 0.5, student_of_one * 0.1, rtol=1e-3)
