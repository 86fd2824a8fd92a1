"""Queries: one per column, the best first; features tell vehicles apart."""

import itertools

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from glintrack.scene import load_materials
from glintrack.schema import RADIANCE
from glintrack.track import features, query


def column_of_east(gsd_m=1.5):
    return lambda enu: np.where(enu[:, 0] >= 0, np.floor(enu[:, 0] / gsd_m), -1).astype(int)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 6), st.integers(1, 3))
def test_plan_is_the_best_there_is(seed, budget, spots):
    """Against every set of targets, and every choice of places for it."""
    rng = np.random.default_rng(seed)
    columns, priority = rng.integers(-1, 4, (6, spots)), rng.integers(0, 4, 6) + rng.choice([0, 0.5], 6)
    place = query.transversal(columns, priority, budget)
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
    spots = query.places(np.array([[1.4, 0.0], [1.2, 9.0]]), np.array([[8.0, 0.0], [0.0, 8.0]]), 1.2)
    planned = query.plan(spots, np.arange(2), np.array([2.0, 1.0]), column_of_east(1.5), 5)
    assert [q.track_id for q in planned] == [0, 1]
    assert [int(q.east_m // 1.5) for q in planned] == [1, 0]
    alone = query.plan(spots[:, :1], np.arange(2), np.array([2.0, 1.0]), column_of_east(1.5), 5)
    assert [q.track_id for q in alone] == [0]


def test_who_stands_is_asked_at_the_centre():
    spots = query.places(np.zeros((1, 2)), np.array([[0.1, 0.0]]), 1.2)
    assert not spots.any()


def test_contention_counts_the_rivals():
    """Two tracks 2 m apart with 1 m each: d² = 4 / (1 + 1); a third far off has none; a crowd counts 1.5."""
    mean = np.array([[0.0, 0, 0, 0], [2.0, 0, 0, 0], [90.0, 0, 0, 0]])
    covariance = np.repeat(np.eye(4)[None], 3, axis=0)
    rivals = query.contention(mean, covariance, 13.8)
    np.testing.assert_allclose(rivals, [np.exp(-1), np.exp(-1), 0.0])
    crowd = query.contention(np.zeros((5, 4)), np.repeat(np.eye(4)[None], 5, axis=0), 13.8)
    np.testing.assert_allclose(crowd, 1.5)


def test_young_tracks_wait():
    old, young = query.gain(np.zeros(2), np.zeros(2), np.zeros(2, bool), 0.0, np.array([20.0, 0.5]))
    assert old > 2 * young > 0


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
        query.plan(np.zeros((2, 1, 2)), np.arange(2), np.ones(2), lambda enu: np.zeros(1, int), 5)


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


def test_angle_is_blind_to_scale_and_says_who_is_who():
    """Spectral angle against its definition, and its ratio on six paints with 2 % noise."""
    rng = np.random.default_rng(0)
    a, b = rng.random(8) + 0.1, rng.random(8) + 0.1
    expected = np.arccos(a @ b / np.sqrt((a @ a) * (b @ b)))
    assert features.spectral_angle(np.log(a)[None], np.log(3 * b)[None] - 1)[0] == pytest.approx(expected)
    paints = rng.normal(0, 0.5, (6, 8))
    kind = rng.integers(6, size=400)
    f = paints[kind] + rng.normal(0, 0.02, (400, 8))
    population = features.learn(features.empty_population(8), f[:200], np.zeros((200, 8)), np.zeros(200))
    population = features.learn(population, f[200:300], paints[kind[200:300]], np.full(100, 5.0))
    new, own, other = f[300:], paints[kind[300:]], paints[(kind[300:] + 1) % 6]
    five = np.full(100, 5.0)
    mine = features.angle_likelihood_ratio(population, own, five, new, 0.35, 6.0)
    wrong = features.angle_likelihood_ratio(population, other, five, new, 0.35, 6.0)
    assert (mine > 0).mean() > 0.95 and (wrong < 0).mean() > 0.95 and np.abs(wrong).max() <= 6.0


def test_random_directions_keep_who_is_near_whom():
    rng = np.random.default_rng(1)
    wavelength = np.linspace(0.4, 1.0, 61)
    paints = np.exp([np.sin(k * wavelength * 6 + k) for k in range(1, 6)])
    both = np.concatenate([paints, 0.3 * paints * (1 + rng.normal(0, 0.01, paints.shape))])
    _, f = features.of_spectra(spectra_of(both, np.zeros((10, 2))), 8, "random")
    apart = np.linalg.norm(f[:5, None] - f[None, 5:], axis=-1)
    assert apart.argmin(axis=1).tolist() == [0, 1, 2, 3, 4]


def under_two_lights(paints):
    """Spectra of paints under sun and sky, and in the shade under sky and sunlit walls at a tenth.

    Sunlight is taken as flat and skylight as λ⁻⁴ (Rayleigh); a clear coat mirrors 2 % of the light.
    """
    materials = load_materials()
    names = materials["material"].values.tolist()
    wavelength = materials["wavelength"].values
    use = (wavelength >= 0.4) & (wavelength <= 1.0)
    reflectance = materials["reflectance"].values[[names.index(n) for n in paints]][:, use]
    sky = (0.55 / wavelength[use]) ** 4
    sun, shade = 1.0 + 0.2 * sky, 0.1 * (0.35 + 0.65 * sky)
    return np.concatenate([(reflectance + 0.02) * sun, (reflectance + 0.02) * shade])


def test_sun_and_shade_of_one_paint_are_nearer_than_two_paints():
    """Hues of the paints in the library; white, grey, silver and black differ in level alone, which is light.

    With the level alone taken out, the colour of the shade is as far as another paint.
    """
    paints = ["paint_grey", "paint_blue", "paint_blue_dark", "paint_red", "paint_green", "paint_brown"]
    both, n = under_two_lights(paints), len(paints)
    spectra = spectra_of(both, np.zeros((2 * n, 2)), noise=1e-5)

    def distances(invariance):
        _, f = features.of_spectra(spectra, 8, invariance=invariance)
        return np.linalg.norm(f[:n, None] - f[None, n:], axis=-1)

    apart = distances("tilt")
    assert np.diag(apart).max() < (apart + 10 * np.eye(n)).min()
    level = distances("level")
    assert np.diag(level).max() > (level + 10 * np.eye(n)).min()


def test_moments_of_the_population_are_numpys():
    """Learnt in three batches, the middle one empty: mean and covariance as of all at once."""
    rng = np.random.default_rng(2)
    f = rng.normal(size=(50, 4)) @ rng.normal(size=(4, 4)) + 3
    population = features.empty_population(4)
    for batch in (f[:20], f[20:20], f[20:]):
        n = len(batch)
        population = features.learn(population, batch, np.zeros((n, 4)), np.zeros(n))
    np.testing.assert_allclose(population.mean, f.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(population.scatter / 49, np.cov(f.T), rtol=1e-9)
