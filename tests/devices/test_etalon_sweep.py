"""Spectra from gap sweeps: what is recovered, how the rule chooses, and what is refused."""

import numpy as np
import pytest

from glintrack.devices.etalon import EtalonDesign, OrderFilterDesign, reconstruct, responses, sweep_weights

RESPONSES = responses(EtalonDesign())
WAVELENGTH = RESPONSES["wavelength"].values
WEIGHTS = sweep_weights(RESPONSES)


def measured(spectrum, snr, count, seed=5, weights=WEIGHTS):
    """Noisy sweeps of one spectrum and their noise, even over the gaps."""
    exact = weights @ spectrum
    sigma = exact.mean() / snr
    return exact + sigma * np.random.default_rng(seed).standard_normal((count, exact.size)), sigma


def relative_error(found, spectrum):
    return np.sqrt(np.mean((found["radiance"].values - spectrum) ** 2)) / spectrum.mean()


@pytest.fixture(scope="module")
def grass():
    """Radiance like a lawn's in bluish sunlight: a green peak 60 nm wide and a red edge 40 nm wide."""
    green = 0.05 + 0.07 * np.exp(-0.5 * ((WAVELENGTH - 0.55) / 0.025) ** 2)
    edge = 0.55 / (1 + np.exp(-(WAVELENGTH - 0.715) / 0.01))
    return (green + edge) * 100 * np.exp(-(WAVELENGTH - 0.4))


def test_straight_spectra_come_back_exactly_whatever_the_smoothing():
    line = 3 + 2 * (WAVELENGTH - 0.4)
    readings = WEIGHTS @ line
    found = reconstruct(readings, WEIGHTS, WAVELENGTH, noise=1e-4 * readings.mean())
    np.testing.assert_allclose(found["radiance"].values[0], line, rtol=5e-4)  # the noise allowed, and as much
    assert found["degrees_of_freedom"].item() < 4


@pytest.mark.parametrize(("snr", "error"), [(30, 0.06), (100, 0.03), (1000, 0.01)])
def test_a_lawn_comes_back(grass, snr, error):
    readings, sigma = measured(grass, snr, 40)
    assert relative_error(reconstruct(readings, WEIGHTS, WAVELENGTH, sigma), grass) < error


def test_discrepancy_leaves_the_noise_and_no_more(grass):
    readings, sigma = measured(grass, 100, 20)
    found = reconstruct(readings, WEIGHTS, WAVELENGTH, sigma)
    # α is interpolated between trials 26 % apart
    np.testing.assert_allclose(found["misfit"], 1.0, atol=0.01)


def test_stated_sigma_is_the_scatter_of_repeats(grass):
    readings, sigma = measured(grass, 100, 400)
    found = reconstruct(readings, WEIGHTS, WAVELENGTH, sigma)
    ratio = found["radiance"].values.std(axis=0).mean() / found["radiance_sigma"].values.mean()
    assert 0.95 < ratio < 1.4  # a varying α adds to the scatter


def test_better_readings_resolve_more(grass):
    coarse, fine = (
        reconstruct(*_with_sigma(measured(grass, snr, 5)))["degrees_of_freedom"].mean() for snr in (30, 1000)
    )
    assert coarse + 5 < fine


def _with_sigma(pair):
    return pair[0], WEIGHTS, WAVELENGTH, pair[1]


def test_many_spectra_are_the_loop_over_them(grass):
    readings, sigma = measured(grass, 100, 3)
    together = reconstruct(readings, WEIGHTS, WAVELENGTH, sigma)
    apart = reconstruct(readings, WEIGHTS, WAVELENGTH, np.full(readings.shape, sigma))
    one = reconstruct(readings[1], WEIGHTS, WAVELENGTH, sigma)
    np.testing.assert_allclose(together["radiance"], apart["radiance"], rtol=1e-9)
    np.testing.assert_allclose(together["radiance"][1], one["radiance"][0], rtol=1e-9)


def test_two_orders_are_told_apart_by_the_sweep_or_by_the_filter():
    line = np.exp(-0.5 * ((WAVELENGTH - 0.46) / 0.02) ** 2)  # blue only: order 2 of the gaps for 0.9 µm
    filtered = responses(EtalonDesign(order_filter=OrderFilterDesign()))
    for response in (RESPONSES, filtered):
        weights = sweep_weights(response)
        readings, sigma = measured(line, 300, 4, weights=weights)
        found = reconstruct(readings, weights, WAVELENGTH, sigma)["radiance"].values
        assert np.abs(found[:, WAVELENGTH > 0.7]).max() < 0.08  # of a line of height 1


def test_uneven_grids_and_dropped_gaps(grass):
    keep = np.delete(np.arange(WAVELENGTH.size), [3, 4, 20, 41])
    wavelength = WAVELENGTH[keep]
    weights = sweep_weights(responses(EtalonDesign(), np.linspace(0.15, 0.45, 80), wavelength))
    found = reconstruct(weights @ grass[keep], weights, wavelength, 1e-3)
    assert relative_error(found, grass[keep]) < 0.02


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"readings": np.ones(7)}, "`readings` must hold one value for each of 100 gaps"),
        ({"readings": np.full(100, np.nan)}, "must be finite"),
        ({"weights": WEIGHTS[:, :5]}, r"`weights` must be \(gap, wavelength\)"),
        ({"noise": 0.0}, "`noise` must be positive"),
        ({"noise": np.ones(3)}, "`noise` must be one number"),
    ],
)
def test_bad_input_is_one_sentence(change, sentence):
    arguments = {"readings": np.ones(100), "weights": WEIGHTS, "wavelength_um": WAVELENGTH, "noise": 1.0}
    with pytest.raises(ValueError, match=sentence):
        reconstruct(**arguments | change)
