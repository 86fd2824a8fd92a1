"""Queries: one per column, the best first; features tell vehicles apart."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from glintrack import track
from glintrack.core.schema import RADIANCE
from glintrack.track import identity, queries
from glintrack.track.flow import no_flow
from glintrack.track.initiation import initiate
from tests.plain import plain_tracker


def column_of_east(gsd_m=1.5):
    return lambda enu: np.where(enu[:, 0] >= 0, np.floor(enu[:, 0] / gsd_m), -1).astype(int)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 6), st.integers(1, 3))
def test_plan_is_the_best_there_is(seed, budget, spots):
    """Against every set of targets, and every choice of places for it."""
    rng = np.random.default_rng(seed)
    columns, priority = rng.integers(-1, 4, (6, spots)), rng.integers(0, 4, 6) + rng.choice([0, 0.5], 6)
    place = queries.match_columns(columns, priority, budget)
    hit = np.nonzero(place >= 0)[0]
    taken = columns[hit, place[hit]]
    assert len(hit) <= budget and (taken >= 0).all() and len(set(taken)) == len(taken)

    best = 0.0
    for size in range(budget + 1):
        for chosen in itertools.combinations(range(6), size):
            for choice in itertools.product(*(columns[k] for k in chosen)):
                if min(choice, default=0) >= 0 and len(set(choice)) == size:
                    best = max(best, priority[list(chosen)].sum())
    assert priority[hit].sum() == pytest.approx(best)


def test_a_car_makes_room_where_it_can():
    """Two cars in one column; the better one reaches into the next, so that both are asked."""
    spots = queries.candidate_points(
        np.array([[1.4, 0.0], [1.2, 9.0]]),
        np.array([[8.0, 0.0], [0.0, 8.0]]),
    )
    planned = queries.plan(spots, np.arange(2), np.array([2.0, 1.0]), column_of_east(1.5), 5)
    assert [q.track_id for q in planned] == [0, 1]
    assert [int(q.east_m // 1.5) for q in planned] == [1, 0]
    alone = queries.plan(spots[:, :1], np.arange(2), np.array([2.0, 1.0]), column_of_east(1.5), 5)
    assert [q.track_id for q in alone] == [0]


def test_who_stands_is_asked_at_the_centre():
    spots = queries.candidate_points(np.zeros((1, 2)), np.array([[0.1, 0.0]]))
    assert not spots.any()


def test_risk_is_how_often_a_detection_goes_to_the_rival():
    """Two Gaussian tracks with spectra in three numbers, associated at least cost."""
    rng = np.random.default_rng(5)
    draws, sigma, apart, unlike = 200_000, 0.8, 1.5, 1.2
    one = rng.normal(0, sigma, (draws, 2))
    other = rng.normal([apart, 0], sigma, (draws, 2))
    spectrum = rng.normal(0, 1, (draws, 3))  # of the first; the second's differs by `unlike` in one number

    def cost(z, centre):
        return 0.5 * ((z - np.array([centre, 0])) ** 2).sum(axis=1) / sigma**2

    look = 0.5 * ((spectrum - [unlike, 0, 0]) ** 2 - spectrum**2).sum(axis=1)  # what the wrong one costs more
    apart2, alike2 = np.full(1, apart**2 / (2 * sigma**2)), np.full(1, unlike**2)
    exchanged = cost(one, apart) + cost(other, 0) + look < cost(one, 0) + cost(other, apart)
    taken = cost(one, apart) + look < cost(one, 0)
    spread = 4 / np.sqrt(draws)  # four standard deviations of a share are less
    assert queries.association_risk(apart2, alike2, np.ones(1))[0] == pytest.approx(
        exchanged.mean(), abs=spread
    )
    assert queries.association_risk(apart2, alike2, np.zeros(1))[0] == pytest.approx(taken.mean(), abs=spread)


def targets_at(position, spectra, feature, design, sigma_m=1.0):
    """Confirmed targets that stand, each with a number of spectra of one mean feature."""
    n = len(position)
    found = track.Detections(position, np.repeat(sigma_m**2 * np.eye(2)[None], n, 0), np.ones(n), np.ones(n))
    new = initiate(design, found, np.full((n, identity.BINS), np.nan), np.arange(n), 0, no_flow())
    return replace(
        new,
        confirmed=np.ones(n, bool),
        spectra=np.asarray(spectra, float),
        feature=np.asarray(feature, float),
    )


def six_paints(bins=8):
    rng = np.random.default_rng(0)
    paints = rng.normal(0, 0.5, (6, bins))
    kind = rng.integers(6, size=400)
    f = paints[kind] + rng.normal(0, 0.02, (400, bins))
    population = identity.update_population(
        identity.empty_population(bins), f[:200], np.zeros((200, bins)), np.zeros(200)
    )
    return paints, identity.update_population(population, f[200:], paints[kind[200:]], np.full(200, 5.0))


def test_who_may_be_confused_with_an_unlike_vehicle_is_worth_most():
    """Pairs 1.5 m apart: unlike, alike; then one alone, and one that is hidden beside an unlike one."""
    design = plain_tracker()
    paints, population = six_paints()
    place = np.array([[0, 0], [1.5, 0], [50, 0], [51.5, 0], [90, 0], [130, 0], [131.5, 0]], float)
    targets = targets_at(place, [9] * 7, paints[[0, 1, 2, 2, 3, 4, 5]], design)
    detected = np.array([0.9] * 5 + [0.0, 0.9])
    unlike, _, alike, _, alone, hidden, beside = queries.prediction_gain(
        targets, detected, population, design
    )
    assert unlike > 5 * alike and alike > 1.5 * alone > 0
    assert hidden == 0 and beside > alike
    assert (
        len(
            queries.prediction_gain(
                targets_at(np.empty((0, 2)), [], np.empty((0, 8)), design), np.empty(0), population, design
            )
        )
        == 0
    )


def test_the_first_spectrum_is_worth_more_than_the_tenth():
    design = plain_tracker()
    paints, population = six_paints()
    place = np.array([[0, 0], [1.5, 0]], float)
    without = targets_at(place, [0, 0], np.zeros((2, 8)), design)
    alike = targets_at(place, [9, 9], paints[[0, 0]], design)
    detected = np.full(2, 0.9)
    assert (
        queries.prediction_gain(without, detected, population, design)[0]
        > 5 * queries.prediction_gain(alike, detected, population, design)[0]
    )


def test_separation_is_twice_the_expected_log_likelihood_ratio(monkeypatch):
    monkeypatch.setattr(identity, "MAX_RATIO_NAT", 1e9)
    paints, population = six_paints()
    rng = np.random.default_rng(1)
    many, mean = np.full(4000, 1e6), np.repeat(paints[:1], 4000, axis=0)
    ratio, basis = identity.axes(population)  # spectra as the population has learnt they spread
    new = paints[0] + rng.normal(0, np.sqrt(ratio), (4000, 8)) @ np.linalg.inv(basis)
    other = np.repeat(paints[:1] + 0.01, 4000, axis=0)
    own = identity.log_likelihood_ratio(population, mean, many, new)
    wrong = identity.log_likelihood_ratio(population, other, many, new)
    along = [(one[:1] - population.mean) @ basis for one in (mean, other)]
    none = np.zeros(1)
    expected = identity.divergence2((along[0], many[:1]), (along[1], many[:1]), ratio)[0]
    noise = 3 * np.std(2 * (own - wrong)) / np.sqrt(len(own))
    assert 2 * (own - wrong).mean() == pytest.approx(expected, abs=noise)
    anybody = identity.divergence2((along[0], many[:1]), (along[1], none), ratio)[0]
    assert 2 * own.mean() == pytest.approx(anybody, rel=0.05)
    assert identity.divergence2((along[0], none), (along[1], none), ratio) == 0


def test_a_spectrum_that_may_be_the_grounds_says_less():
    """Nothing is lost where none is; else evidence is bounded below, and that of the ground is none."""
    ratio = np.array([-6.0, 0.0, 6.0])
    same, share = identity.outlier_mixture(ratio, np.zeros(3), 0.0)
    np.testing.assert_allclose(same, ratio, atol=1e-12)  # rounding
    np.testing.assert_allclose(share, 1.0)
    less, share = identity.outlier_mixture(ratio, np.zeros(3), 0.3)
    assert np.log(0.3) < less[0] < 0 == less[1] < less[2] < 6
    np.testing.assert_allclose(share[1], 0.7)
    nothing, share = identity.outlier_mixture(ratio, np.full(3, 30.0), 0.3)
    np.testing.assert_allclose(nothing, 0.0, atol=1e-9)  # e⁻³⁰
    assert share.max() < 1e-9


def test_the_ground_is_told_from_vehicles():
    """Six paints and a road of one colour: the ratio has the right sign, and none without both."""
    rng = np.random.default_rng(3)
    paints, population = six_paints()
    road = rng.normal(0, 0.5, 8)
    seen = road + rng.normal(0, 0.02, (40, 8))
    ground = identity.update_population(identity.empty_population(8), seen, np.zeros((40, 8)), np.zeros(40))
    assert (identity.ground_ratio(population, ground, road + rng.normal(0, 0.02, (50, 8))) > 3).all()
    assert (identity.ground_ratio(population, ground, paints) < -3).all()
    assert identity.ground_ratio(population, ground, np.full((1, 8), np.nan)) == 0
    assert not identity.ground_ratio(population, identity.empty_population(8), paints).any()


def test_the_ground_is_asked_for_ahead_where_nobody_is():
    """Eastward at 5 m/s with the road free, behind another, standing, and not yet confirmed."""
    design = plain_tracker()
    place = np.array([[0, 0], [50, 0], [59, 0], [0, 80], [40, 80]], float)
    targets = targets_at(place, [0] * 5, np.zeros((5, 8)), design)
    mean = targets.mean.copy()
    mean[[0, 1, 2, 4], 2] = 5.0
    targets = replace(targets, mean=mean, confirmed=np.array([True, True, True, True, False]))
    points = queries.ground_points(targets, 9, np.random.default_rng(0))
    assert sorted(points[:, 0]) == [8.0, 67.0] and not points[:, 1].any()
    assert len(queries.ground_points(targets, 1, np.random.default_rng(0))) == 1
    nobody = targets_at(np.empty((0, 2)), [], np.empty((0, 8)), design)
    assert len(queries.ground_points(nobody, 3, np.random.default_rng(0))) == 0


def test_column_of_must_return_one_column_per_point():
    with pytest.raises(ValueError, match="`column_of` must return one column per point"):
        queries.plan(np.zeros((2, 1, 2)), np.arange(2), np.ones(2), lambda enu: np.zeros(1, int), 5)


def spectra_of(radiance, position, served=None, noise=1e-3):
    wavelength = np.linspace(0.4, 1.0, radiance.shape[1])
    n = len(radiance)
    return xr.Dataset(
        {
            "radiance": (("query", "wavelength"), radiance, {"units": RADIANCE}),
            "noise": (("query", "wavelength"), np.full(radiance.shape, noise), {"units": RADIANCE}),
            "served": ("query", np.ones(n, bool) if served is None else served, {"units": "1"}),
            "track_id": ("query", np.full(n, -1.0), {"units": "1"}),
            "east_m": ("query", position[:, 0], {"units": "m"}),
            "north_m": ("query", position[:, 1], {"units": "m"}),
        },
        coords={"wavelength": ("wavelength", wavelength, {"units": "um"})},
    )


def test_shade_leaves_the_feature_as_it_is():
    spectrum = np.linspace(1, 3, 61)[None]
    both = np.concatenate([spectrum, 0.2 * spectrum])
    _, f = identity.spectral_features(spectra_of(both, np.zeros((2, 2))), 8)
    np.testing.assert_allclose(f[0], f[1], atol=1e-12)  # rounding


def test_unserved_and_missing_spectra_are_left_out():
    radiance = np.ones((3, 61))
    radiance[1] = np.nan
    where, f = identity.spectral_features(
        spectra_of(radiance, np.eye(3)[:, :2], np.array([True, True, False])), 8
    )
    assert f.shape == (1, 8) and where.tolist() == [[1, 0]]


def test_detection_gets_the_nearest_spectrum_within_the_radius():
    got = identity.attach(
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
    population = identity.update_population(
        identity.empty_population(8), f[:200], np.zeros((200, 8)), count[:200]
    )
    population = identity.update_population(population, f[200:300], paints[kind[200:300]], count[:100] + 5)
    new, other = f[300:], (kind[300:] + 1) % 6
    five = np.full(100, 5.0)
    own = identity.log_likelihood_ratio(population, paints[kind[300:]], five, new)
    wrong = identity.log_likelihood_ratio(population, paints[other], five, new)
    assert (own > 0).mean() > 0.95 and (wrong < 0).mean() > 0.95
    assert np.abs(wrong).max() <= 6.0


def test_nothing_is_said_without_spectra():
    population = identity.empty_population(3)
    out = identity.log_likelihood_ratio(population, np.zeros((2, 3)), np.ones(2), np.full((2, 3), np.nan))
    assert out.tolist() == [0.0, 0.0]


def test_moments_of_the_population_are_numpys():
    """Learnt in three batches, the middle one empty: mean and covariance as of all at once."""
    rng = np.random.default_rng(2)
    f = rng.normal(size=(50, 4)) @ rng.normal(size=(4, 4)) + 3
    population = identity.empty_population(4)
    for batch in (f[:20], f[20:20], f[20:]):
        n = len(batch)
        population = identity.update_population(population, batch, np.zeros((n, 4)), np.zeros(n))
    np.testing.assert_allclose(population.mean, f.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(population.scatter / 49, np.cov(f.T), rtol=1e-9)
