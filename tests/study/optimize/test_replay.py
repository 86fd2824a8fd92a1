"""Searches replayed on a recorded grid: how often a claim is true, its cost, its simulations.

python -m tests.study.optimize.test_replay 100 100    # number of searches, first seed
"""

import sys

import numpy as np
import pandas as pd
import pytest

from glintrack.study.optimize import find_cheapest
from tests.study.optimize.recorded import RecordedGrid

SPECS = {
    "shares": ("all.custody>=0.7", "all.completeness_visible>=0.8"),
    "rate": ("all.completeness_visible>=0.8", "all.false_per_km2<=60"),
}


def replay(name, count, first=0):
    """Answer, truth, cost over that of the cheapest feasible design, and number of simulations."""
    rows = []
    for seed in range(first, first + count):
        stored = RecordedGrid(SPECS[name], seed)
        found = find_cheapest(stored.problem(), stored.simulate)
        ratio = stored.cost[found.design] / stored.cost[stored.feasible].min()
        rows.append((found.answer, bool(stored.feasible[found.design]), ratio, stored.count))
    return pd.DataFrame(rows, columns=["answer", "true", "ratio", "simulations"])


@pytest.mark.parametrize("name", SPECS)
def test_the_mean_of_many_simulations_is_the_true_score(name):
    stored = RecordedGrid(SPECS[name], 5)
    designs = [*map(int, (stored.cost.argmin(), stored.cost.argmax())), 40]
    scores = stored.simulate(designs, range(1000), 0)
    error = scores.std(axis=1) / np.sqrt(scores.shape[1])
    assert (np.abs(scores.mean(axis=1) - stored.means[designs]) < 4 * error).all()


@pytest.mark.parametrize("name", SPECS)
def test_claims_of_replayed_searches_are_cheap_and_few_are_false(name):
    rows = replay(name, 4)
    claimed = rows[rows["answer"] == "yes"]
    assert len(claimed) >= 2 and claimed["true"].mean() >= 0.5
    assert claimed["ratio"].median() <= 2 and rows["simulations"].max() <= 60


if __name__ == "__main__":
    for spec in SPECS:
        found = replay(spec, *map(int, sys.argv[1:]))
        claims, feasible = found[found["answer"] == "yes"], RecordedGrid(SPECS[spec]).feasible
        print(
            f"{spec}: {feasible.sum()} of {len(feasible)} designs feasible; {len(claims)} of {len(found)} "
            f"searches claim a design, {claims['true'].mean():.3f} of the claims true, median cost "
            f"{claims['ratio'].median():.3f} times the cheapest, median "
            f"{found['simulations'].median():.0f} simulations, at most {found['simulations'].max()}"
        )
