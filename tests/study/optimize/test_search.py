"""The search on stored grids whose answer is known, and the Gaussian process against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.stats import qmc

from glintrack.metrics.requirement import read_requirement
from glintrack.study.optimize import Problem, find_cheapest
from glintrack.study.optimize.surrogate import fit_gaussian_process, matern
from tests.study.optimize.cameras import Grid


def grid(seed, best=0.85):
    """300 designs of two axes: custody rises with both, false tracks fall."""
    places = qmc.Halton(2, rng=np.random.default_rng(seed)).random(300)
    custody = 0.25 + (best - 0.25) * (1 - np.exp(-2 * places.mean(axis=1)))
    means = np.column_stack([custody, 25 - 20 * places[:, 0] + 10 * places[:, 1]])
    limits = ("custody>=0.6", "false_per_km2<=20")
    return Grid(places, 1 + places @ [2.0, 3.0], means, limits, (0.05, 0.15), (0.04, 0.15), seed)


def test_the_posterior_is_that_of_the_textbook():
    """Eqs. (2.41) and (2.42) of Rasmussen and Williams, with the covariance that was fitted."""
    rng = np.random.default_rng(1)
    places, cities = rng.random((20, 2)), np.arange(20) % 4
    scores = 3 + np.sin(3 * places[:, 0]) + 0.3 * cities + rng.normal(0, 0.05, 20)
    fitted = fit_gaussian_process(places, cities, np.zeros(20, int), scores)
    scaled = np.column_stack([places, np.zeros(20)]) / fitted.lengths
    covariance = fitted.signal_variance * matern(cdist(scaled, scaled))
    covariance += fitted.city_sd**2 * (cities[:, None] == cities) + fitted.noise_sd**2 * np.eye(20)
    at = rng.random((5, 2))
    cross = fitted.signal_variance * matern(
        cdist(np.column_stack([at, np.zeros(5)]) / fitted.lengths, scaled)
    )
    mean, sd = fitted.predict(at)
    ones = np.linalg.solve(covariance, np.ones(20))
    level = ones @ scores / ones.sum()  # by generalized least squares: nothing is known of it before
    np.testing.assert_allclose(mean, level + cross @ np.linalg.solve(covariance, scores - level), rtol=1e-3)
    gone = np.einsum("mi,im->m", cross, np.linalg.solve(covariance, cross.T))
    variance = fitted.signal_variance - gone + (1 - cross @ ones) ** 2 / ones.sum()
    np.testing.assert_allclose(sd, np.sqrt(variance), rtol=1e-2)
    assert 0.02 < fitted.noise_sd < 0.15 and 0.1 < fitted.city_sd < 1.5  # of 0.05, and of 0.34


def test_the_level_of_few_cities_is_uncertain():
    errors = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        places, cities = rng.random((24, 1)), np.arange(24) % 6
        scores = 2 + rng.normal(0, 1.0, 6)[cities] + rng.normal(0, 0.2, 24)
        mean, sd = fit_gaussian_process(places, cities, np.zeros(24), scores).predict(np.array([[0.5]]))
        errors.append((mean[0] - 2) / sd[0])
    assert 0.7 < np.std(errors) < 1.4


def test_noise_of_short_simulations_has_the_larger_variance():
    rng = np.random.default_rng(2)
    places, cities, halvings = rng.random((80, 1)), np.arange(80) % 8, np.repeat([0.0, 2.0], 40)
    scores = places[:, 0] + rng.normal(0, 0.1, 80) * 2 ** (halvings / 2)
    fitted = fit_gaussian_process(places, cities, halvings, scores)
    assert 0.07 < fitted.noise_sd < 0.13
    assert fitted.inverse[0, 0] > 2 * fitted.inverse[-1, -1]


def test_a_predicted_rate_is_the_mean_not_the_median():
    stored = grid(4)
    found = find_cheapest(stored.problem(simulations=200, cities=20), stored.simulate)
    mean, sd = found.processes[1].predict(stored.places)
    errors = (mean - np.log1p(stored.means[:, 1]))[sd < np.median(sd)]
    assert abs(errors.mean()) < 0.1


def test_the_cheapest_design_is_found_and_confirmed_over_unseen_cities():
    stored = grid(3)
    found = find_cheapest(stored.problem(), stored.simulate)
    assert found.answer == "yes" and stored.feasible[found.design]
    assert stored.cost[found.design] <= 1.35 * stored.cost[stored.feasible].min()
    assert stored.count <= 60
    used = set(found.observations.city[found.observations.design != found.design].tolist())
    assert len(found.confirming) == 6 and not used & set(found.confirming)


def test_requirements_beyond_all_designs_are_not_met():
    stored = grid(1, best=0.5)
    found = find_cheapest(stored.problem(), stored.simulate)
    assert found.answer == "no" and found.feasibility.max() < 0.1 and stored.count <= 60


def test_a_small_budget_is_refused_before_the_first_simulation():
    stored = grid(1)
    with pytest.raises(ValueError, match="`simulations` must be at least 12 for 2 axes"):
        find_cheapest(stored.problem(simulations=11), stored.simulate)
    assert stored.count == 0


def test_a_score_that_no_simulation_has_is_named():
    stored = grid(1)
    with pytest.raises(ValueError, match="`require` must name scores of the simulations; got custody"):
        find_cheapest(stored.problem(), lambda *where: stored.simulate(*where) * [np.nan, 1])


def test_designs_that_lack_a_score_are_neither_found_nor_confirmed():
    """As designs that track nothing lack the identity of their tracks, and have no false ones."""
    rng = np.random.default_rng(1)
    place = rng.permutation((np.arange(64) + 0.5) / 64)
    needed = [read_requirement("same_track_after_10s>=0.8"), read_requirement("false_per_km2<=20")]
    problem = Problem(
        places=place[:, None],
        cost=100 * place,
        requirements=tuple(replace(one, channel="pan") for one in needed),
        simulations=60,
    )

    def simulate(designs, cities, fidelity):
        scores = np.full((len(designs), len(cities), 2), [np.nan, 0.0])
        seen = place[list(designs)] > 0.3
        scores[seen] = [0.9, 10] + rng.normal(0, [0.01, 1], (seen.sum(), len(cities), 2))
        return scores

    found = find_cheapest(problem, simulate)
    assert found.answer == "yes" and 0.3 < place[found.design] < 0.5
