"""Noise and calibration: photon transfer, Poisson's law, fixed pattern."""

import math

import numpy as np
import pytest
from scipy import stats

from glintrack.sensor import array_readout, noise_equivalent_radiance
from glintrack.sensor.fixed_pattern import CALIBRATION_FRAMES
from tests.sensor.light import sensor_of, uniform

EVEN = {"layout": "pan", "optics": {"relative_illumination": "even"}}


def readings(sensor, level, seed=0):
    light = uniform(sensor, (level, 0, 0))(sensor.channels).values
    return array_readout(light, sensor, np.random.default_rng(seed)).astype(float)


@pytest.mark.parametrize("mean", [0.3, 4.0, 60.0, 3000.0])
def test_electrons_have_poissons_law(mean):
    """χ² of what 200 000 elements read, one electron a count."""
    sensor = sensor_of(rows=400, columns=500, read_noise_e=0.0, gain_e_per_count=1.0, **EVEN)
    read = readings(sensor, mean / sensor.electrons_per_radiance) * sensor.electrons_per_radiance
    drawn = np.round(read).astype(int).ravel()
    low, high = stats.poisson.ppf([1e-4, 1 - 1e-4], mean).astype(int)
    edges = np.unique(np.linspace(low, high, 25).astype(int))
    expected = np.diff(np.r_[0, stats.poisson.cdf(edges, mean), 1]) * len(drawn)
    counted = np.bincount(np.searchsorted(edges, drawn), minlength=len(edges) + 1)
    enough = expected > 5
    chi2 = ((counted - expected)[enough] ** 2 / expected[enough]).sum()
    assert stats.chi2.sf(chi2, enough.sum() - 1) > 1e-4


def test_photon_transfer_recovers_gain_and_read_noise():
    """Variance against mean over levels from dark to near full: slope and intercept, EMVA 1288 §6."""
    two_percent = 0.02
    sensor = sensor_of(
        rows=256, columns=256, read_noise_e=30.0, gain_e_per_count=5.0, bits=14, full_well_e=60e3, **EVEN
    )
    counts_per_reading = sensor.electrons_per_radiance / 5.0
    means, variances = [], []
    for level_e in (0, 500, 2000, 8000, 20000, 40000):
        pair = [readings(sensor, level_e / sensor.electrons_per_radiance, seed) for seed in (1, 2)]
        first, second = (p * counts_per_reading for p in pair)
        means.append((first + second).mean() / 2)
        variances.append((first - second).var() / 2)
    slope = np.polyfit(means, variances, 1, w=1 / (np.array(variances)))[0]
    assert 1 / slope == pytest.approx(5.0, rel=two_percent)
    assert math.sqrt(variances[0] - 1 / 12) * 5.0 == pytest.approx(30.0, rel=two_percent)


def test_dark_current_adds_shot_noise_and_no_mean():
    keys = {"gain_e_per_count": 0.5, "dark_current_e_per_s": 4e6, "integration_time_ms": 0.1}
    sensor = sensor_of(rows=256, columns=256, read_noise_e=0.0, **keys, **EVEN)
    dark = readings(sensor, 0.0) * sensor.electrons_per_radiance
    assert dark.mean() == pytest.approx(0, abs=5 * 20 / 256)
    assert dark.std() == pytest.approx(math.hypot(20, 0.5 / math.sqrt(12)), rel=0.02)  # 400 e in 0.1 ms
    assert sensor.design.dark_noise_e == pytest.approx(dark.std(), rel=0.02)


def test_fixed_pattern_stays_and_calibration_takes_it_out():
    keys = {"prnu": 0.03, "dsnu_e": 50.0, "read_noise_e": 5.0, "full_well_e": 100e3, **EVEN}
    level = 40e3
    sensor = sensor_of(rows=128, columns=128, **keys)
    mean = np.mean([readings(sensor, level / sensor.electrons_per_radiance, s) for s in range(30)], axis=0)
    assert mean.mean() * sensor.electrons_per_radiance == pytest.approx(level, rel=0.005)
    shot = math.sqrt(1 / (30 * level))
    known_to = 1 / math.sqrt(CALIBRATION_FRAMES * 50e3)  # flat frames of half a full well
    assert mean.std() / mean.mean() == pytest.approx(math.hypot(shot, known_to), rel=0.1)
    assert sensor.pattern.gain.std() == pytest.approx(0.03, rel=0.05)


@pytest.mark.parametrize("cells", [1, 3])
def test_a_uniform_field_returns_its_radiance(cells):
    half_a_percent = 0.005
    sensor = sensor_of(
        rows=128,
        columns=160,
        layout="pan",
        prnu=0.01,
        dsnu_e=5.0,
        dark_current_e_per_s=1e4,
        quantum_efficiency="silicon",
        fill_factor=0.44,
        optics={"scatter_fraction": 0.05, "vignetting": 0.3, "zernike_rms_nm": {8: 100.0}},
    )
    light = uniform(sensor, (80.0, 0, 0), cells=cells)(sensor.channels).values
    found = array_readout(light, sensor, np.random.default_rng(0))
    assert found.mean() == pytest.approx(80, rel=half_a_percent)
    corner = found[:16, :16].mean()
    assert corner == pytest.approx(80, rel=2 * half_a_percent)  # fewer elements, less light: 2σ is 0.4 %


def test_less_light_in_the_corner_is_more_noise_there():
    sensor = sensor_of(rows=128, columns=128, layout="pan", optics={"vignetting": 0.75}, read_noise_e=0.0)
    found = readings(sensor, 80.0)
    middle, corner = (slice(52, 76), slice(52, 76)), (slice(0, 24), slice(0, 24))
    light = sensor.pattern.gain.astype(float)
    assert light[0, 0] < 0.26
    wanted = math.sqrt((1 / light[corner]).mean() / (1 / light[middle]).mean())
    assert found[corner].std() / found[middle].std() == pytest.approx(
        wanted, rel=0.1
    )  # 3 % each is one sigma


def test_noise_of_two_bits_less_is_four_times_the_step():
    fine, coarse = (sensor_of(read_noise_e=0.0, bits=bits, **EVEN) for bits in (8, 6))
    assert noise_equivalent_radiance(coarse) == pytest.approx(4 * noise_equivalent_radiance(fine))


def test_rows_do_not_share_their_noise():
    sensor = sensor_of(rows=128, columns=128, layout="pan")
    noise = readings(sensor, 50.0) - 50.0
    noise /= noise.std()
    neighbours = (noise[1:] * noise[:-1]).mean()
    along = (noise[:, 1:] * noise[:, :-1]).mean()
    assert abs(neighbours) < 5 / 128 and abs(along) < 5 / 128


def test_one_thread_draws_what_many_do(monkeypatch):
    sensor = sensor_of(layout="pan")
    many = readings(sensor, 50.0)
    monkeypatch.setattr("glintrack.core.parallel.nb.get_num_threads", lambda: 1)
    np.testing.assert_array_equal(readings(sensor, 50.0), many)
