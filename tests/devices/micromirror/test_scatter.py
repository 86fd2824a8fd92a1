"""Scatter of the mirror: how much, that it adds up, and its limits."""

import numpy as np
import pytest

from glintrack.devices.micromirror.equilibrium import MicromirrorDesign, SurfaceDesign
from glintrack.devices.micromirror.scatter import (
    relay_throughput,
    scatter,
    wing_fraction,
)

WAVELENGTH = np.array([0.4, 0.55, 1.0, 2.5])
INTEGRAL = 1e-4  # of trapezoids over the logarithm


def test_total_scatter_is_the_closed_form():
    small = scatter(SurfaceDesign(roughness_nm=1.0), WAVELENGTH, 0.3).total
    np.testing.assert_allclose(small, (4e-3 * np.pi * np.cos(0.3) / WAVELENGTH) ** 2, rtol=1e-3)
    assert scatter(SurfaceDesign(roughness_nm=200.0), 0.4).total == pytest.approx(1)


def bsdf(model, beta):
    """A/(Bᵍ + βᵍ) at each wavelength. [sr⁻¹]"""
    return model.scale[:, None] / (model.shoulder[:, None] ** model.slope + beta**model.slope)


@pytest.mark.parametrize("slope", [1.5, 2.0, 3.3])
def test_the_bsdf_integrates_to_the_total(slope):
    model = scatter(SurfaceDesign(roughness_nm=3, rolloff=slope), WAVELENGTH)
    beta = np.r_[0, np.geomspace(1e-6, 1, 40_001)]
    ring = 2 * np.pi * beta * bsdf(model, beta)
    np.testing.assert_allclose(np.trapezoid(ring, beta), model.total, rtol=INTEGRAL)


@pytest.mark.parametrize("slope", [1.5, 2.0, 3.3])
def test_wings_fall_from_everything_to_nothing(slope):
    model = scatter(SurfaceDesign(rolloff=slope), WAVELENGTH)
    np.testing.assert_allclose(wing_fraction(model, 0.0), model.total)
    np.testing.assert_allclose(wing_fraction(model, 1.0), 0, atol=1e-12)
    beyond = wing_fraction(model, 0.1)
    beta = np.linspace(0.1, 1, 20_001)
    by_hand = np.trapezoid(2 * np.pi * beta * bsdf(model, beta), beta)
    np.testing.assert_allclose(beyond, by_hand, rtol=1e-3)


def test_both_ways_to_integrate_agree():
    exact = scatter(SurfaceDesign(rolloff=2.0), WAVELENGTH)
    near = scatter(SurfaceDesign(rolloff=2.0 + 1e-9), WAVELENGTH)
    np.testing.assert_allclose(near.scale, exact.scale, rtol=INTEGRAL)


def test_short_waves_and_rough_surfaces_scatter_more_and_smooth_ones_not():
    rough, smooth = (scatter(SurfaceDesign(roughness_nm=s), WAVELENGTH).total for s in (2.0, 0.0))
    assert np.all(np.diff(rough) < 0) and not smooth.any()


def test_throughput_is_reflectance_less_what_misses_the_stop():
    design = MicromirrorDesign()
    slow, fast = (relay_throughput(design, WAVELENGTH, n) for n in (20.0, 1.0))
    assert np.all(slow < fast) and np.all(fast < 0.96)
    np.testing.assert_allclose(fast, 0.96, rtol=1e-3)


def test_bad_input_is_one_sentence():
    model = scatter(SurfaceDesign(), [0.55])
    with pytest.raises(ValueError, match="`beta` must lie in 0 to 1"):
        wing_fraction(model, 1.5)
