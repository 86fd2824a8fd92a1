"""The raw mosaic: electrons and their noise against repeated exposures, and the mirrors that were away."""

import numpy as np
import pytest

from glintrack.core.records import NONE_SERVED, ServedQueries
from glintrack.sensor import array_readout, mosaic_of
from tests.sensor.light import NOISELESS, sensor_of, uniform


def test_sigma_is_the_spread_of_repeated_exposures():
    """Even light, 400 exposures: the mean standard deviation over elements of a kind within 2 %."""
    sensor = sensor_of()
    light = uniform(sensor, (20.0, 0, 0))(sensor.channels).values
    readings = [
        mosaic_of(array_readout(light, sensor, np.random.default_rng(k)), sensor, NONE_SERVED)
        for k in range(400)
    ]
    electrons = np.stack([m.electrons for m in readings])
    expected = np.mean([m.sigma_e for m in readings], axis=0)
    for i in range(2):
        for j in range(2):
            spread = electrons[:, i::2, j::2].std(axis=0).mean()
            np.testing.assert_allclose(spread, expected[i::2, j::2].mean(), rtol=0.02)
    assert (expected > sensor.design.dark_noise_e).all()


def test_sigma_grows_toward_the_corners_as_the_light_falls_off():
    """Calibrated electrons E of a gain g have the variance (gE + σ²)/g²; here g is below 0.75."""
    sensor = sensor_of(optics={"vignetting": 0.4})
    light = uniform(sensor, (40.0, 0, 0))(sensor.channels).values
    readings = [
        mosaic_of(array_readout(light, sensor, np.random.default_rng(k)), sensor, NONE_SERVED)
        for k in range(400)
    ]
    corner = np.s_[:6, :6]
    assert sensor.pattern.known_gain[corner].max() < 0.75
    spread = np.stack([m.electrons[corner] for m in readings]).std(axis=0)
    stated = np.mean([m.sigma_e[corner] for m in readings], axis=0)
    assert (spread / stated).mean() == pytest.approx(1.0, abs=0.02)


def test_a_mirror_that_was_away_has_no_reading():
    sensor = sensor_of()
    served = ServedQueries((), np.array([3, -1]), np.array([7, -1]), ("", "taken"))
    mosaic = mosaic_of(np.ones((sensor.camera.rows, sensor.camera.columns)), sensor, served)
    i, j = sensor.mirror_element
    assert np.argwhere(np.isnan(mosaic.electrons)).tolist() == [[2 * 3 + i, 2 * 7 + j]]
    assert mosaic.layout == sensor.design.superpixel
    np.testing.assert_allclose(mosaic.electrons[10:12, 10:12], sensor.electrons_per_reading, rtol=1e-6)


@pytest.mark.parametrize("polarizer", ["ideal", "grid_b"])
def test_gains_give_back_the_stokes_vector(polarizer):
    """Even light of the reference spectrum, exposed without noise: the polarizers' gains inverted."""
    stokes = (20.0, 3.0, -2.0)
    sensor = sensor_of(polarizer=polarizer, **NOISELESS)
    light = uniform(sensor, stokes)(sensor.channels).values
    mosaic = mosaic_of(array_readout(light, sensor, np.random.default_rng(1)), sensor, NONE_SERVED)
    places = [(i, j) for i in range(2) for j in range(2) if not isinstance(mosaic.layout[i][j], str)]
    electrons = np.array([mosaic.electrons[20 + i, 20 + j] for i, j in places])
    found = np.linalg.inv(np.array([mosaic.gains[place] for place in places])) @ electrons
    np.testing.assert_allclose(found, stokes, rtol=1e-4)
