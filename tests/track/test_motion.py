"""Kalman filter and interacting modes: a case worked by hand, an independent IMM, what must hold for any."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from glintrack.track.motion import (
    Modes,
    Motion,
    combine_modes,
    initial_modes,
    motion_model,
    predict_modes,
    update_modes,
)
from tests.plain import plain_tracker

rounding = 1e-12
NEVER = np.array([np.inf])


def straight(q, dt):
    return motion_model(
        plain_tracker().replace({"motion.acceleration_psd_m2_s3": q, "motion.model": "constant-velocity"}), dt
    )


def one_mode(mean, covariance):
    mean, covariance = np.asarray(mean, float), np.asarray(covariance, float)
    return Modes(mean[:, None], covariance[:, None], np.ones((len(mean), 1)))


def hit_each(modes, motion, measured, noise):
    """Target k meets detection k; a row of NaN is a miss."""
    seen = np.isfinite(measured).all(axis=1)
    first = np.r_[0, np.cumsum(seen)]
    return update_modes(
        modes, motion, np.ones(len(seen)), first, np.flatnonzero(seen), np.ones(seen.sum()), measured, noise
    )


def test_hand_worked_step():
    """dt = 2, q = 3, P = diag(4, 5, 1, 2), measured (12, −4) with R = diag(2, 1).

    Predicted east: position 10 + 2·1 = 12, variance 4 + 4·1 + 3·8/3 = 16, covariance 2·1 + 3·4/2 = 8, speed
    variance 1 + 3·2 = 7. North: −3 + 2·(−1) = −5; 5 + 4·2 + 8 = 21; 2·2 + 6 = 10; 2 + 6 = 8.
    Update: gains 16/18, 8/18 and 21/22, 10/22; innovations 0 and 1.
    """
    motion = straight(3.0, 2.0)
    modes = predict_modes(
        one_mode([[10.0, -3.0, 1.0, -1.0]], np.diag([4.0, 5.0, 1.0, 2.0])[None]), motion, NEVER
    )
    np.testing.assert_allclose(modes.mean[0], [[12, -5, 1, -1]], atol=rounding)
    expected = [[16, 0, 8, 0], [0, 21, 0, 10], [8, 0, 7, 0], [0, 10, 0, 8]]
    np.testing.assert_allclose(modes.covariance[0, 0], expected, atol=rounding)
    modes = hit_each(modes, motion, np.array([[12.0, -4.0]]), np.diag([2.0, 1.0])[None])
    np.testing.assert_allclose(modes.mean[0], [[12, -5 + 21 / 22, 1, -1 + 10 / 22]], atol=rounding)
    expected = np.zeros((4, 4))
    expected[0, 0], expected[0, 2], expected[2, 2] = 16 - 256 / 18, 8 - 128 / 18, 7 - 64 / 18
    expected[1, 1], expected[1, 3], expected[3, 3] = 21 - 441 / 22, 10 - 210 / 22, 8 - 100 / 22
    expected += np.triu(expected, 1).T
    np.testing.assert_allclose(modes.covariance[0, 0], expected, atol=rounding)


def test_turn_to_the_left_by_a_quarter_circle():
    """20° s⁻¹ for 4.5 s at 10 m/s east: one radius north-east it drives north."""
    design = plain_tracker().replace({"motion.model": "imm"})
    motion = motion_model(design, 4.5)
    left, right, radius = 1, 2, 10 / np.deg2rad(20.0)
    way = motion.reach @ np.array([10.0, 0.0])
    np.testing.assert_allclose(way[left], [radius, radius], atol=rounding)
    np.testing.assert_allclose(way[right], [radius, -radius], atol=rounding)
    np.testing.assert_allclose(motion.turn[left] @ [10.0, 0.0], [0, 10], atol=rounding)
    np.testing.assert_allclose(motion.transition.sum(axis=1), 1, atol=rounding)


def test_equals_the_imm_of_filterpy():
    """Two modes of the same filter with different noise, ten steps; FilterPy is an independent program."""
    filterpy = pytest.importorskip("filterpy.kalman", reason="filterpy (extra dev) is not installed")
    rng = np.random.default_rng(4)
    dt, noise = 0.5, np.diag([0.3, 0.4])
    calm, agile = straight(0.5, dt), straight(8.0, dt)
    transition = np.array([[0.9, 0.1], [0.3, 0.7]])
    motion = Motion(
        np.concatenate([calm.reach, agile.reach]),
        np.concatenate([calm.turn, agile.turn]),
        np.concatenate([calm.noise, agile.noise]),
        transition,
        np.array([0.9, 0.9]),
        -1,
    )
    start, spread = np.array([1.0, 2.0, 3.0, -1.0]), np.diag([1.0, 2.0, 9.0, 8.0])
    filters = []
    for which in (calm, agile):
        one = filterpy.KalmanFilter(dim_x=4, dim_z=2)
        one.x, one.P, one.Q, one.R = start[:, None].copy(), spread.copy(), which.noise[0], noise
        one.F, one.H = np.eye(4) + dt * np.eye(4, k=2), np.eye(2, 4)
        filters.append(one)
    peer = filterpy.IMMEstimator(filters, np.array([0.6, 0.4]), transition)
    modes = Modes(
        np.repeat(start[None, None], 2, axis=1),
        np.repeat(spread[None, None], 2, axis=1),
        np.array([[0.6, 0.4]]),
    )
    for _ in range(10):
        z = rng.normal(0, 3, 2)
        peer.predict()
        peer.update(z[:, None])
        modes = hit_each(predict_modes(modes, motion, NEVER), motion, z[None], noise[None])
        mean, covariance = combine_modes(modes)
        np.testing.assert_allclose(modes.probability[0], peer.mu, atol=1e-10)  # both round in ten steps
        np.testing.assert_allclose(mean[0], peer.x[:, 0], atol=1e-10)
        np.testing.assert_allclose(covariance[0], peer.P, atol=1e-9)


def test_misses_make_a_vehicle_stand():
    """The mode that is seldom detected gains with each miss, by the ratio of the probabilities of a miss."""
    design = plain_tracker().replace(
        {
            "motion.model": "imm",
            "association.detection_probability": 0.9,
            "motion.stopped_detection_probability": 0.1,
        }
    )
    motion = motion_model(design, 0.5)
    modes = initial_modes(np.zeros((1, 2)), np.eye(2)[None], 25.0 * np.eye(2)[None], design.motion.modes)
    before = modes.probability[0]
    after = update_modes(
        modes, motion, np.ones(1), np.array([0, 0]), np.empty(0, int), np.empty(0), np.empty((0, 2)),
        np.empty((0, 2, 2)),
    ).probability[0]  # fmt: skip
    expected = before * (1 - motion.detection)
    np.testing.assert_allclose(after, expected / expected.sum(), atol=rounding)
    unseen = update_modes(
        modes, motion, np.zeros(1), np.array([0, 0]), np.empty(0, int), np.empty(0), np.empty((0, 2)),
        np.empty((0, 2, 2)),
    ).probability[0]  # fmt: skip
    np.testing.assert_allclose(unseen, before, atol=rounding)  # where there is no data a miss says nothing


@pytest.mark.parametrize("braking_m_s2", [3.0, 6.0])
def test_what_drives_fast_does_not_stand(braking_m_s2):
    """At rest the chance to stop is the design's, at v it is exp(−v²/2s²) of that; the rest goes on."""
    design = plain_tracker().replace({"motion.model": "imm", "motion.braking_m_s2": braking_m_s2})
    dt, variance = 0.5, 0.25
    motion = motion_model(design, dt)
    mean = np.zeros((2, 4, 4))
    mean[1, :, 2] = 5.0
    start = Modes(
        mean, np.repeat(variance * np.eye(4)[None, None], 2, 0).repeat(4, 1), np.eye(1, 4).repeat(2, 0)
    )
    after = predict_modes(start, motion, np.repeat(NEVER, 2)).probability
    np.testing.assert_allclose(after[0], motion.transition[0], atol=rounding)
    slow = np.exp(-0.5 * 5.0**2 / ((1.0 + braking_m_s2 * dt) ** 2 + variance))
    np.testing.assert_allclose(after[1, 3], slow * motion.transition[0, 3], atol=rounding)
    np.testing.assert_allclose(after[1].sum(), 1, atol=rounding)
    np.testing.assert_array_equal(after[1, 1:3], motion.transition[0, 1:3])


def test_two_half_detections_are_a_mixture():
    """Weights ½ and ½: the mean of both updates, and the spread between them added."""
    motion = straight(1.0, 0.0)
    modes = one_mode(np.zeros((1, 4)), np.diag([3.0, 3.0, 1.0, 1.0])[None])
    measured, noise = np.array([[4.0, 0.0], [-4.0, 0.0]]), np.repeat(np.eye(2)[None], 2, axis=0)
    after = update_modes(
        modes, motion, np.ones(1), np.array([0, 2]), np.array([0, 1]), np.array([0.5, 0.5]), measured, noise
    )
    np.testing.assert_allclose(after.mean[0, 0], 0, atol=rounding)
    # each update moves by 3/4 · 4 = 3 and leaves 3/4 of variance
    np.testing.assert_allclose(after.covariance[0, 0, 0, 0], 0.75 + 9, atol=rounding)
    np.testing.assert_allclose(after.covariance[0, 0, 1, 1], 0.75, atol=rounding)


def test_damped_speed_covers_its_stopping_distance():
    """A speed that decays in τ covers v·τ in the end, and e⁻¹ of it is left after τ."""
    start = one_mode([[0.0, 0.0, 6.0, 0.0]], np.zeros((1, 4, 4)))
    after = predict_modes(start, straight(1.0, 2.0), np.array([2.0]))
    np.testing.assert_allclose(after.mean[0, 0], [12 * (1 - np.exp(-1)), 0, 6 * np.exp(-1), 0], atol=rounding)
    rest = predict_modes(start, straight(1.0, 1e4), np.array([2.0]))
    np.testing.assert_allclose(rest.mean[0, 0], [12, 0, 0, 0], atol=1e-9)  # 1e4 times a rounding of 1e-13


def test_position_grows_no_wider_than_asked():
    start = one_mode(np.zeros((1, 4)), np.diag([1.0, 1.0, 9.0, 9.0])[None])
    after = predict_modes(start, straight(2.0, 60.0), NEVER, widest_m=20.0)
    spread = after.covariance[0, 0]
    np.testing.assert_allclose(0.5 * (spread[0, 0] + spread[1, 1]), 400.0, rtol=rounding)
    assert np.linalg.eigvalsh(spread).min() > 0


def test_row_of_nan_leaves_target_as_it_is():
    start = one_mode(np.ones((2, 4)), np.repeat(np.eye(4)[None], 2, axis=0))
    measured = np.array([[np.nan, np.nan], [2.0, 2.0]])
    after = hit_each(start, straight(1.0, 1.0), measured, np.repeat(np.eye(2)[None], 2, axis=0))
    np.testing.assert_array_equal(after.mean[0], start.mean[0])
    np.testing.assert_array_equal(after.covariance[0], start.covariance[0])
    assert after.mean[1, 0, 0] == 1.5


@pytest.mark.parametrize("motion", ["constant-velocity", "imm"])
@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_covariance_stays_positive_semidefinite(motion, seed):
    """Through 100 steps with random intervals, damping, misses and correlated measurements."""
    rng = np.random.default_rng(seed)
    n, design = 5, plain_tracker().replace({"motion.model": motion})
    modes = initial_modes(
        np.zeros((n, 2)), np.repeat(np.eye(2)[None], n, 0), 64.0 * np.eye(2)[None], design.motion.modes
    )
    for _ in range(100):
        move = motion_model(design, rng.uniform(0.05, 2))
        damping = np.where(rng.random(n) < 0.5, np.inf, 3.0)
        modes = predict_modes(modes, move, damping, 30.0)
        root = rng.normal(size=(n, 2, 2)) * 10 ** rng.uniform(-2, 1)
        noise = root @ root.transpose(0, 2, 1) + 1e-4 * np.eye(2)
        measured = np.where(rng.random((n, 1)) < 0.7, rng.normal(0, 100, (n, 2)), np.nan)
        modes = hit_each(modes, move, measured, noise)
        np.testing.assert_allclose(modes.probability.sum(axis=1), 1, atol=1e-9)  # rounding, renormalised
    _, covariance = combine_modes(modes)
    values = np.linalg.eigvalsh(covariance)
    assert (covariance == covariance.transpose(0, 2, 1)).all()
    assert values.min() > -1e-9 * values.max()  # rounding of differences of like size


def test_arguments_are_not_changed():
    start = one_mode(np.ones((1, 4)), np.eye(4)[None])
    predict_modes(start, straight(1.0, 1.0), NEVER)
    hit_each(start, straight(1.0, 1.0), np.zeros((1, 2)), np.eye(2)[None])
    assert (start.mean == 1).all() and (start.covariance == np.eye(4)).all()


def test_vehicles_drive_straight_for_the_mean_time_of_the_design():
    motion = motion_model(plain_tracker().replace({"motion.model": "imm", "motion.straight_s": 20.0}), 0.5)
    assert motion.transition[0, 0] == pytest.approx(np.exp(-0.5 / 20.0))
