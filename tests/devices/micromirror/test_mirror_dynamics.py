"""Modes and steps of the micromirror against the oscillator on a spring."""

import numpy as np
import pytest

from glintrack.devices.micromirror.dynamics import inertia, modes, square_film, step_response
from glintrack.devices.micromirror.equilibrium import (
    ActuatorDesign,
    DriveDesign,
    MicromirrorDesign,
    dynamic_pull_in_voltage,
    equilibrium,
)

DESIGN = MicromirrorDesign()


def rings(quality, **drive):
    """The default mirror with a fixed quality factor."""
    return MicromirrorDesign(
        actuator=ActuatorDesign(quality_factor=quality), drive=DriveDesign.model_validate(drive)
    )


def test_without_voltage_modes_are_mass_on_springs():
    found = modes(DESIGN, (0.0, 0.0, 0.0))
    mass, about_x, _ = inertia(DESIGN)
    piston = np.sqrt(3 * 0.35 / mass) / (2 * np.pi)
    tilt = np.sqrt(1.5 * 0.35 * 4e-6**2 / about_x) / (2 * np.pi)
    np.testing.assert_allclose(found.frequency_hz, sorted([tilt, tilt, piston]), rtol=1e-9)


def test_voltage_softens():
    slack, tense = modes(DESIGN, (0, 0, 0)), modes(DESIGN, (25.0, 25.0, 25.0))
    assert np.all(tense.frequency_hz < slack.frequency_hz)
    near = modes(DESIGN, (36.295, 36.295, 36.295))  # pull-in is at 36.299 V
    assert near.frequency_hz[0] < 0.2 * slack.frequency_hz[0]


def test_square_film_is_the_published_one():
    flat, tipped = square_film()
    assert flat == pytest.approx(0.4217, abs=5e-4)  # Bao and Yang (2007)
    assert 0 < tipped < flat / 12  # a rim that can leak more easily than a piston


def test_a_small_step_is_the_linear_oscillators():
    design = rings(5.0, voltages_v=(1.0, 1.0, 1.0))
    found = step_response(design)
    at = modes(design)
    omega, zeta = 2 * np.pi * at.frequency_hz.max(), 0.1
    damped = omega * np.sqrt(1 - zeta**2)
    t = found["time"].values
    shape = 1 - np.exp(-zeta * omega * t) * (np.cos(damped * t) + zeta * omega / damped * np.sin(damped * t))
    final = found["piston"].values[-1]
    # the softening of 1 V moves the frequency by 1e-3 over the few cycles that last
    np.testing.assert_allclose(found["piston"].values / final, shape, atol=5e-3)
    assert found.attrs["overshoot"] == pytest.approx(np.exp(-np.pi * zeta / np.sqrt(1 - zeta**2)), rel=0.01)


def test_settling_time_follows_the_damping():
    quick, slow = (step_response(rings(q, voltages_v=(5.0, 5.0, 5.0))) for q in (5.0, 20.0))
    # the envelope falls as e^(−ωt/2Q): four times the quality, four times as long, within half a cycle
    assert slow.attrs["settling_time_s"] / quick.attrs["settling_time_s"] == pytest.approx(4, rel=0.15)
    assert slow.attrs["settles_within_frame"] == 1


def test_overshoot_pulls_in_between_the_two_limits():
    limit = dynamic_pull_in_voltage(DESIGN)
    below, above = (rings(1e5, voltages_v=3 * (f * limit,), frame_time_ms=0.05) for f in (0.999, 1.001))
    assert step_response(below).attrs["pulled_in"] == 0
    found = step_response(above)
    assert found.attrs["pulled_in"] == 1 and np.isnan(found.attrs["settling_time_s"])


def test_a_mirror_that_rings_too_long_says_so():
    found = step_response(rings(1e5, frame_time_ms=0.2))
    assert found.attrs["settles_within_frame"] == 0 and np.isnan(found.attrs["settling_time_s"])


def test_no_step_no_motion():
    found = step_response(DESIGN, (10.0, 10.0, 10.0), (10.0, 10.0, 10.0))
    assert found.attrs["settling_time_s"] == 0
    assert np.ptp(found["piston"].values) < 1e-12  # a picometre


def test_tip_and_tilt_step_to_their_rest():
    found, rest = step_response(DESIGN, (28.0, 20.0, 20.0)), equilibrium(DESIGN, (28.0, 20.0, 20.0))
    assert found["tilt"].values[-1] == pytest.approx(rest.tilt_rad, rel=2e-3)  # e^−8 is left
    assert found["tip"].values[-1] == pytest.approx(0, abs=1e-9)
