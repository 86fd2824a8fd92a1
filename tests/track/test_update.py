"""What a detection's motion says of whose it is."""

import numpy as np
import pytest

from glintrack import track
from glintrack.track.update import velocity_ratio
from tests.track.test_existence import followed

MOST_M_S = 22.0


def ratio_of(velocity, share=0.7, sigma_m_s=2.0):
    """Of detections with these velocities, against a target that drives north at 10 m/s."""
    targets, n = followed([0.0]), len(velocity)
    found = track.Detections(
        np.zeros((n, 2)), np.repeat(np.eye(2)[None], n, 0), np.ones(n), np.ones(n), velocity=velocity,
        velocity_sigma_m_s=sigma_m_s, velocity_share=share, velocity_most_m_s=MOST_M_S,
    )  # fmt: skip
    targets.covariance[:, 2:, 2:] = np.eye(2)
    return velocity_ratio(targets, found, np.zeros(n, int), np.arange(n))


def test_of_clutter_the_mean_of_the_likelihood_ratio_is_one():
    """Clutter has any velocity of the disc; the Gaussian about the target lies within it."""
    rng = np.random.default_rng(3)
    square = rng.uniform(-MOST_M_S, MOST_M_S, (200_000, 2))
    clutter = square[np.hypot(*square.T) < MOST_M_S]
    four_standard_errors = 0.03
    assert np.exp(ratio_of(clutter)).mean() == pytest.approx(1.0, abs=four_standard_errors)


def test_same_motion_speaks_for_the_target_and_another_no_more_than_chance_has_it():
    same, opposite = ratio_of(np.array([[0.0, 10.0], [0.0, -10.0]]))
    area, variance = np.pi * MOST_M_S**2, 1.0 + 2.0**2
    assert same == pytest.approx(np.log(0.3 + 0.7 * area / (2 * np.pi * variance)))
    assert opposite == pytest.approx(np.log(0.3), abs=1e-3)


def test_velocities_that_are_never_right_say_nothing():
    np.testing.assert_allclose(ratio_of(np.array([[0.0, 10.0], [5.0, -3.0]]), share=0.0), 0.0)
