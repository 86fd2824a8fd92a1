"""Leaves by the plate model: light is kept, stacks add up, and what comes out looks like a leaf."""

import math

import numpy as np
import pytest

from glintrack.scene import load_materials
from glintrack.scene.materials import _entering, leaf_transmittance, plate_stack

N = 1.42
ROUNDING = 1e-7  # of an inside that is clear to a billionth


@pytest.mark.parametrize("layers", [1.0, 1.5, 2.0, 6.0])
def test_a_clear_stack_absorbs_nothing_and_a_black_one_passes_nothing(layers):
    r, t = plate_stack(np.array([1.0, 0.0]), layers, N)
    assert r[0] + t[0] == pytest.approx(1, abs=10 * ROUNDING) and t[1] < ROUNDING
    assert r[1] == pytest.approx(1 - _entering(N, math.radians(40)), abs=ROUNDING)


def test_light_enters_by_fresnels_law():
    straight = 1 - ((N - 1) / (N + 1)) ** 2
    assert _entering(N, 1e-3) == pytest.approx(straight, abs=1e-6)
    # internal reflectance of diffuse light at n = 1.5: 0.596; with n² law the outer one is 0.0918 (Judd 1942)
    assert 1 - _entering(1.5, math.pi / 2) == pytest.approx(0.0918, abs=2e-4)


def test_three_layers_are_one_upon_two():
    inner = np.array([0.3, 0.7, 0.95])
    r1, t1 = plate_stack(inner, 1.0, N)
    r3, t3 = plate_stack(inner, 3.0, N)
    # plates deep in the stack are lit from all sides; recover their r and t from stacks of one and two
    r2, t2 = plate_stack(inner, 2.0, N)
    r = (r2 - r1) / t1 / (t2 / t1)  # r2 = r1 + t1·t·r/(1 − r²), t2 = t1·t/(1 − r²)
    t = t2 / t1 * (1 - r**2)
    pair_r, pair_t = r + t**2 * r / (1 - r**2), t**2 / (1 - r**2)
    np.testing.assert_allclose(r3, r1 + t1 * t * pair_r / (1 - r * pair_r), rtol=1e-6)
    np.testing.assert_allclose(t3, t1 * pair_t / (1 - r * pair_r), rtol=1e-6)


def test_the_inverse_finds_the_stack_again():
    inner = np.array([0.05, 0.2, 0.6, 0.97])
    r, t = plate_stack(inner, 1.7, N)
    np.testing.assert_allclose(leaf_transmittance(r, float(1 - r[-1] - t[-1]), N), t, atol=1e-6)


def test_library_leaves_pass_green_and_infrared_light_and_no_more_than_there_is():
    library = load_materials()
    passed = library["transmittance"]
    leaves = ("leaf", "leaf_walnut", "leaf_conifer")
    assert (passed.drop_sel(material=list(leaves)) == 0).all()
    for name, absorbed in zip(leaves, (0.05, 0.05, 0.3), strict=True):
        leaf = passed.sel(material=name)
        red, green, infrared = (float(leaf.sel(wavelength=w, method="nearest")) for w in (0.67, 0.55, 0.85))
        assert 0 <= red < green < infrared
        both = leaf + library["reflectance"].sel(material=name)
        assert float(both.max()) <= 1 - absorbed + 1e-6
    # Single leaves of maple pass 0.3 to 0.45 of the near infrared and under 0.05 at the chlorophyll's band
    assert 0.25 < float(passed.sel(material="leaf", wavelength=0.85)) < 0.5
    assert float(passed.sel(material="leaf", wavelength=0.67)) < 0.05


def test_absorptance_that_leaves_nothing_is_refused():
    with pytest.raises(ValueError, match=r"`leaf_absorptance` must .* below 0.4; got 0.5"):
        leaf_transmittance(np.array([0.1, 0.6]), 0.5, N)
