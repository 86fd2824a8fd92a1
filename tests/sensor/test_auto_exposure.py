"""Exposure from frame to frame, against its own law and the camera's."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from glintrack.core.records import NONE_SERVED
from glintrack.sensor import SensorDesign, build_sensor, mosaic_of, next_exposure_ms, read_out, with_exposure
from glintrack.sensor.exposure import FULL_SHARE, MAX_STEP
from tests.plain import plain_sensor

GRID = np.round(np.arange(0.4, 1.0001, 0.02), 9)
RADIANCE = 60.0


def sensor_of(**keys):
    return build_sensor(plain_sensor(**{"rows": 64, "columns": 80, **keys}), GRID)


def readings(sensor, radiance, seed=0):
    planes = np.zeros((len(sensor.planes), 64, 80))
    planes[0] = radiance
    return read_out(planes, sensor, np.random.default_rng(seed))


def test_without_a_quantile_every_frame_has_the_designs_exposure():
    sensor = sensor_of()
    assert next_exposure_ms(sensor, readings(sensor, RADIANCE)) == sensor.design.integration_time_ms
    assert with_exposure(sensor, sensor.design.integration_time_ms) is sensor


def test_the_next_frame_holds_the_quantile_at_its_share():
    """The mirrors, a quarter of the elements, have twice the light of polarizers: the upper quarter."""
    sensor = sensor_of(auto_exposure={"quantile": 0.9, "longest_ms": 10.0})
    for _ in range(4):
        sensor = with_exposure(sensor, next_exposure_ms(sensor, readings(sensor, RADIANCE)))
    mirror_e = RADIANCE * sensor.electrons_per_reading[sensor.mirror_element]
    assert mirror_e == pytest.approx(FULL_SHARE * sensor.design.full_well_e, rel=0.01)
    assert sensor.exposure_part == pytest.approx(sensor.design.integration_time_ms / 0.085, rel=1e-9)


def test_full_elements_shorten_it_until_none_is():
    sensor = sensor_of(integration_time_ms=1.0, auto_exposure={"quantile": 0.9})
    seen = []
    for _ in range(24):
        measured = readings(sensor, 30 * RADIANCE)
        sensor = with_exposure(sensor, next_exposure_ms(sensor, measured))
        seen.append(sensor.design.integration_time_ms)
    assert seen[0] == pytest.approx(FULL_SHARE, rel=0.01)  # the well was full
    mirror_e = 30 * RADIANCE * sensor.electrons_per_reading[sensor.mirror_element]
    assert mirror_e == pytest.approx(FULL_SHARE * sensor.design.full_well_e, rel=0.02)


def test_limits_and_steps():
    sensor = sensor_of(auto_exposure={"quantile": 0.9, "longest_ms": 0.4}, integration_time_ms=0.05)
    assert next_exposure_ms(sensor, readings(sensor, 0.0)) == pytest.approx(MAX_STEP * 0.05)
    later = with_exposure(sensor, 0.19)
    assert next_exposure_ms(later, readings(later, 0.0)) == 0.4


def test_readings_stay_radiance_and_mosaics_the_designs_electrons():
    """Three times the exposure: the same light, the same electrons to a detector, less noise, as its root."""
    sensor = sensor_of(dark_current_e_per_s=1e6, dsnu_e=20.0)
    longer = with_exposure(sensor, 3 * sensor.design.integration_time_ms)
    mosaics = [mosaic_of(readings(one, RADIANCE), one, NONE_SERVED) for one in (sensor, longer)]
    mean = [readings(one, RADIANCE).mean() for one in (sensor, longer)]
    assert mean[1] == pytest.approx(mean[0], rel=2e-3) and mean[0] == pytest.approx(RADIANCE, rel=0.02)
    assert mosaics[1].electrons.mean() == pytest.approx(mosaics[0].electrons.mean(), rel=2e-3)
    np.testing.assert_allclose(mosaics[1].gains, mosaics[0].gains)
    shot = mosaics[0].electrons > 10 * 400
    ratio = (mosaics[1].sigma_e / mosaics[0].sigma_e)[shot]
    assert np.median(ratio) == pytest.approx(1 / np.sqrt(3), rel=0.05)
    assert replace(longer, exposure_part=1.0).exposure_part == 1.0


def test_what_a_case_may_say():
    within = r"`sensor.auto_exposure.longest_ms` must end within a frame's 100"
    with pytest.raises(ValidationError, match=within):
        SensorDesign.model_validate({"auto_exposure": {"quantile": 0.99, "longest_ms": 200.0}})


@pytest.mark.parametrize(
    "camera",
    [
        {
            "full_well_e": 100e3,
            "bits": 12,
            "gain_e_per_count": 5.0,
        },  # the converter is full long before the well
        {"full_well_e": 30e3, "dark_current_e_per_s": 2e6},  # half of the well is dark current at 7 ms
    ],
)
def test_the_exposure_settles_below_what_fills_well_or_converter(camera):
    sensor = sensor_of(
        layout="pan", integration_time_ms=0.02, auto_exposure={"quantile": 0.99, "longest_ms": 20.0}, **camera
    )
    for _ in range(12):
        measured = readings(sensor, RADIANCE)
        sensor = with_exposure(sensor, next_exposure_ms(sensor, measured))
    design = sensor.design
    dark_e = 1e-3 * design.dark_current_e_per_s * design.integration_time_ms
    light_e = RADIANCE * sensor.electrons_per_radiance
    assert light_e + dark_e == pytest.approx(FULL_SHARE * design.saturation_e, rel=0.03)
    assert measured.mean() == pytest.approx(RADIANCE, rel=0.01)


@pytest.mark.parametrize("bits", [12, 16, 20])
def test_dark_readings_are_not_cut_off_at_a_fine_gain(bits):
    sensor = sensor_of(layout="pan", full_well_e=19e3, read_noise_e=60.0, bits=bits)
    dark_e = readings(sensor, 0.0) * sensor.electrons_per_radiance
    assert dark_e.mean() == pytest.approx(0, abs=4 * 60 / 64)
    assert dark_e.std() == pytest.approx(sensor.design.dark_noise_e, rel=0.05)
