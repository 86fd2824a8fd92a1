"""Made-up light for the sensor's tests."""

import numpy as np
import xarray as xr

from glintrack.core.spectral import wavelength_grid
from glintrack.sensor import build_sensor
from tests.plain import plain_sensor

GRID = wavelength_grid(0.4, 1.0)
# so much light and so fine a quantizer that noise is under 1e-6 of the signal
NOISELESS = {
    "integration_time_ms": 1000.0,
    "max_frame_rate_hz": 1.0,
    "read_noise_e": 0.0,
    "bits": 24,
    "full_well_e": 1e12,
    "gain_e_per_count": 2e5,
    "f_number": 0.5,
    "spot_sigma_um": 0.0,
    "pitch_um": 100.0,
}


def sensor_of(**design):
    """A small sensor on the grid of 0.4 to 1.0 µm."""
    return build_sensor(plain_sensor(**{"rows": 64, "columns": 80, **design}), GRID)


def uniform(sensor, vector, spectrum=None, cells=1):
    """A radiance function whose every pixel has the same Stokes vector times a spectrum."""
    spectrum = np.ones(len(GRID)) if spectrum is None else spectrum
    shape = (cells * sensor.camera.rows, cells * sensor.camera.columns)

    def radiance(channels, pixels=None):
        light = (channels @ spectrum)[:, None] * np.asarray(vector, float)
        size = shape if pixels is None else (len(pixels),)
        return xr.DataArray(np.broadcast_to(light, (*size, *light.shape)))

    return radiance


def picture(sensor, light):
    """A radiance function of one grey picture (y, x, stokes)."""

    def radiance(channels, pixels=None):
        assert pixels is None
        shape = (*light.shape[:2], len(channels), 3)
        return xr.DataArray(np.broadcast_to(light[:, :, None], shape))

    return radiance


def texture(seed=1):
    """Unpolarized light with edges and bars."""
    rng = np.random.default_rng(seed)
    light = np.full((64, 80), 50.0)
    for _ in range(25):
        y, x = rng.integers(0, 60), rng.integers(0, 76)
        light[y : y + rng.integers(2, 14), x : x + rng.integers(2, 14)] = rng.uniform(20, 90)
    return light
