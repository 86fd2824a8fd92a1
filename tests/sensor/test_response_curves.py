"""Curves of what the elements make of light, beside what the sensor itself uses."""

import numpy as np
import pytest

from glintrack.sensor import build_sensor, response_curves
from tests.plain import plain_sensor

WAVELENGTH_UM = np.round(np.arange(0.4, 1.0001, 0.01), 4)


def test_an_ideal_polarizer_passes_all_and_blocks_all():
    design = plain_sensor(quantum_efficiency=0.5, optics_transmission=0.8)
    curves = response_curves(design, WAVELENGTH_UM)
    np.testing.assert_allclose(curves["bare"].values, 0.4)
    np.testing.assert_allclose(curves["pass"].values, curves["bare"].values)
    np.testing.assert_allclose(curves["block"].values, 0, atol=1e-12)


def test_the_extinction_ratio_is_the_designs():
    design = plain_sensor(polarizer="constant", polarizer_transmittance=0.7, polarizer_extinction_ratio=50)
    curves = response_curves(design, WAVELENGTH_UM)
    np.testing.assert_allclose(curves["pass"].values / curves["bare"].values, 0.7)
    np.testing.assert_allclose(curves["pass"].values / curves["block"].values, 50)


def test_the_grids_diattenuation_is_what_the_sensor_was_built_with():
    design = plain_sensor(polarizer="grid_b")
    curves = response_curves(design, WAVELENGTH_UM)
    photons = WAVELENGTH_UM * np.gradient(WAVELENGTH_UM)  # flat light, by photons
    photons[[0, -1]] /= 2
    whole = {name: float(curves[name].values @ photons) for name in ("pass", "block")}
    diattenuation = (whole["pass"] - whole["block"]) / (whole["pass"] + whole["block"])
    half_a_step = 1e-3  # of the trapezoids at the band's edges
    assert diattenuation == pytest.approx(build_sensor(design, WAVELENGTH_UM).diattenuation, abs=half_a_step)


def test_only_what_is_there_is_told():
    assert set(response_curves(plain_sensor(layout="pan"), WAVELENGTH_UM).data_vars) == {"bare"}
    rgb = response_curves(plain_sensor(layout="rgb", demosaic="superpixel"), WAVELENGTH_UM)
    assert set(rgb.data_vars) == {"0.4-0.5", "0.5-0.6", "0.6-0.7"}
    narrow = response_curves(plain_sensor(spectrometer_um=(0.5, 0.7)), WAVELENGTH_UM)["spectrometer"]
    seen = narrow.wavelength.values[narrow.values > 0]
    assert (seen[0], seen[-1]) == (0.5, 0.7)
