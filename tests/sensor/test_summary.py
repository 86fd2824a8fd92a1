"""What follows from a design, in words and curves, against the sensor's own numbers."""

import numpy as np
import pytest

from glintrack.sensor.sensor import summary
from glintrack.sensor.wavefront import transfer_curves
from tests.plain import plain_sensor
from tests.sensor.light import sensor_of


def test_summary_says_the_sensors_own_figures():
    sensor = sensor_of(polarizer="grid_b")
    said = dict(summary(sensor))
    assert float(said["electrons per W m⁻² sr⁻¹ µm⁻¹"]) == pytest.approx(
        sensor.electrons_per_radiance, abs=0.05
    )
    assert float(said["diattenuation over the band"]) == pytest.approx(sensor.diattenuation, abs=5e-5)
    assert "spectrometer" not in dict(summary(sensor_of(layout="pan")))


def test_transfer_starts_at_one_and_the_lens_is_below_diffraction():
    curves = transfer_curves(plain_sensor())
    for name in curves.data_vars:
        assert float(curves[name][0]) == pytest.approx(1, abs=5e-3)
    half = curves.sel(frequency=curves.nyquist_per_mm, method="nearest")
    assert float(half["lens and element"]) < float(half["lens"]) < float(half["diffraction"])
    assert np.isfinite(curves["lens"].values).all()
