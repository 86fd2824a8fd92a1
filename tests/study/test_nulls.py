"""Designs held against themselves: intervals that are honest exclude 0 once in twenty, others oftener."""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportGeneralTypeIssues=false

import numpy as np
import pandas as pd

from glintrack.study import nulls


def table(replicates, seed, unit=1.0):
    rng = np.random.default_rng(seed)
    rows = [
        {"point": p * replicates + r, "replicate": r, "channel": "pan", "status": "finished", "a": p,
         "over_time": "{}", "held_per_km2": 100 * p + unit * rng.normal()}
        for p in range(5) for r in range(replicates)
    ]  # fmt: skip
    return pd.DataFrame(rows)


def test_one_in_twenty_excludes_zero():
    """30 studies of 20 nulls: 30 ± 5 of 600, were they independent."""
    excluded = [
        nulls.relabelled(table(12, seed), ["a"], "held_per_km2", ["pan"], np.random.default_rng(seed))
        for seed in range(30)
    ]
    assert all(len(found) == nulls.NULLS for found in excluded)
    assert 10 <= sum(found["excludes"].sum() for found in excluded) <= 50


def test_an_interval_that_is_too_short_is_found(monkeypatch):
    honest = nulls.estimated

    def boastful(fit, values, rng):
        of = honest(fit, values, rng)
        return type(of)(of.value, of.value - 0.2, of.value + 0.2, of.p_max_t)

    monkeypatch.setattr(nulls, "estimated", boastful)
    found = nulls.relabelled(table(12, 1), ["a"], "held_per_km2", ["pan"], np.random.default_rng(1))
    assert found["excludes"].sum() > 5


def test_few_flights_are_not_dealt():
    found = nulls.relabelled(table(7, 1), ["a"], "held_per_km2", ["pan"], np.random.default_rng(1))
    assert found.empty
