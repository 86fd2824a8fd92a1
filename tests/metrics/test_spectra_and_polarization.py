"""Spectral angle, spectral RMSE, DoLP and AoP errors: closed forms."""

import math

import numpy as np
import pytest

from glintrack import metrics


def test_spectral_angle_is_the_angle_and_blind_to_brightness():
    a, b = np.array([[1.0, 0.0], [2.0, 2.0], [1.0, 1e-9]]), np.array([[3.0, 0.0], [0.0, 5.0], [1.0, 0.0]])
    np.testing.assert_allclose(metrics.spectral_angle(a, b), [0, math.pi / 4, 1e-9], atol=1e-15)
    assert np.isnan(metrics.spectral_angle(np.zeros((1, 2)), b[:1])).all()
    assert metrics.rmse(a, a + 2) == pytest.approx(2)


def light(degree, angle, total=10.0):
    angle = np.asarray(angle, float)
    return np.stack(
        [total + 0 * angle, total * degree * np.cos(2 * angle), total * degree * np.sin(2 * angle)], axis=-1
    )


def test_aop_error_goes_the_short_way_round():
    """179° against 1° is 2°."""
    found = metrics.aop_error(light(0.3, np.radians([179.0, 1.0])), light(0.3, np.radians([1.0, 179.0])))
    assert math.degrees(found) == pytest.approx(2)


def test_angles_of_unpolarized_and_dark_pixels_are_left_out():
    truth = np.concatenate([light(0.3, [0.5]), light(0.01, [0.5]), light(0.3, [0.5], total=0.1)])
    measured = np.concatenate([light(0.3, [0.6]), light(0.3, [1.5]), light(0.3, [1.5], total=0.1)])
    assert metrics.aop_error(measured, truth, floor=1.0) == pytest.approx(0.1)
