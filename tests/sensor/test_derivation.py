"""Values that a design leaves out: the default stays, and other pitches get values of their own."""

import math
import tomllib

import numpy as np
import pytest

from glintrack.case.packaged import find_case
from glintrack.core.designs import validate_design
from glintrack.sensor import SensorDesign, modulation_transfer
from glintrack.sensor.derivation import MAX_EXPOSURE_MS, ORIGINS, derived_values

DEFAULTS = {"spot_sigma_um": 12.0, "full_well_e": 267e3, "read_noise_e": 20.0, "integration_time_ms": 0.085}
A_ROUNDED_VALUE = 5e-4  # of four digits
CAMERA = {
    "pitch_um": 3.45, "f_number": 2.8, "layout": "0-45-90-135", "polarizer": "constant",
    "polarizer_transmittance": 0.8,
}  # fmt: skip


def test_the_default_sensor_keeps_its_values():
    assert DEFAULTS.keys() == ORIGINS.keys()
    assert {key: getattr(SensorDesign(), key) for key in DEFAULTS} == DEFAULTS
    paper = SensorDesign(ready="paper")
    assert {**DEFAULTS, "integration_time_ms": 0.19} == {key: getattr(paper, key) for key in DEFAULTS}


@pytest.mark.parametrize("name", ["between", "polarization_fine", "table1"])
def test_packaged_studies_of_the_pitch_keep_lens_and_electronics(name):
    base = tomllib.loads(find_case(name, "study").read_text())["base"]["sensor"]
    stated = DEFAULTS if name != "between" else DEFAULTS.keys() - {"integration_time_ms"}  # an axis of it
    assert {key: base.get(key) for key in stated} == {key: DEFAULTS[key] for key in stated}


def test_other_pitches_get_values_of_their_own():
    small = SensorDesign(pitch_um=3.45)
    assert small.full_well_e == pytest.approx(267e3 * (3.45 / 17) ** 2, rel=A_ROUNDED_VALUE)
    assert small.read_noise_e == pytest.approx(20 * 3.45 / 17, rel=A_ROUNDED_VALUE)
    # light and well go with the area, so the exposure stays
    assert small.integration_time_ms == pytest.approx(0.085, rel=2 * A_ROUNDED_VALUE)


def test_aberrations_and_diffraction_together_keep_their_ratio_to_the_pitch():
    airy_um = 0.42 * 0.7 * 5.6
    ratio = math.hypot(12.0, airy_um) / 17
    assert math.hypot(SensorDesign(pitch_um=3.45).spot_sigma_um, airy_um) == pytest.approx(
        ratio * 3.45, rel=A_ROUNDED_VALUE
    )
    assert SensorDesign(pitch_um=2.0).spot_sigma_um == 0.0  # limited by diffraction


def test_a_slower_lens_is_never_sharper():
    """Diffraction grows with the F-number; at F/16 it ends below Nyquist of 3.45 µm."""
    nyquist_per_mm = np.array([500 / 3.45])
    lenses = [SensorDesign(pitch_um=3.45, f_number=number) for number in (2.8, 4.0, 5.6, 8.0, 16.0)]
    found = [float(modulation_transfer(lens, 0.7, nyquist_per_mm)[0]) for lens in lenses]
    assert found == sorted(found, reverse=True) and found[0] > 1.5 * found[2] and found[-1] == 0
    assert "the fastest is the sharpest" in derived_values(lenses[0])["spot_sigma_um"]


def test_exposure_makes_good_what_takes_light():
    def exposure_ms(**keys):
        return SensorDesign(**keys).integration_time_ms

    about = {"rel": 2 * A_ROUNDED_VALUE}
    stops = (4 * 11.2**2 + 1) / (4 * 5.6**2 + 1)
    assert exposure_ms(f_number=11.2) == pytest.approx(0.085 * stops, **about)
    assert exposure_ms(quantum_efficiency=0.3) == pytest.approx(0.17, **about)
    assert exposure_ms(fill_factor=0.5) == pytest.approx(0.17, **about)
    assert exposure_ms(full_well_e=534e3) == pytest.approx(0.17, **about)
    assert exposure_ms(layout="0-45-90-135") == pytest.approx(0.17, **about)
    assert exposure_ms(band_um=(0.5, 0.6)) > 0.085 * 3  # a sixth of the band, at the peak of the light
    assert exposure_ms(f_number=64.0) == MAX_EXPOSURE_MS
    assert exposure_ms(f_number=64.0, max_frame_rate_hz=2000.0, layout="pan") < 0.5  # within a frame


def test_the_laws_give_a_camera_as_sold():
    """The packaged IMX250MZR, of measurements by EMVA 1288, from pitch, F-number and mosaic alone."""
    sold, own = SensorDesign(ready="imx250mzr"), SensorDesign(**CAMERA, quantum_efficiency="silicon")
    assert own.full_well_e == pytest.approx(sold.full_well_e, rel=0.05)
    assert own.integration_time_ms == pytest.approx(sold.integration_time_ms, rel=0.1)
    assert own.spot_sigma_um == pytest.approx(sold.spot_sigma_um, rel=0.25)


def test_a_change_derives_anew_and_a_stated_value_stays():
    stated = SensorDesign(full_well_e=5000.0)
    finer = stated.replace({"pitch_um": 8.5})
    assert finer.full_well_e == 5000.0 and finer.read_noise_e == 10.0
    assert derived_values(finer).keys() == ORIGINS.keys() - {"full_well_e"}
    assert derived_values(finer)["read_noise_e"].startswith("sensor.read_noise_e = 10 e: ")


def test_a_ready_design_keeps_no_value_of_another_pitch():
    assert derived_values(SensorDesign(ready="imx250mzr")) == {}
    finer = SensorDesign(ready="imx250mzr", pitch_um=2.4, read_noise_e=1.7)
    assert finer.full_well_e == pytest.approx(5322, abs=1) and finer.read_noise_e == 1.7
    again = validate_design(SensorDesign, finer.explicit_values())
    assert again == finer


def test_an_error_of_a_key_is_not_followed_by_those_of_derived_keys():
    with pytest.raises(ValueError, match=r"^`pitch_um` must be greater than or equal to 1 µm; got -1 µm\.$"):
        validate_design(SensorDesign, {"pitch_um": -1})
    with pytest.raises(ValueError, match=r"`sensor.band_um` must"):
        validate_design(SensorDesign, {"band_um": (0.4, 1e300)})
