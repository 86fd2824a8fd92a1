"""Searches on simulated scores: 300 designs, each simulated once for 12 s, are the grid that they replay.

`docs/findings/optimize_grid.csv` has the scores. To repeat it:

    glintrack study docs/findings/optimize_grid.toml
    python -m tests.study.optimize.recorded study-grid docs/findings/optimize_grid.csv

A quadratic response surface is fitted to the simulations, with an effect of each city. A simulation of a
search draws a recorded city at random, and the residual of one of its recorded designs near by. Nothing
about the distribution or size of the noise is assumed. The true score of a design is the mean of all scores
that can be drawn.
"""

import sys
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
from sklearn.linear_model import LinearRegression, PoissonRegressor
from sklearn.preprocessing import PolynomialFeatures

from glintrack.metrics.requirement import SHARES, read_requirement
from glintrack.study import read_results
from glintrack.study.optimize import Problem

TABLE = Path(__file__).parents[3] / "docs" / "findings" / "optimize_grid.csv"
AXES = {"sensor.pitch_um": True, "flight.rate_hz": True, "flight.off_nadir_deg": False}  # logarithmic or not
SCORES = ("completeness_visible", "custody", "purity", "false_per_km2")
COST = "data_rate_mbit_s"
NEIGHBOURS = 6  # recorded designs of a city whose residuals a design may have


@cache
def read_grid():
    """Places from 0 to 1 of the designs, their cities, and the table."""
    table = pd.read_csv(TABLE)
    columns = [np.log(table[name]) if log else table[name] for name, log in AXES.items()]
    places = np.column_stack([(one - one.min()) / np.ptp(one) for one in columns])
    return places, table["city"].to_numpy() - 1, table


@cache
def fit_surface(score):
    """Score of each design as a mean over cities, deviation of each city, and residual of each simulation.

    Counts and rates have a logarithmic link; their deviations and residuals are relative.
    """
    places, cities, table = read_grid()
    scores = table[score].to_numpy()
    terms = PolynomialFeatures(2, include_bias=False).fit_transform(2 * places - 1)
    own = np.eye(cities.max() + 1)[cities]
    features = np.column_stack([terms, own[:, 1:] - own[:, :1]])
    is_share = score in SHARES
    model = LinearRegression() if is_share else PoissonRegressor(alpha=0, max_iter=1000)
    model.fit(features, scores)
    count, coefficients = len(own[0]), model.coef_[terms.shape[1] :]
    effects = np.append(-coefficients.sum(), coefficients) * np.sqrt(count / (count - 1))
    surface = model.predict(np.column_stack([terms, np.zeros((len(terms), count - 1))]))
    lost = np.sqrt(len(scores) / (len(scores) - features.shape[1] - 1))
    if is_share:
        return surface, effects, (scores - model.predict(features)) * lost
    effects = np.exp(effects)
    return surface * effects.mean(), effects / effects.mean(), (scores / model.predict(features) - 1) * lost


class RecordedGrid:
    """Recorded grid as the function that `find_cheapest` calls.

    Parameters
    ----------
    limits
        Texts of the requirements.
    seed
        Seed of the search's cities and simulations.
    """

    def __init__(self, limits, seed=0):
        self.places, self.recorded, table = read_grid()
        self.cost, self.seed, self.count = table[COST].to_numpy(), seed, 0
        self.requirements = tuple(read_requirement(text) for text in limits)
        self.fits = [fit_surface(one.score) for one in self.requirements]
        every = [self._all_scores(design) for design in range(len(self.places))]
        self.means = np.array([[one.mean() for one in scores] for scores in every])

    def problem(self, **more):
        """Problem of the grid, of simulations of one duration."""
        return Problem(self.places, self.cost, self.requirements, **{"durations_s": (12.0,), **more})

    def near(self, design):
        """Recorded designs of each city that are closest to a design: city, neighbour."""
        distance = np.linalg.norm(self.places - self.places[design], axis=1)
        cities = range(self.recorded.max() + 1)
        return np.array(
            [np.argsort(np.where(self.recorded == k, distance, np.inf))[:NEIGHBOURS] for k in cities]
        )

    def _all_scores(self, design):
        """Scores that a simulation of a design may have, for each requirement: city, neighbour."""
        near, out = self.near(design), []
        for requirement, (surface, effects, residuals) in zip(self.requirements, self.fits, strict=True):
            residual, effect = residuals[near] - residuals[near].mean(), effects[:, None]
            relative = surface[design] * effect * (1 + residual)
            is_share = requirement.score in SHARES
            out.append(surface[design] + effect + residual if is_share else np.maximum(relative, 0.0))
        return out

    def simulate(self, designs, cities, fidelity):
        """Scores of designs in cities."""
        self.count += len(designs) * len(cities)
        out = np.empty((len(designs), len(cities), len(self.fits)))
        for i, design in enumerate(designs):
            every = self._all_scores(design)
            for j, city in enumerate(cities):
                k = np.random.default_rng((self.seed, city)).integers(len(every[0]))
                n = np.random.default_rng((self.seed, design, city)).integers(NEIGHBOURS)
                out[i, j] = [scores[k, n] for scores in every]
        return out

    @property
    def feasible(self):
        """Whether each design meets all requirements in the mean over all cities."""
        limits = np.array([one.limit for one in self.requirements])
        rising = np.array([one.at_least for one in self.requirements])
        return np.where(rising, self.means >= limits, self.means <= limits).all(axis=1)


def tabulate(folder):
    """Table of a study's folder."""
    found, _ = read_results(Path(folder))
    found = found[found["status"] == "finished"]
    return found[[*AXES, "city", COST, *SCORES]]


if __name__ == "__main__":
    tabulate(sys.argv[1]).to_csv(sys.argv[2], index=False, float_format="%.5g")
