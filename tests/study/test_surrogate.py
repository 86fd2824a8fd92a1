"""Response surfaces, on scores whose law is known, and against Student's interval in closed form."""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from glintrack.study.analysis import continuous_axes, cross_validate, fit_surface, surrogates

AXES, LOG = ("pitch", "angle"), ("pitch",)


def flights(count, noise, seed=3):
    """Scores of a known quadratic over two axes, the first even in its logarithm."""
    rng = np.random.default_rng(seed)
    at = np.stack([10 ** rng.uniform(0, 1, count), rng.uniform(0, 50, count)], axis=-1)
    x, y = 2 * np.log10(at[:, 0]) - 1, at[:, 1] / 25 - 1
    return at, 100 - 20 * x + 5 * y - 8 * x * y + 3 * y**2 + noise * rng.normal(0, 1, count)


def table(at, score):
    """Rows as a study's table has them."""
    rows = pd.DataFrame(at, columns=AXES)
    return rows.assign(
        point=range(len(at)), replicate=0, channel="pan", status="finished", tracked_per_km2=score
    )


def test_a_quadratic_without_noise_is_found_exactly():
    at, score = flights(30, noise=0.0)
    surface = fit_surface(AXES, at[:20], score[:20], LOG)
    assert surface is not None and surface.quadratic and surface.log == (True, False)
    predicted, low, high = surface.predict(at[20:])
    np.testing.assert_allclose(predicted, score[20:], rtol=1e-9)
    assert np.all(high - low < 1e-6)


def test_the_interval_along_a_straight_line_is_students():
    """One axis, straight: ŷ ± t s √(1 + 1/n + (x − x̄)²/Σ(x − x̄)²)."""
    rng = np.random.default_rng(5)
    x = np.array([2.0, 3.0, 4.0, 5.0])  # too few for a square
    y = 1 + 2 * x + rng.normal(0, 1, 4)
    surface = fit_surface(("pitch",), x[:, None], y)
    assert surface is not None and not surface.quadratic
    at = 4.3
    line = stats.linregress(x, y)
    rest = y - line.intercept - line.slope * x
    s = np.sqrt((rest**2).sum() / 2)
    reach = stats.t.ppf(0.95, 2) * s * np.sqrt(1 + 1 / 4 + (at - x.mean()) ** 2 / ((x - x.mean()) ** 2).sum())
    predicted, low, high = surface.predict(np.array([[at]]))
    assert predicted[0] == pytest.approx(line.intercept + line.slope * at)
    assert (low[0], high[0]) == pytest.approx((predicted[0] - reach, predicted[0] + reach))


def test_intervals_hold_new_flights_as_often_as_they_say():
    """90 % of 40 studies' new flights; the standard error of that share is under 2 % of 40 × 50."""
    inside = []
    for seed in range(40):
        at, score = flights(90, noise=4.0, seed=seed)
        surface = fit_surface(AXES, at[:40], score[:40], LOG)
        assert surface is not None
        _, low, high = surface.predict(at[40:])
        inside.append(np.mean((score[40:] >= low) & (score[40:] <= high)))
    assert 0.88 <= np.mean(inside) <= 0.92


def test_replicates_are_left_out_together():
    """A design that differs from all others is not predicted by its own replicates."""
    at, score = flights(40, noise=0.1)
    at, score = np.repeat(at, 2, axis=0), np.repeat(score, 2)
    design = np.repeat(np.arange(40), 2)
    score[design == 7] += 500
    left = cross_validate(AXES, at, score, design, LOG)
    assert np.all(np.abs(left[design == 7, 0] - score[design == 7]) > 400)


def test_a_table_says_how_well_flights_left_out_are_predicted():
    at, score = flights(60, noise=4.0)
    lines, check = surrogates(table(at, score), AXES, "tracked_per_km2", "pan", LOG)
    assert set(lines["axis"]) == set(AXES) and len(lines) == 18
    told = check.iloc[0]
    assert told["flights"] == 60 and told["terms"] == 6
    assert 3 < told["error"] < 6 < told["spread"]  # the noise of 4, and what six coefficients add
    assert told["coverage_low"] <= 0.9 <= told["coverage_high"]
    pitch = lines[lines["axis"] == "pitch"]["predicted"].to_numpy()
    assert np.all(np.diff(pitch) < 0)  # in the middle of the angles the score falls with pitch


def test_chance_and_words_are_no_axes_of_a_surface():
    rows: pd.DataFrame = table(*flights(60, noise=1.0)).assign(seed=range(60), haze="clear", trees=True)
    assert continuous_axes(rows[[*AXES, "seed", "haze", "trees"]]) == list(AXES)


def test_too_few_flights_make_no_surrogate():
    at, score = flights(4, noise=1.0)
    lines, check = surrogates(table(at, score), AXES, "tracked_per_km2", "pan", LOG)
    assert lines.empty and check.empty
