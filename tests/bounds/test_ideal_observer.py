"""The ideal observer against brute-force noise draws, the matched filter's closed form and a worked panel."""

import math

import numpy as np
import pytest
from scipy.stats import norm

from glintrack.bounds.evidence import Polarization, polarization
from glintrack.bounds.ideal_observer import (
    Elements,
    _log_density,
    detectability,
    detection_probability,
    dolp_cumulants,
    element_cumulants,
)

DRAWS = 200_000
AGREEMENT = 0.02
DARK_E = 20.0  # dark noise


def noisy(without, present, full_well_e, dark_e=DARK_E):
    """Elements with shot noise and dark noise."""
    return Elements(without, present, without + dark_e**2, present + dark_e**2, full_well_e)


def bright(count, scale, level=4000.0):
    """Elements that a vehicle changes by some hundredths of their light."""
    rng = np.random.default_rng(3)
    without = level * rng.uniform(0.3, 1.0, count)
    return noisy(without, without * (1 + scale * rng.normal(size=count)), 1e5)


def by_draws(elements, false_alarm, rng):
    """P_D of the same ratio, its threshold and its hits counted over Poisson and normal draws."""

    def ratio(mean):
        e = rng.poisson(mean, (DRAWS, len(mean))) + DARK_E * rng.standard_normal((DRAWS, len(mean)))
        is_full = e >= elements.full_well_e
        total = 0.0
        for sign, m in ((1, elements.present), (-1, elements.without)):
            v = m + DARK_E**2
            inside = norm.logpdf(e, m, np.sqrt(v))
            total += sign * np.where(is_full, norm.logsf(elements.full_well_e, m, np.sqrt(v)), inside)
        return total.sum(axis=1)

    threshold = np.quantile(ratio(elements.without), 1 - false_alarm)
    return np.mean(ratio(elements.present) > threshold)


@pytest.mark.parametrize("scale", [0.004, 0.008, 0.012, 0.016, 0.024])
def test_against_brute_force_over_the_whole_range(scale):
    elements = bright(40, scale)
    expected = by_draws(elements, 1e-2, np.random.default_rng(1))
    assert detection_probability(*swap(element_cumulants(elements), 1e-2)) == pytest.approx(
        expected, abs=AGREEMENT
    )


def swap(found, false_alarm):
    return found[0], false_alarm, found[1]


def test_the_scales_span_a_tenth_to_nine_tenths():
    low, high = (detection_probability(*swap(element_cumulants(bright(40, s)), 1e-2)) for s in (0.004, 0.024))
    assert low < 0.15 and high > 0.9


def test_dim_elements_whose_noise_changes_with_the_vehicle():
    """300 electrons that become 250 or 350: noise differs by a tenth, which the ratio uses."""
    without = np.full(6, 300.0)
    elements = noisy(without, without + np.array([50, -50, 50, -50, 50, -50]), 1e5)
    expected = by_draws(elements, 1e-2, np.random.default_rng(2))
    found = detection_probability(*swap(element_cumulants(elements), 1e-2))
    assert found == pytest.approx(expected, abs=AGREEMENT)


def test_full_elements_are_censored():
    """The mean without the vehicle lies at the full well: half of the draws are cut off."""
    without, full = np.full(8, 9_900.0), 9_900.0
    elements = noisy(without, without + 90.0, full)
    expected = by_draws(elements, 1e-2, np.random.default_rng(4))
    found = detection_probability(*swap(element_cumulants(elements), 1e-2))
    assert found == pytest.approx(expected, abs=AGREEMENT)
    free = detection_probability(*swap(element_cumulants(elements._replace(full_well_e=1e6)), 1e-2))
    assert free > found + 0.02
    over = noisy(np.full(8, 20_000.0), np.full(8, 30_000.0), full)
    assert detection_probability(*swap(element_cumulants(over), 1e-2)) == pytest.approx(0.01, abs=1e-6)


def test_matched_filter_in_closed_form():
    """With noise that does not change, P_D = Q(Q⁻¹(P_FA) − √(ΣΔ²/σ²)), down to a false alarm in a million."""
    without = np.full(20, 1e6)
    change = np.linspace(-1500, 1500, 20)
    elements = noisy(without, without + change, 1e9)
    snr = math.sqrt((change**2 / (without + 400)).sum())
    cumulants, limit = element_cumulants(elements)
    assert detectability(cumulants) == pytest.approx(snr, rel=1e-3)
    for false_alarm in (1e-2, 1e-4, 1e-6):
        expected = norm.sf(norm.isf(false_alarm) - snr)
        assert detection_probability(cumulants, false_alarm, limit) == pytest.approx(expected, abs=0.003)


def test_a_panel_worked_by_hand():
    """10 elements of 1600 e become 1660 e; dark noise 0: Δ² / σ² = 3600/1600 each, d′ = √22.5 = 4.74.

    With the mean of both variances, 1630 e: √(36000/1630) = 4.70. At a false alarm in a thousand
    Q(3.09 − 4.7) = 0.946.
    """
    elements = noisy(np.full(10, 1600.0), np.full(10, 1660.0), 1e5, 0.0)
    cumulants, limit = element_cumulants(elements)
    assert detectability(cumulants) == pytest.approx(4.70, abs=0.02)
    assert detection_probability(cumulants, 1e-3, limit) == pytest.approx(0.946, abs=0.01)


def test_no_change_is_found_as_often_as_it_is_false():
    same = noisy(np.full(5, 900.0), np.full(5, 900.0), 1e5)
    assert detection_probability(*swap(element_cumulants(same), 1e-3)) == 1e-3


@pytest.mark.parametrize("false_alarm", [0.0, 0.5, -1.0])
def test_a_false_alarm_of_nought_is_refused(false_alarm):
    with pytest.raises(ValueError, match=r"`false_alarm` must be greater than 0 and less than 0.5; got"):
        detection_probability(*swap(element_cumulants(bright(3, 0.01)), false_alarm))


IDEAL = 2 / 3 * np.array([[1, 1, 1], [2, -1, -1], [0, math.sqrt(3), -math.sqrt(3)]])


@pytest.mark.parametrize("turn", [0.01, 0.02, 0.03])
def test_dolp_against_brute_force_on_the_polarizers(turn):
    """Twelve superpixels of 5000 e, DoLP 0.1 and 0.1 + turn, drawn element by element and made into DoLP."""
    rng = np.random.default_rng(5)
    angles = rng.uniform(0, math.pi, 12)
    analysers = np.radians([0.0, 60.0, 120.0])

    def readings(degree):
        return 2500 * (1 + degree * np.cos(2 * (analysers[None] - angles[:, None])))

    both = [readings(0.1), readings(0.1 + turn)]
    models = [polarization(r, r + 400, IDEAL) for r in both]
    found = detection_probability(dolp_cumulants(*models, rng), 1e-2)
    expected = by_draws_of_dolp(both, models, rng)
    assert found == pytest.approx(expected, abs=0.03)


def by_draws_of_dolp(both, models, rng):
    draws = 20_000
    sums = []
    for mean in both:
        e = rng.poisson(mean, (draws, *mean.shape)) + 20.0 * rng.standard_normal((draws, *mean.shape))
        s = e @ IDEAL.T
        length = (np.hypot(s[..., 1], s[..., 2]) / s[..., 0]).T
        parts = [
            _log_density(Polarization(*models[1]), part) - _log_density(Polarization(*models[0]), part)
            for part in np.array_split(length, 20, axis=1)
        ]
        sums.append(np.concatenate(parts, axis=1).sum(axis=0))
    return np.mean(sums[1] > np.quantile(sums[0], 0.99))


@pytest.mark.parametrize(("without", "present"), [(0.5, 3000.0), (3000.0, 0.5)])
@pytest.mark.parametrize("count", [1, 30])
def test_a_glint_over_the_dark_is_found_and_has_a_detectability(without, present, count):
    """K(s) ends within a step of 0 or 1 there: noise grows or shrinks a thousandfold; no NaN, no warning."""
    elements = noisy(np.full(count, without), np.full(count, present), 1e5, 1.0)
    cumulants, limit = element_cumulants(elements)
    with np.errstate(invalid="raise", divide="raise"):
        assert detectability(cumulants) > 20
        assert detection_probability(cumulants, 1e-3, limit) == pytest.approx(1.0)


def test_a_faint_glint_over_the_dark_has_a_probability():
    for present in np.geomspace(2.0, 60.0, 12):
        cumulants, limit = element_cumulants(noisy(np.array([0.0]), np.array([present]), 1e5, 0.1))
        assert 1e-3 <= detection_probability(cumulants, 1e-3, limit) <= 1 and detectability(cumulants) > 0
