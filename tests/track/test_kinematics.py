"""The Kalman filter against a case worked by hand, and what must hold for any."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from glintrack.track import kinematics

rounding = 1e-12


def test_hand_worked_step():
    """dt = 2, q = 3, P = diag(4, 5, 1, 2), measured (12, −4) with R = diag(2, 1).

    Predicted east: position 10 + 2·1 = 12, variance 4 + 4·1 + 3·8/3 = 16, covariance 2·1 + 3·4/2 = 8, speed
    variance 1 + 3·2 = 7. North: −3 + 2·(−1) = −5; 5 + 4·2 + 8 = 21; 2·2 + 6 = 10; 2 + 6 = 8.
    Update: gains 16/18, 8/18 and 21/22, 10/22; innovations 0 and 1.
    """
    mean = np.array([[10.0, -3.0, 1.0, -1.0]])
    covariance = np.diag([4.0, 5.0, 1.0, 2.0])[None]
    mean, covariance = kinematics.predict(mean, covariance, 2.0, 3.0)
    np.testing.assert_allclose(mean, [[12, -5, 1, -1]], atol=rounding)
    expected = [[16, 0, 8, 0], [0, 21, 0, 10], [8, 0, 7, 0], [0, 10, 0, 8]]
    np.testing.assert_allclose(covariance[0], expected, atol=rounding)
    mean, covariance = kinematics.update(
        mean, covariance, np.array([[12.0, -4.0]]), np.diag([2.0, 1.0])[None]
    )
    np.testing.assert_allclose(mean, [[12, -5 + 21 / 22, 1, -1 + 10 / 22]], atol=rounding)
    expected = np.zeros((4, 4))
    expected[0, 0], expected[0, 2], expected[2, 2] = 16 - 256 / 18, 8 - 128 / 18, 7 - 64 / 18
    expected[1, 1], expected[1, 3], expected[3, 3] = 21 - 441 / 22, 10 - 210 / 22, 8 - 100 / 22
    expected += np.triu(expected, 1).T
    np.testing.assert_allclose(covariance[0], expected, atol=rounding)


def test_damped_speed_covers_its_stopping_distance():
    """A speed that decays in τ covers v·τ in the end, and e⁻¹ of it is left after τ."""
    mean, covariance = np.array([[0.0, 0.0, 6.0, 0.0]]), np.zeros((1, 4, 4))
    after, _ = kinematics.predict(mean, covariance, 2.0, 1.0, np.array([2.0]))
    np.testing.assert_allclose(after[0], [12 * (1 - np.exp(-1)), 0, 6 * np.exp(-1), 0], atol=rounding)
    rest, _ = kinematics.predict(mean, covariance, 1e4, 1.0, np.array([2.0]))
    np.testing.assert_allclose(rest[0], [12, 0, 0, 0], atol=rounding)


def test_row_of_nan_leaves_target_as_it_is():
    mean, covariance = np.ones((2, 4)), np.repeat(np.eye(4)[None], 2, axis=0)
    measured = np.array([[np.nan, np.nan], [2.0, 2.0]])
    after, spread = kinematics.update(mean, covariance, measured, np.repeat(np.eye(2)[None], 2, axis=0))
    np.testing.assert_array_equal(after[0], mean[0])
    np.testing.assert_array_equal(spread[0], covariance[0])
    assert after[1, 0] == 1.5


@given(st.integers(0, 2**32 - 1))
def test_covariance_stays_positive_semidefinite(seed):
    """Through 200 steps with random intervals, damping, misses and correlated measurements."""
    rng = np.random.default_rng(seed)
    n = 5
    mean, covariance = np.zeros((n, 4)), np.repeat(np.diag([1.0, 1.0, 64.0, 64.0])[None], n, axis=0)
    for _ in range(200):
        damping = np.where(rng.random(n) < 0.5, np.inf, 3.0)
        mean, covariance = kinematics.predict(mean, covariance, rng.uniform(0.05, 2), 4.0, damping)
        root = rng.normal(size=(n, 2, 2)) * 10 ** rng.uniform(-2, 1)
        noise = root @ root.transpose(0, 2, 1) + 1e-4 * np.eye(2)
        measured = np.where(rng.random((n, 1)) < 0.7, rng.normal(0, 100, (n, 2)), np.nan)
        mean, covariance = kinematics.update(mean, covariance, measured, noise)
    values = np.linalg.eigvalsh(covariance)
    assert (covariance == covariance.transpose(0, 2, 1)).all()
    assert values.min() > -1e-9 * values.max()  # rounding of differences of like size


def test_arguments_are_not_changed():
    mean, covariance = np.ones((1, 4)), np.eye(4)[None]
    kinematics.predict(mean, covariance, 1.0, 1.0)
    kinematics.update(mean, covariance, np.zeros((1, 2)), np.eye(2)[None])
    assert (mean == 1).all() and (covariance == np.eye(4)).all()
