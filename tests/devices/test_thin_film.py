"""The transfer matrix against Fresnel and Airy, and what must hold for any stack."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from glintrack.devices.thin_film import stack_response

ROUNDING = 1e-12  # double precision after a few dozen operations


def test_one_surface_is_fresnels():
    angle = np.radians(56.309932474020215)  # Brewster's angle of n = 1.5
    assert stack_response([1.0, 1.5], [], 0.55).reflectance == pytest.approx(0.04, abs=ROUNDING)
    assert stack_response([1.0, 1.5], [], 0.55, angle, "p").reflectance == pytest.approx(0, abs=ROUNDING)
    s = stack_response([1.0, 1.5], [], 0.55, angle, "s")
    assert s.reflectance == pytest.approx((1.25 / 3.25) ** 2, abs=ROUNDING)  # (n²−1)²/(n²+1)² at Brewster's


def test_a_lossless_slab_is_airys():
    wavelength, n, d = np.linspace(0.4, 1.0, 61), 2.0, 0.7
    r = (n - 1) ** 2 / (n + 1) ** 2
    airy = 1 / (1 + 4 * r / (1 - r) ** 2 * np.sin(2 * np.pi * n * d / wavelength) ** 2)
    found = stack_response([1.0, n, 1.0], [d], wavelength)
    np.testing.assert_allclose(found.transmittance, airy, atol=ROUNDING)
    np.testing.assert_allclose(found.absorptance, 0, atol=ROUNDING)


def test_a_quarter_wave_of_the_right_index_reflects_nothing():
    found = stack_response([1.0, np.sqrt(1.5), 1.5], [0.55 / 4 / np.sqrt(1.5)], 0.55)
    assert found.reflectance == pytest.approx(0, abs=ROUNDING)


def test_total_reflection_and_tunnelling():
    beyond = np.radians(60.0)
    assert stack_response([1.5, 1.0], [], 0.5, beyond, "p").reflectance == pytest.approx(1, abs=ROUNDING)
    thin = stack_response([1.5, 1.0, 1.5], [0.05], 0.5, beyond, "s").transmittance
    thick = stack_response([1.5, 1.0, 1.5], [0.5], 0.5, beyond, "s").transmittance
    assert thin > 0.5 and 0 < thick < 0.01


def test_thick_metal_neither_overflows_nor_gains():
    found = stack_response([1.0, 0.05 + 4j, 1.5], [1000.0], 0.5)
    assert found.transmittance == 0
    assert found.reflectance == pytest.approx(
        float(stack_response([1.0, 0.05 + 4j], [], 0.5).reflectance), abs=ROUNDING
    )


def test_transmittance_is_the_same_both_ways():
    stack, d = [1.0, 0.05 + 3j, 1.3, 2 + 0.5j, 1.5], [0.02, 0.3, 0.05]
    for polarization in ("s", "p"):
        forth = stack_response(stack, d, 0.6, np.arcsin(0.4), polarization)
        back = stack_response(stack[::-1], d[::-1], 0.6, np.arcsin(0.4 / 1.5), polarization)
        assert forth.transmittance == pytest.approx(float(back.transmittance), abs=ROUNDING)


def test_a_sweep_equals_its_loop():
    wavelength, gap = np.linspace(0.4, 0.9, 7), np.linspace(0.1, 0.5, 5)
    silver = 0.05 + 1j * np.linspace(2, 6, 7)
    swept = stack_response([1, silver, 1, silver, 1.45], [0.03, gap[:, None], 0.03], wavelength, 0.3, "p")
    assert swept.transmittance.shape == (5, 7)
    for i, g in enumerate(gap):
        for j, w in enumerate(wavelength):
            one = stack_response([1, silver[j], 1, silver[j], 1.45], [0.03, g, 0.03], w, 0.3, "p")
            assert swept.transmittance[i, j] == pytest.approx(float(one.transmittance), abs=ROUNDING)


layers = st.lists(
    st.tuples(st.floats(0.05, 4), st.floats(0, 6), st.floats(0, 2)), min_size=0, max_size=6
)  # n, k, thickness in µm


@settings(max_examples=150, deadline=None)
@given(layers, st.floats(0.4, 2.5), st.floats(0, 1.5), st.sampled_from(["s", "p"]), st.floats(1, 2))
def test_power_is_never_gained(stack, wavelength, angle, polarization, behind):
    indices = [1.0, *(n + 1j * k for n, k, _ in stack), behind]
    found = stack_response(indices, [d for *_, d in stack], wavelength, angle, polarization)
    assert found.transmittance >= 0 and found.reflectance >= 0
    assert found.absorptance >= -ROUNDING


def test_equals_the_tmm_package():
    tmm = pytest.importorskip("tmm")
    rng = np.random.default_rng(20100407)
    worst = 0.0
    for _ in range(300):
        count = rng.integers(0, 6)
        inner = rng.uniform(0.1, 3, count) + 1j * rng.uniform(0, 4, count) * (rng.random(count) < 0.6)
        stack = [1.0, *inner, rng.choice([1.0, 1.45, 0.05 + 3j])]
        d, wavelength = rng.uniform(0.005, 0.4, count), rng.uniform(0.4, 2.5)
        angle = rng.uniform(0, 1.4)
        for polarization in ("s", "p"):
            theirs = tmm.coh_tmm(polarization, stack, [np.inf, *d, np.inf], angle, wavelength)
            ours = stack_response(stack, list(d), wavelength, angle, polarization)
            worst = max(worst, abs(ours.transmittance - theirs["T"]), abs(ours.reflectance - theirs["R"]))
            assert abs(ours.transmission) == pytest.approx(abs(theirs["t"]), abs=1e-11)
    assert worst < 1e-12


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (([1.0, 1.5], [0.1], 0.5), "two entries fewer"),
        (([1.0, 2.0, 1.5], [-0.1], 0.5), r"`thicknesses_um\[0\]` must be 0 or more; got -0.1"),
        (([1 + 1j, 1.5], [], 0.5), "must be real and positive"),
        (([1.0, 1.5 - 1j], [], 0.5), "must have Im ≥ 0"),
        (([1.0, 1.5], [], 0.5, 1.6), "under π/2"),
        (([1.0, 1.5], [], 0.0), "must be positive"),
        (([1.0, 1.5], [], 0.5, 0.0, "x"), "must be 's' or 'p'"),
    ],
)
def test_bad_input_is_one_sentence(arguments, sentence):
    with pytest.raises(ValueError, match=sentence):
        stack_response(*arguments)
