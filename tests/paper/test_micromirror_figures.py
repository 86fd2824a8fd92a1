"""The micromirror's published and reference numbers (§3.1)."""

import math

import pytest

from glintrack.devices.micromirror.equilibrium import MicromirrorDesign, equilibrium, pull_in_voltage

LAST_DIGIT_V, LAST_DIGIT_M, LAST_DIGIT_DEG = 0.001, 0.05e-9, 0.005


@pytest.mark.parametrize(("gap_m", "volts"), [(0.6e-6, 8.50), (1.5e-6, 33.6)])
def test_pull_in_of_one_actuator(gap_m, volts):
    assert pull_in_voltage(1.0, 100e-12, gap_m) == pytest.approx(volts, rel=LAST_DIGIT_V)


def test_25_volts_on_all():
    rest = equilibrium(MicromirrorDesign(), (25.0, 25.0, 25.0))
    assert rest.piston_m == pytest.approx(125.5e-9, abs=LAST_DIGIT_M)
    assert rest.tip_rad == pytest.approx(0, abs=1e-15) and rest.tilt_rad == pytest.approx(0, abs=1e-15)


def test_28_20_20_volts():
    rest = equilibrium(MicromirrorDesign(), (28.0, 20.0, 20.0))
    assert rest.piston_m == pytest.approx(106e-9, abs=0.5e-9)
    assert math.degrees(rest.tilt_rad) == pytest.approx(0.89, abs=LAST_DIGIT_DEG)
