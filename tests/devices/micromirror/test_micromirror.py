"""Three-electrode equilibrium: closed forms of one actuator, symmetry, inversion, and what is refused."""

import numpy as np
import pytest
from pydantic import ValidationError

from glintrack.devices.micromirror.equilibrium import (
    ActuatorDesign,
    MicromirrorDesign,
    dynamic_pull_in_voltage,
    equilibrium,
    holding_voltage,
    pull_in,
    pull_in_voltage,
    steepest_tilt,
)

DESIGN = MicromirrorDesign()
ROUNDING = 1e-9


def test_pull_in_is_the_maximum_of_the_holding_voltage():
    x = np.linspace(0, 0.5e-6, 200_001)
    volts = holding_voltage(x, 0.35, 30e-12, 1.5e-6)
    assert volts.max() == pytest.approx(pull_in_voltage(0.35, 30e-12, 1.5e-6), rel=1e-9)
    assert x[volts.argmax()] == pytest.approx(0.5e-6, rel=1e-5)


@pytest.mark.parametrize("pattern", [(1, 1, 1), (1, 0, 0), (1, 0.7, 0.2)])
def test_with_springs_over_electrodes_the_strongest_pulls_in_alone(pattern):
    alone = pull_in_voltage(0.35, 30e-12, 1.5e-6)
    np.testing.assert_allclose(pull_in(DESIGN, pattern).max(), alone, rtol=1e-6)


def test_forces_balance_at_rest():
    rest = equilibrium(DESIGN, (28.0, 20.0, 15.0))
    np.testing.assert_allclose(
        holding_voltage(rest.travel_m, 0.35, 30e-12, 1.5e-6), [28.0, 20.0, 15.0], rtol=ROUNDING
    )
    assert 0 < rest.margin < 1


def test_turning_the_voltages_by_a_third_turns_the_slope():
    a, b = equilibrium(DESIGN, (28.0, 20.0, 20.0)), equilibrium(DESIGN, (20.0, 28.0, 20.0))
    turn = np.exp(2j * np.pi / 3)
    assert complex(b.tip_rad, b.tilt_rad) == pytest.approx(
        turn * complex(a.tip_rad, a.tilt_rad), rel=ROUNDING
    )
    assert b.piston_m == pytest.approx(a.piston_m, rel=ROUNDING)
    assert equilibrium(DESIGN, (-28.0, 20.0, 20.0)).tilt_rad == pytest.approx(a.tilt_rad, rel=ROUNDING)


def test_springs_further_in_tip_more_and_let_it_tip_over():
    soft = MicromirrorDesign(actuator=ActuatorDesign(spring_radius_um=2.5))
    assert equilibrium(soft, (20.0, 0, 0)).tilt_rad > 2 * equilibrium(DESIGN, (20.0, 0, 0)).tilt_rad
    # level under equal voltages it tips over where the electrodes' 2F/(g−x) at r_e outweighs k at r_s
    ratio, gap = (2.5 / 4.0) ** 2, 1.5e-6
    travel = gap * ratio / (2 + ratio)
    expected = holding_voltage(np.array(travel), 0.35, 30e-12, gap)
    np.testing.assert_allclose(pull_in(soft), 3 * [expected], rtol=1e-6)
    wide = MicromirrorDesign(actuator=ActuatorDesign(spring_radius_um=7.0))
    np.testing.assert_allclose(pull_in(wide), pull_in(DESIGN), rtol=1e-6)  # piston knows no radius


def test_small_voltages_move_by_force_over_stiffness():
    rest = equilibrium(DESIGN, (0.1, 0.1, 0.1))
    linear = 8.8541878128e-12 * 30e-12 * 0.1**2 / (2 * 1.5e-6**2 * 0.35)
    assert rest.piston_m == pytest.approx(linear, rel=1e-4)  # next order: 2x/g, 2e-6
    assert rest.margin == pytest.approx(1, abs=1e-4)


def test_sudden_steps_pull_in_below_the_slow_limit():
    assert dynamic_pull_in_voltage(DESIGN) / pull_in(DESIGN).max() == pytest.approx(
        np.sqrt(27 / 32), rel=1e-6
    )


def test_steepest_tilt_is_at_a_third_of_the_gap():
    tilt, volts = steepest_tilt(DESIGN)
    assert volts == pytest.approx(pull_in_voltage(0.35, 30e-12, 1.5e-6), rel=1e-6)
    # one electrode down by g/3, two at rest: the plane's slope is (g/3)·(2/3)/r
    assert tilt == pytest.approx(0.5e-6 * 2 / 3 / 4e-6, rel=1e-3)


def test_beyond_pull_in_is_refused_with_the_limit():
    with pytest.raises(ValueError, match=r"must stay below pull-in at \[36.3, 36.3, 36.3\] V; got \[40"):
        equilibrium(DESIGN, (40.0, 40.0, 40.0))
    with pytest.raises(ValueError, match="within 0 to 500 nm, a third of the electrode gap of 1500 nm"):
        holding_voltage(np.array([0.6e-6]), 0.35, 30e-12, 1.5e-6)


def test_designs_refuse_what_cannot_be():
    for table in (
        {"plate": {"thickness_nm": -5}},
        {"actuator": {"electrode_gap_um": 0}},
        {"plate": {"x": 1}},
    ):
        with pytest.raises(ValidationError):
            MicromirrorDesign.model_validate(table)
