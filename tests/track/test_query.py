"""Queries: one per column, the best first; features tell vehicles apart."""

import itertools

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from glintrack.schema import RADIANCE
from glintrack.track import features, query


def column_of_east(gsd_m=1.5):
    return lambda enu: np.where(enu[:, 0] >= 0, np.floor(enu[:, 0] / gsd_m), -1).astype(int)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 6))
def test_plan_is_the_best_there_is(seed, budget):
    rng = np.random.default_rng(seed)
    position, priority = rng.uniform(-1, 4, (7, 2)), rng.random(7)
    planned = query.plan(position, np.arange(7), priority, column_of_east(1.0), budget)
    columns = column_of_east(1.0)(position)
    best = 0.0
    for size in range(budget + 1):
        for chosen in itertools.combinations(np.nonzero(columns >= 0)[0], size):
            if len(set(columns[list(chosen)])) == size:
                best = max(best, priority[list(chosen)].sum())
    assert sum(q.priority for q in planned) == pytest.approx(best)
    assert len({int(q.east_m) for q in planned}) == len(planned) <= budget


def test_entropy_of_an_even_choice_is_its_logarithm():
    """Two detections and a miss of equal cost: ln 3; a target with no detection at all: 0."""
    entropy = query.association_entropy(np.array([0, 0]), np.array([2.0, 2.0]), np.array([2.0, 1.0]))
    np.testing.assert_allclose(entropy, [np.log(3), 0], atol=1e-12)  # rounding


def test_unknown_and_ambiguous_targets_come_first():
    unknown, known, ambiguous = query.gain(
        np.array([0.0, 0.0, 1.0]), np.array([0.0, 9.0, 9.0]), np.zeros(3, bool)
    )
    assert ambiguous > unknown > known > 0


def test_column_of_must_return_one_column_per_point():
    with pytest.raises(ValueError, match="`column_of` must return one column per point"):
        query.plan(np.zeros((2, 2)), np.arange(2), np.ones(2), lambda enu: np.zeros(1, int), 5)


def spectra_of(radiance, position, served=None, noise=1e-3):
    wavelength = np.linspace(0.4, 1.0, radiance.shape[1])
    n = len(radiance)
    return xr.Dataset(
        {
            "radiance": (("query", "wavelength"), radiance, {"units": RADIANCE}),
            "noise": (("query", "wavelength"), np.full(radiance.shape, noise), {"units": RADIANCE}),
            "served": ("query", np.ones(n) if served is None else served, {"units": "1"}),
            "track_id": ("query", np.full(n, -1.0), {"units": "1"}),
            "east": ("query", position[:, 0], {"units": "m"}),
            "north": ("query", position[:, 1], {"units": "m"}),
        },
        coords={"wavelength": ("wavelength", wavelength, {"units": "um"})},
    )


def test_shade_leaves_the_feature_as_it_is():
    spectrum = np.linspace(1, 3, 61)[None]
    both = np.concatenate([spectrum, 0.2 * spectrum])
    _, f = features.of_spectra(spectra_of(both, np.zeros((2, 2))), 8)
    np.testing.assert_allclose(f[0], f[1], atol=1e-12)  # rounding


def test_unserved_and_missing_spectra_are_left_out():
    radiance = np.ones((3, 61))
    radiance[1] = np.nan
    where, f = features.of_spectra(spectra_of(radiance, np.eye(3)[:, :2], np.array([1.0, 1.0, 0.0])), 8)
    assert f.shape == (1, 8) and where.tolist() == [[1, 0]]


def test_detection_gets_the_nearest_spectrum_within_the_radius():
    got = features.attach(
        np.array([[0.0, 0.0], [1.0, 0.0], [50.0, 0.0]]),
        np.array([[1.0], [2.0], [3.0]]),
        np.array([[1.2, 0.0], [40.0, 0.0]]),
        2.5,
    )
    assert got[0, 0] == 2.0 and np.isnan(got[1, 0])


def test_own_spectrum_speaks_for_and_others_against():
    """Six kinds of paint with 2 % noise: the ratio has the right sign nearly always."""
    rng = np.random.default_rng(0)
    paints = rng.normal(0, 0.5, (6, 8))
    kind = rng.integers(6, size=400)
    f = paints[kind] + rng.normal(0, 0.02, (400, 8))
    count = np.zeros(400)
    population = features.learn(features.empty_population(8), f[:200], np.zeros((200, 8)), count[:200])
    population = features.learn(population, f[200:300], paints[kind[200:300]], count[:100] + 5)
    new, other = f[300:], (kind[300:] + 1) % 6
    five = np.full(100, 5.0)
    own = features.log_likelihood_ratio(population, paints[kind[300:]], five, new, 0.35, 6.0)
    wrong = features.log_likelihood_ratio(population, paints[other], five, new, 0.35, 6.0)
    assert (own > 0).mean() > 0.95 and (wrong < 0).mean() > 0.95
    assert np.abs(wrong).max() <= 6.0


def test_nothing_is_said_without_spectra():
    population = features.empty_population(3)
    out = features.log_likelihood_ratio(
        population, np.zeros((2, 3)), np.ones(2), np.full((2, 3), np.nan), 0.3, 6.0
    )
    assert out.tolist() == [0.0, 0.0]
