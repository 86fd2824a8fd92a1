"""The navigator's errors: their RMS, their correlation in time, their presets."""

import math

import numpy as np
import pytest
from pydantic import ValidationError

from glintrack.camera import Pose, look_at
from glintrack.sensor import NavigationDesign, navigate, navigation_errors
from glintrack.sensor.navigation import COMPONENTS, HARMONIC_HZ

TRUE = look_at(Pose(10.0, 20.0, 3000.0, 0.1, 0.02, 0.03), (0.0, 0.0, 0.0))


def errors(design, frames, step_s=1.0, seed=0):
    rngs = [np.random.default_rng([seed, k]) for k in range(frames)]
    return navigation_errors(design, np.arange(frames) * step_s, rngs)


def test_a_perfect_navigator_reports_the_true_pose():
    reported = navigate(TRUE, errors(NavigationDesign(), 1)[0])
    assert reported.kind == "reported" and TRUE.kind == "true"
    assert {**vars(reported), "kind": "true"} == vars(TRUE)


@pytest.mark.parametrize(
    ("keys", "level"),
    [
        ({"position_rms_m": 2.0, "roll_pitch_rms_deg": 0.1, "heading_rms_deg": 0.5}, 0.1),
        ({"drift_position_rms_m": 2.0, "drift_angle_rms_deg": 0.5}, 0.5),
    ],
)
def test_white_and_drifting_errors_have_their_rms_and_no_mean(keys, level):
    # frames a hundred correlation times apart are as good as independent
    found = errors(NavigationDesign(**keys, drift_time_s=1.0), 4000, step_s=100.0)
    expected = np.array([2.0, 2.0, 2.0, math.radians(0.5), math.radians(level), math.radians(level)])
    five_sigmas_of_an_rms = 5 / math.sqrt(2 * 4000)
    np.testing.assert_allclose(np.sqrt((found**2).mean(axis=0)) / expected, 1, atol=five_sigmas_of_an_rms)
    assert (np.abs(found.mean(axis=0)) < 5 * expected / math.sqrt(4000)).all()
    correlation = np.corrcoef(found, rowvar=False) - np.eye(6)
    assert np.abs(correlation).max() < 5 / math.sqrt(4000)


@pytest.mark.parametrize("step_s", [0.5, 2.0])
def test_the_drift_has_its_correlation_time(step_s):
    """Covariance e^(−Δt/τ), whatever the frame rate."""
    design = NavigationDesign(drift_position_rms_m=3.0, drift_time_s=10.0)
    series = np.concatenate([errors(design, 8000, step_s, seed)[:, :3] for seed in (1, 2)], axis=1)
    independent = 8000 * step_s / (2 * 10.0) * 6  # a correlated series holds T/2τ independent values
    five_sigmas = 5 / math.sqrt(independent)
    assert np.sqrt((series**2).mean()) == pytest.approx(3.0, rel=five_sigmas)
    for lag_s in (4.0, 10.0, 20.0):
        lag = round(lag_s / step_s)
        covariance = (series[lag:] * series[:-lag]).mean() / 3.0**2
        assert covariance == pytest.approx(math.exp(-lag_s / 10.0), abs=five_sigmas)


def test_white_errors_are_not_correlated_in_time():
    series = errors(NavigationDesign(position_rms_m=1.0), 8000)[:, 0]
    assert abs((series[1:] * series[:-1]).mean()) < 5 / math.sqrt(8000)


def test_the_harmonic_error_is_a_sine_of_its_rms_and_frequency():
    design = NavigationDesign(harmonic_angle_rms_deg=0.01)
    series = errors(design, 1000, step_s=0.01)
    np.testing.assert_allclose(series[:, :3], 0)
    rms = math.radians(0.01)
    np.testing.assert_allclose(
        np.sqrt((series[:, 3:] ** 2).mean(axis=0)), rms, rtol=1e-9
    )  # 110 whole periods
    spectrum = np.abs(np.fft.rfft(series[:, 4]))
    assert np.fft.rfftfreq(1000, 0.01)[spectrum.argmax()] == pytest.approx(HARMONIC_HZ)


def test_designs_draw_the_same_deviates():
    """Trade studies stay paired: twice the RMS is twice the same error."""
    one, two = (
        errors(NavigationDesign(position_rms_m=r, drift_angle_rms_deg=r), 5, seed=7) for r in (1.0, 2.0)
    )
    np.testing.assert_allclose(two, 2 * one, rtol=1e-12)


def test_a_frame_has_the_same_error_however_many_follow():
    design = NavigationDesign(preset="pos-av-510", position_rms_m=0.2)
    np.testing.assert_array_equal(errors(design, 3), errors(design, 9)[:3])


def test_the_error_is_reported_less_true_and_leaves_the_gimbal():
    error = np.array([1, 2, 3, 0.1, 0.2, 0.3])
    reported = navigate(TRUE, error)
    np.testing.assert_allclose([getattr(reported, n) - getattr(TRUE, n) for n in COMPONENTS], error)
    assert reported.gimbal_azimuth_rad == TRUE.gimbal_azimuth_rad


def test_presets_give_what_is_left_out_and_keys_win():
    preset = NavigationDesign(preset="pos-av-510").drift
    np.testing.assert_allclose(np.degrees(preset[3:]), [0.008, 0.005, 0.005])
    changed = NavigationDesign(preset="pos-av-510", drift_angle_rms_deg=0.07).drift
    np.testing.assert_allclose(np.degrees(changed[3:]), 0.07)
    assert changed[0] == 0.1
    assert NavigationDesign(preset="jitter").harmonic[3] == math.radians(0.005)


@pytest.mark.parametrize("keys", [{"preset": "good"}, {"position_rms_m": -1}, {"drift_time_s": 0}])
def test_designs_refuse_what_cannot_be(keys):
    with pytest.raises(ValidationError):
        NavigationDesign(**keys)


def test_one_generator_a_frame():
    with pytest.raises(ValueError, match="one generator a frame; got 1 for 2"):
        navigation_errors(NavigationDesign(), np.zeros(2), [np.random.default_rng(0)])
