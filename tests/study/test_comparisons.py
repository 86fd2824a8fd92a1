"""Contrasts and ranks on scores whose answers are known, and refusals of what a study does not vary."""

import json

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from glintrack.core.designs import validate_design
from glintrack.study import StudyDesign, build_plan, comparisons
from glintrack.study.comparisons import (
    all_contrasts,
    contrast_scores,
    design_contrasts,
    kendall_tau,
    rank_agreement,
)
from glintrack.study.design import Contrast
from glintrack.study.intervals import FEW_UNITS, estimate, units
from glintrack.study.text_tables import MAX_P, comparison_tables, contrast_tables

GAIN = {"adaptive": {"pan": 0.0, "all": 0.1}, "all pan": {"pan": 0.3}}
ADDS = Contrast(
    label="four elements less the sensor bought instead",
    of={"channel": "all", "elements": "adaptive"},
    against={"channel": "pan", "elements": "all pan"},
)


def table(replicates=2, missing=()):
    """Sensors under two angles: the angle adds to the adaptive one alone; traffic moves all alike."""
    rng, rows, point = np.random.default_rng(3), [], 0
    traffic = rng.normal(0, 1, (replicates, 6))
    for elements, gains in GAIN.items():
        for angle in (0, 90):
            for replicate in range(replicates):
                for channel, gain in gains.items():
                    series = 1 + traffic[replicate] + gain + 0.2 * (angle == 90) * (elements == "adaptive")
                    status = "missing" if (elements, angle, replicate) in missing else "finished"
                    rows.append(
                        {
                            "point": point, "replicate": replicate, "channel": channel, "status": status,
                            "elements": elements, "angle": angle, "held": series.mean(),
                            "over_time": json.dumps({"held": list(series)}),
                        }
                    )  # fmt: skip
                point += 1
    return pd.DataFrame(rows)


def test_a_contrast_crosses_channels_and_keeps_the_other_axes_apart():
    """Traffic that both sides share leaves the difference, and is no uncertainty of it."""
    found = contrast_scores(table(), ["elements", "angle"], "held", ADDS, np.random.default_rng(1))
    assert list(found["point"]) == ["0", "90", "all"]
    np.testing.assert_allclose(found["effect"], [-0.2, 0.0, -0.1], atol=1e-12)
    assert found["low"].isna().all()


def test_a_flight_that_is_missing_does_not_shift_the_others():
    found = contrast_scores(
        table(missing={("adaptive", 0, 0)}), ["elements", "angle"], "held", ADDS, np.random.default_rng(1)
    )
    np.testing.assert_allclose(found["effect"][1:2], 0.0, atol=1e-12)
    left = units(table(missing={("adaptive", 0, 0)}), ["elements", "angle"], "held", "all").values
    assert np.isnan(left[0, :6]).all() and np.isfinite(left[0, 6:]).all()


def test_a_contrast_that_names_every_axis_has_one_point():
    of = {"channel": "all", "elements": "adaptive", "angle": 90}
    one = Contrast(label="x", of=of, against={"channel": "pan", "elements": "all pan", "angle": 0})
    found = contrast_scores(table(), ["elements", "angle"], "held", one, np.random.default_rng(1))
    assert list(found["point"]) == ["all"]
    np.testing.assert_allclose(found["effect"], 0.0, atol=1e-12)


@pytest.mark.parametrize(
    "contrasts",
    [
        [3],
        [{"label": "x"}],
        [{"label": "x", "of": {"channel": "pan", "moon": 1}, "against": {"channel": "all", "moon": 2}}],
        [{"label": "x", "of": {"channel": ["pan"]}, "against": {"channel": "all"}}],
        [{"label": "x", "of": {"channel": "pan", "angle": 0}, "against": {"channel": "all"}}],
    ],
)
def test_contrasts_of_a_damaged_result_are_refused(contrasts):
    with pytest.raises(ValueError, match="must"):
        design_contrasts({"contrasts": contrasts}, ["elements", "angle"])


def test_a_side_that_was_not_flown_gives_no_rows():
    missing = {("all pan", angle, replicate) for angle in (0, 90) for replicate in (0, 1)}
    assert contrast_scores(
        table(missing=missing), ["elements", "angle"], "held", ADDS, np.random.default_rng(1)
    ).empty


def test_eight_replicates_and_more_are_drawn_as_whole_flights():
    """Blocks of a flight are not independent: of many flights each counts once."""
    assert units(table(FEW_UNITS - 1), ["elements", "angle"], "held", "pan").values.shape[1] == 6 * 7
    assert units(table(FEW_UNITS), ["elements", "angle"], "held", "pan").values.shape[1] == FEW_UNITS


@pytest.mark.parametrize("count", [4, 12])
def test_rows_without_effect_are_rarely_told_from_chance_together(count):
    """Of 200 studies of twenty correlated nulls at most one in ten has a row below 0.05, 1/20 meant."""
    rng, told = np.random.default_rng(11), 0
    for _ in range(200):
        values = rng.normal(0, 1, (20, count)) + rng.normal(0, 1, count)
        told += (estimate(np.eye(20), values, rng).p_max_t < MAX_P).any()
    assert told / 200 <= 0.1


def test_an_effect_among_nulls_is_told_from_chance():
    rng = np.random.default_rng(12)
    values = rng.normal(0, 1, (20, 16))
    values[7] += 3
    found = estimate(np.eye(20), values, rng)
    assert found.p_max_t[7] < 0.01 and (np.delete(found.p_max_t, 7) > MAX_P).sum() >= 18


def test_twelve_units_have_intervals_of_students_width():
    """95 % of 400 studies of twelve normal scores."""
    rng, inside = np.random.default_rng(13), 0
    for _ in range(400):
        found = estimate(np.eye(1), rng.normal(0.5, 1, (1, 12)), rng)
        inside += found.low[0] <= 0.5 <= found.high[0]
    assert 0.925 <= inside / 400 <= 0.98


def test_kendalls_tau_is_scipys():
    rng = np.random.default_rng(2)
    a, b = rng.integers(0, 6, (20, 9)).astype(float), rng.integers(0, 6, (20, 9)).astype(float)
    np.testing.assert_allclose(
        kendall_tau(a, b), [stats.kendalltau(*ab).statistic for ab in zip(a, b, strict=True)]
    )


def test_ranks_agree_where_a_detector_scores_all_designs_lower():
    rows, alike = [], {"replicate": 0, "channel": "pan", "status": "finished", "over_time": "{}"}
    for detector, sign in (("ours", 1.0), ("weaker", 0.5), ("upside down", -1.0)):
        for k, design in enumerate("abcd"):
            rows.append(
                {"point": len(rows), "held": sign * k, "detector": detector, "design": design, **alike}
            )
    found = rank_agreement(
        pd.DataFrame(rows), ["detector", "design"], "detector", "held", "pan", np.random.default_rng(0)
    )
    assert list(zip(found["first"], found["second"], found["tau"], strict=True)) == [
        ("ours", "weaker", 1.0), ("ours", "upside down", -1.0), ("weaker", "upside down", -1.0)
    ]  # fmt: skip
    assert set(found["designs"]) == {4} and found["low"].isna().all()
    (shown,) = comparison_tables({"ranks": found.assign(channel="pan", response="tracked_per_km2")})
    assert shown.rows[0] == ("detector: ours and weaker", "tracked vehicles per km²", "pan", "4", "1.00")


def test_ranks_in_the_six_blocks_of_one_flight_have_an_interval():
    """Scores wander from block to block, and the order of the designs with them."""
    rng, rows = np.random.default_rng(4), []
    for detector in ("ours", "another"):
        for k in range(8):
            series = 10.0 * k + rng.normal(0, {"ours": 1.0, "another": 30.0}[detector], 24)
            rows.append(
                {"point": len(rows), "held": series.mean(), "detector": detector, "design": k, "replicate": 0,
                 "channel": "pan", "status": "finished", "over_time": json.dumps({"held": series.tolist()})}
            )  # fmt: skip
    axes = ["detector", "design"]
    (found,) = rank_agreement(pd.DataFrame(rows), axes, "detector", "held", "pan", rng).itertuples()
    assert found.low < found.tau < 1.0 and found.tau - found.low > 0.02
    assert found.high == min(2 * found.tau - found.low, 1.0)


def test_contrasts_in_words():
    of = table().assign(tracked_per_km2=lambda rows: rows["held"], over_time="{}")
    found = all_contrasts(of, ["elements", "angle"], ["tracked_per_km2"], [ADDS], 0)
    (told,) = contrast_tables(found)
    assert told.heads == ("where", "tracked vehicles per km²")
    assert (
        [row[0] for row in told.rows] == ["0", "90", "all"]
        and told.rows[0][1] == "-0.2"
        and told.rows[1][1] == "+0.0"
    )


BASE = "channels = ['pan', 'dolp']\n[flight]\nframes = 8\n"


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"of": {"elements": "all"}, "against": {"elements": "all"}}, "must name `channel`"),
        ({"of": {"channel": "pan", "sensor.pitch_um": 17}, "against": {"channel": "pan"}}, "the same axes"),
        (
            {
                "of": {"channel": "pan", "sensor.pitch_um": 17},
                "against": {"channel": "pan", "sensor.pitch_um": 9},
            },
            "must name values of the study's axes; got sensor.pitch_um = 9",
        ),
        ({"of": {"channel": "pen"}, "against": {"channel": "pan"}}, "got channel = 'pen'"),
    ],
)
def test_a_contrast_of_what_is_not_varied_is_refused(tmp_path, keys, said):
    base = tmp_path / "base.toml"
    base.write_text(BASE)
    values = {"axes": {"sensor.pitch_um": [17, 10.8]}, "contrasts": [{"label": "x", **keys}]}
    with pytest.raises(ValueError, match=said):
        build_plan(validate_design(StudyDesign, values), base)


def test_ranks_under_what_is_not_varied_are_refused():
    with pytest.raises(ValueError, match="`ranked_under` must name axes of the study"):
        StudyDesign(axes={"sensor.pitch_um": [17, 10.8]}, ranked_under=["detector"])


def flights_of_five(replicates, seed, unit=1.0):
    rng = np.random.default_rng(seed)
    rows = [
        {"point": p * replicates + r, "replicate": r, "channel": "pan", "status": "finished", "a": p,
         "over_time": "{}", "tracked_per_km2": 100 * p + unit * rng.normal()}
        for p in range(5) for r in range(replicates)
    ]  # fmt: skip
    return pd.DataFrame(rows)


def aa_tests(table, seed=1):
    return comparisons.aa_test(table, ["a"], "tracked_per_km2", ["pan"], np.random.default_rng(seed))


def test_one_in_twenty_excludes_zero():
    """30 studies of 20 A/A tests: 30 ± 5 of 600, were they independent."""
    excluded = [
        comparisons.aa_test(
            flights_of_five(12, seed), ["a"], "tracked_per_km2", ["pan"], np.random.default_rng(seed)
        )
        for seed in range(30)
    ]
    assert all(len(found) == comparisons.AA_TESTS for found in excluded)
    assert 10 <= sum(found["excludes"].sum() for found in excluded) <= 50


def test_an_interval_that_is_too_short_is_found(monkeypatch):
    honest = comparisons.estimate

    def boastful(fit, values, rng):
        of = honest(fit, values, rng)
        return type(of)(of.value, of.value - 0.2, of.value + 0.2, of.p_max_t)

    monkeypatch.setattr(comparisons, "estimate", boastful)
    found = comparisons.aa_test(
        flights_of_five(12, 1), ["a"], "tracked_per_km2", ["pan"], np.random.default_rng(1)
    )
    assert found["excludes"].sum() > 5


def test_few_flights_are_not_dealt():
    found = comparisons.aa_test(
        flights_of_five(7, 1), ["a"], "tracked_per_km2", ["pan"], np.random.default_rng(1)
    )
    assert found.empty
