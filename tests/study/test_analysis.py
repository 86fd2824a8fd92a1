"""Effects, intervals, Sobol indices, Pareto front and pairs, on scores whose answers are known."""

import json

import numpy as np
import pandas as pd
import pytest

from glintrack.study import StudyDesign
from glintrack.study.analysis import effects, froc, pareto_front, point_scores, sobol_indices
from glintrack.study.comparisons import DOLP_LESS_PAN, contrast_scores
from glintrack.study.design import build_axes, unit_points
from glintrack.study.intervals import Units, units
from glintrack.study.report import view_notes, views

SWEPT = "track.reporting.max_false_share"


def rng():
    return np.random.default_rng(1)


def two_by_three(interaction=0.0, noise=0.0, count=40):
    points = pd.DataFrame([(a, b) for a in ("low", "high") for b in (1, 2, 3)], columns=["a", "b"])
    high = (points["a"] == "high").to_numpy(dtype=float)
    score = 1 + 0.5 * high + 0.1 * points["b"].to_numpy() + interaction * high * (points["b"] == 3)
    common = rng().normal(0, 1, count)  # what all cases share, as traffic: pairs take it out
    return Units(points, score.to_numpy()[:, None] + common + noise * rng().normal(0, 1, (6, count)))


def test_effects_of_a_factorial_are_differences_of_means():
    found = effects(two_by_three(), rng())
    assert list(found["axis"]) == ["a", "b", "b"]
    np.testing.assert_allclose(found["effect"], [0.5, 0.1, 0.2], atol=1e-12)
    # what all units share is no uncertainty of a difference: no draw differs from another
    assert found[["low", "high"]].isna().all(axis=None)


def test_what_rounding_leaves_of_an_effect_is_nought():
    points = pd.DataFrame([(a,) for a in ("low", "high")], columns=["a"])
    found = effects(Units(points, np.array([[0.1 + 0.2, 0.3, 0.7], [0.3, 0.1 + 0.2, 0.7]])), rng())
    assert found["effect"].tolist() == [0.0]


@pytest.mark.parametrize("units_of_each", [3, 9])
def test_a_flight_that_failed_leaves_the_others_paired(units_of_each):
    """Cities differ by far more than the designs; the last city of the second design failed."""
    city, gain = np.linspace(0.2, 0.9, units_of_each), 0.02 + 0.001 * np.arange(units_of_each)
    values = np.stack([city, city + gain])
    values[1, -1] = np.nan
    found = effects(Units(pd.DataFrame({"a": ["old", "new"]}), values), rng()).iloc[0]
    assert found["effect"] == pytest.approx(gain[:-1].mean())
    assert 0 < found["low"] < found["effect"] < found["high"] < 0.04


@pytest.mark.parametrize("units_of_each", [3, 9])
def test_a_design_without_a_score_leaves_the_effects_of_the_others(units_of_each):
    noise = rng().normal(0, 0.01, (3, units_of_each))
    values = np.array([[0.6], [0.8], [np.nan]]) + noise
    found = effects(Units(pd.DataFrame({"a": ["one", "two", "none"]}), values), rng())
    assert found["level"].tolist() == ["two against one"]
    assert found["low"][0] < 0.2 < found["high"][0]


def test_the_first_design_is_the_base_also_if_it_failed():
    rows = [
        {"point": k, "replicate": 0, "channel": "pan", "a": a, "b": b, "over_time": "{}", "custody": 0.5,
         "status": "failed" if k == 0 else "finished"}
        for k, (a, b) in enumerate([(1, 1), (2, 1), (1, 2)])
    ]  # fmt: skip
    found = point_scores(pd.DataFrame(rows), ["a", "b"], "custody", "pan", rng())
    assert found["point"].tolist() == ["a = 2", "b = 2"]


def test_interactions_are_found_where_there_are_some():
    found = effects(two_by_three(interaction=0.3), rng(), interactions=True).set_index(["axis", "level"])
    assert found.loc[("a × b", "high against low and 3 against 1"), "effect"] == pytest.approx(0.3)
    assert found.loc[("a × b", "high against low and 2 against 1"), "effect"] == pytest.approx(0, abs=1e-12)
    assert found.loc[("a", "high against low"), "effect"] == pytest.approx(0.5)


def test_intervals_hold_the_truth_as_often_as_they_say():
    """Coverage of 95 % intervals over 200 studies; its own standard error is 1.5 %."""
    inside, generator = 0, np.random.default_rng(5)
    points = pd.DataFrame({"a": ["low", "high"]})
    for _ in range(200):
        values = np.array([[0.0], [0.5]]) + generator.normal(0, 1, (2, 30))
        found = effects(Units(points, values), generator).iloc[0]
        inside += found["low"] <= 0.5 <= found["high"]
    assert 0.91 <= inside / 200 <= 0.99


@pytest.mark.parametrize("count", [2, 3, 6])
def test_few_replicates_have_intervals_as_wide_as_they_are_unsure(count):
    """Student's, exact for normal scores: 95 % of 400 studies, whose own standard error is 1.1 %."""
    inside, generator = 0, np.random.default_rng(7)
    points = pd.DataFrame({"a": ["low", "high"]})
    for _ in range(400):
        values = np.array([[0.0], [0.5]]) + generator.normal(0, 1, (2, count))
        found = effects(Units(points, values), generator).iloc[0]
        inside += found["low"] <= 0.5 <= found["high"]
    assert 0.92 <= inside / 400 <= 0.98


def test_one_unit_gives_no_interval():
    found = effects(Units(pd.DataFrame({"a": [1, 2]}), np.array([[0.0], [1.0]])), rng())
    assert found["effect"].iloc[0] == pytest.approx(1) and found[["low", "high"]].isna().all(axis=None)


def test_what_a_design_does_not_determine_is_left_out():
    confounded = pd.DataFrame({"a": [1, 2], "b": [1, 2]})
    assert effects(Units(confounded, np.zeros((2, 3))), rng()).empty


def test_sobol_indices_of_a_function_with_known_ones():
    """Ishigami's function, a = 7 and b = 0.1: S = 0.314, 0.442, 0; T = 0.558, 0.442, 0.244.

    References
    ----------
    Saltelli et al., Sensitivity Analysis (2000), §2.9.3.
    """
    axes = {f"sensor.x{k}": {"from": -np.pi, "to": np.pi} for k in range(3)}
    design = StudyDesign(design="saltelli", samples=4096, axes=axes)
    built = build_axes(design)
    x = 2 * np.pi * unit_points(design, built) - np.pi
    y = np.sin(x[:, 0]) + 7 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])
    found = sobol_indices(Units(pd.DataFrame(index=range(len(y))), y[:, None]), list(axes), rng())
    np.testing.assert_allclose(found["first"], [0.314, 0.442, 0.0], atol=0.03)
    np.testing.assert_allclose(found["total"], [0.558, 0.442, 0.244], atol=0.03)
    assert (
        (found["total_low"] < [0.558, 0.442, 0.244]) & (found["total_high"] > [0.558, 0.442, 0.244])
    ).all()


@pytest.mark.parametrize("level", [0.0, 200.0])
def test_sobol_indices_do_not_depend_on_a_constant(level):
    x = np.random.default_rng(3).random((64, 6))
    a, b = x[:, :3], x[:, 3:]
    points = [a, b, *(np.where(np.arange(3) == k, b, a) for k in range(3))]
    score = level + np.stack([p @ [10.0, 5.0, 2.0] for p in points], axis=1).ravel()
    found = sobol_indices(Units(pd.DataFrame(index=range(len(score))), score[:, None]), list("abc"), rng())
    np.testing.assert_allclose(found["first"], np.array([100, 25, 4]) / 129, atol=0.15)
    assert (found["first_high"] - found["first_low"]).max() < 1


def test_pareto_front_by_hand():
    cost, gain = np.array([1, 2, 3, 2, 4, 1]), np.array([1, 3, 3, 2, 5, 1])
    np.testing.assert_array_equal(pareto_front(cost, gain), [True, True, False, False, True, True])
    assert not pareto_front(np.array([1.0, 1.0]), np.array([np.nan, 0.0]))[0]


def table():
    rows = []
    for point, threshold in enumerate((2.0, 4.0)):
        for channel, gain in (("pan", 0.0), ("dolp", 0.25)):
            series = [0.4 + gain + 0.1 * k for k in range(6)]
            rows.append(
                {
                    "point": point,
                    "replicate": 0,
                    "channel": channel,
                    "status": "finished",
                    SWEPT: threshold,
                    "completeness": float(np.mean(series)) - 0.1 * point,
                    "false_per_frame": 8 / threshold,
                    "over_time": json.dumps({"completeness": series}),
                }
            )
    return pd.DataFrame(rows)


def test_pan_and_dolp_are_compared_in_pairs():
    found = contrast_scores(table(), [SWEPT], "completeness", DOLP_LESS_PAN, rng())
    np.testing.assert_allclose(found["effect"], 0.25)
    assert found["point"].iloc[-1] == "all"


def test_blocks_of_time_are_units():
    found = units(table(), [SWEPT], "completeness", "pan")
    np.testing.assert_allclose(found.values[0], [0.4, 0.5, 0.6, 0.7, 0.8, 0.9])
    assert units(table(), [SWEPT], "false_per_frame", "pan").values.shape == (2, 1)
    with pytest.raises(ValueError, match="`response` must be a score"):
        units(table(), [SWEPT], "beauty", "pan")


def test_a_swept_threshold_gives_a_curve_each():
    found = froc(table(), [SWEPT])
    assert len(found) == 4 and list(found[found["channel"] == "pan"]["false_per_frame"]) == [4, 2]
    assert froc(table(), []).empty


def test_one_at_a_time_each_axis_is_told_by_itself():
    """The base has the first pitch and the first haze: a mean over all rows of clear air holds finer ones."""
    rows = pd.DataFrame(
        {
            "sensor.pitch_um": [17.0, 8.5, 17.0], "atmosphere.aerosol": ["clear", "clear", "urban"],
            "gsd_across_m": [0.75, 0.375, 0.75], "gsd_along_m": [1.2, 0.6, 1.2],
            "window_km2": [0.2, 0.05, 0.2],
        }
    )  # fmt: skip
    assert set(views(rows, ["sensor.pitch_um", "atmosphere.aerosol"])["axis"]) == {"sensor.pitch_um"}


def test_an_axis_that_changes_the_view_is_told():
    """Half the pitch halves an element's ground and quarters the window; a threshold changes neither."""
    pitch, threshold = np.meshgrid([17.0, 8.5], [3.0, 4.0], indexing="ij")
    rows = pd.DataFrame(
        {
            "sensor.pitch_um": pitch.ravel(), SWEPT: threshold.ravel(),
            "gsd_across_m": 0.75 * pitch.ravel() / 17, "gsd_along_m": 1.2 * pitch.ravel() / 17,
            "window_km2": 0.2 * (pitch.ravel() / 17) ** 2,
        }
    )  # fmt: skip
    found = views(rows, ["sensor.pitch_um", SWEPT])
    assert list(found["axis"]) == ["sensor.pitch_um"] * 2
    (note,) = view_notes(found)
    assert "`sensor.pitch_um`" in note and "0.375 to 0.75 m across" in note and "0.05 to 0.2 km²" in note


def test_of_axes_that_all_change_at_once_those_are_told_that_the_view_follows():
    """Forty flights, each of another pitch, exposure and seed; the window follows the pitch alone."""
    pitch, exposure = rng().uniform(8.5, 17, 40), rng().uniform(0.03, 0.12, 40)
    rows = pd.DataFrame(
        {
            "sensor.pitch_um": pitch, "sensor.integration_time_ms": rng().permutation(exposure),
            "seed": np.arange(40), "gsd_across_m": 0.75 * pitch / 17, "gsd_along_m": 1.2 * pitch / 17,
            "window_km2": 0.2 * (pitch / 17) ** 2,
        }
    )  # fmt: skip
    found = views(rows, ["sensor.pitch_um", "sensor.integration_time_ms", "seed"])
    assert set(found["axis"]) == {"sensor.pitch_um"}
