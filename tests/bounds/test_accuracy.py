"""Posterior bounds: Stone Soup's recursion, steady states, uncertain origin."""

from datetime import datetime, timedelta

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from glintrack.bounds.accuracy import (
    GATE,
    Kinematics,
    information_reduction,
    posterior_bound,
)

MOTION = Kinematics(1.5, 8.0)
R = np.array([[2.0, 0.3], [0.3, 0.8]])
STEP_S = 0.5


def position_rms(bound):
    return np.sqrt(bound[..., 0, 0] + bound[..., 1, 1])


def every(count, information):
    return STEP_S * np.arange(count), np.broadcast_to(information, (count, 2, 2))


def model():
    forward = np.kron([[1.0, STEP_S], [0.0, 1.0]], np.eye(2))
    noise = MOTION.acceleration_psd * np.kron(
        [[STEP_S**3 / 3, STEP_S**2 / 2], [STEP_S**2 / 2, STEP_S]], np.eye(2)
    )
    return forward, noise


def test_the_recursion_is_stone_soups_without_misses_and_clutter():
    """Its prior is a state that has been updated, hence ours after the first frame; P_D = 1, no clutter."""
    soup = pytest.importorskip("stonesoup.metricgenerator.pcrbmetric")
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.types.array import StateVectors
    from stonesoup.types.groundtruth import GroundTruthPath, GroundTruthState
    from stonesoup.types.state import GaussianState

    bound = posterior_bound(*every(30, np.linalg.inv(R)), MOTION)
    theirs = [0, 2, 1, 3]  # east, its speed, north, its speed
    epoch = datetime(2026, 1, 1)
    path = GroundTruthPath(
        [
            GroundTruthState([[0], [8], [0], [3]], timestamp=epoch + timedelta(seconds=STEP_S * k))
            for k in range(30)
        ]
    )
    metric = soup.PCRBMetric(
        prior=GaussianState(np.zeros((4, 1)), bound[0][np.ix_(theirs, theirs)], timestamp=epoch),
        transition_model=CombinedLinearGaussianTransitionModel(
            [ConstantVelocity(MOTION.acceleration_psd)] * 2
        ),
        measurement_model=LinearGaussian(4, (0, 2), R),
        sensor_locations=StateVectors([[0.0], [0.0]]),
    )
    found = metric._compute_pcrb_single(
        metric.prior, metric.transition_model, metric.measurement_model, path, metric.sensor_locations,
        metric.irf, metric.position_mapping, metric.velocity_mapping,
    )  # fmt: skip
    np.testing.assert_allclose(position_rms(bound), found["position_RMSE"], rtol=1e-9)
    np.testing.assert_allclose(bound[:, theirs][:, :, theirs], found["inverse_j"], rtol=1e-7, atol=1e-9)


def test_long_after_the_prior_the_bound_is_riccatis():
    forward, noise = model()
    place = np.eye(2, 4)
    predicted = solve_discrete_are(forward.T, place.T, noise, R)
    settled = np.linalg.inv(np.linalg.inv(predicted) + place.T @ np.linalg.inv(R) @ place)
    bound = posterior_bound(*every(200, np.linalg.inv(R)), MOTION)
    np.testing.assert_allclose(bound[-1], settled, rtol=1e-8)


def test_unseen_frames_let_the_bound_grow_and_the_prior_waits_for_the_first():
    times, information = every(6, np.linalg.inv(R))
    information = information * np.array([0, 0, 1, 1, 0, 1.0])[:, None, None]
    both = posterior_bound(times, np.stack([information, information]), MOTION, np.array([0, 2]))
    rms = position_rms(both)
    assert (rms[:, 4] > rms[:, 3]).all() and (rms[:, 5] < rms[:, 4]).all()
    late = posterior_bound(times[2:], information[2:], MOTION)
    np.testing.assert_allclose(both[1, 2:], late)
    forward, noise = model()
    np.testing.assert_allclose(both[0, 4], forward @ both[0, 3] @ forward.T + noise)


def test_without_clutter_the_reduction_is_the_probability_of_detection():
    rng = np.random.default_rng(0)
    assert information_reduction(1.0, 0.0, rng) == 1.0
    assert information_reduction(0.3, 0.0, rng) == 0.3
    assert information_reduction(0.0, 0.1, rng) == 0.0
    few = [information_reduction(0.8, c, np.random.default_rng(0)) for c in (1e-4, 1e-2, 0.1, 1.0)]
    assert few[0] == pytest.approx(0.8, abs=0.01) and (np.diff(few) < 0).all()


@pytest.mark.parametrize(("probability", "clutter"), [(0.7, 0.02), (0.95, 0.1)])
def test_the_reduction_is_the_curvature_of_the_scans_likelihood(probability, clutter):
    """The mean second derivative of ln p(scan | place), by differences over scans drawn here one by one."""
    rng, step, total, draws = np.random.default_rng(3), 0.05, [], 12_000
    moves = np.array([[0, 0], [step, 0], [-step, 0], [0, step], [0, -step]])
    for _ in range(draws):
        scan = rng.uniform(
            -GATE, GATE, (rng.poisson(clutter * 4 * GATE**2), 2)
        )  # a square: edges say nothing
        if rng.random() < probability:
            scan = np.concatenate([scan, rng.standard_normal((1, 2))])
        near = np.exp(-0.5 * ((scan[:, None] - moves) ** 2).sum(-1)).sum(0) / (2 * np.pi)
        log = np.log((1 - probability) * clutter + probability * near)
        total.append(-(log[1:].sum() - 4 * log[0]) / step**2 / 2)
    expected, four_errors = np.mean(total), 4 * np.std(total) / np.sqrt(draws)
    found = information_reduction(probability, clutter, rng)
    assert found == pytest.approx(expected, abs=four_errors + 0.01)


def test_bad_input_is_one_sentence():
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match=r"`detection_probability` must lie within 0 and 1; got 1.2"):
        information_reduction(1.2, 0.0, rng)
    with pytest.raises(ValueError, match="`clutter` must be at least 0; got -1"):
        information_reduction(0.5, -1.0, rng)
