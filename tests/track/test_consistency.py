"""Are the covariances true? Normalized estimation error squared (NEES) against its χ² distribution."""

import numpy as np
import pytest
from scipy.stats import chi2

from glintrack.track.motion import combine_modes, initial_modes, motion_model, predict_modes, update_modes
from tests.plain import plain_tracker

TARGETS, STEPS, DT = 300, 40, 0.5
SIGMA_M = 0.6
# Bar-Shalom et al. (2001) §5.4.2 asks for 95 %; of 40 steps two would then fall out by chance
CONFIDENCE = 0.9999


def errors(modes, truth):
    mean, covariance = combine_modes(modes)
    difference = mean - truth
    return np.einsum("ni,nij,nj->n", difference, np.linalg.inv(covariance), difference)


def update_targets(modes, motion, truth, rng, detected):
    """One look at every target; those not detected miss."""
    n = len(truth)
    hit = np.flatnonzero(detected)
    measured = truth[hit, :2] + rng.normal(0, SIGMA_M, (len(hit), 2))
    noise = np.repeat(SIGMA_M**2 * np.eye(2)[None], len(hit), axis=0)
    first = np.searchsorted(hit, np.arange(n + 1))
    return update_modes(
        modes, motion, np.ones(n), first, np.arange(len(hit)), np.ones(len(hit)), measured, noise
    )


def test_one_mode_is_consistent():
    """Truth drawn from the model itself: the mean NEES of 300 targets is χ² of 1200 degrees over 300."""
    rng = np.random.default_rng(0)
    design = plain_tracker().replace({"motion.model": "constant-velocity"})
    motion = motion_model(design, DT)
    low, high = chi2.ppf([(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], 4 * TARGETS) / TARGETS
    truth = np.column_stack([rng.uniform(0, 500, (TARGETS, 2)), rng.normal(0, 8, (TARGETS, 2))])
    first = truth[:, :2] + rng.normal(0, SIGMA_M, (TARGETS, 2))
    eye = np.repeat(np.eye(2)[None], TARGETS, axis=0)
    modes = initial_modes(first, SIGMA_M**2 * eye, 64.0 * eye, 1)
    f, root = np.eye(4) + DT * np.eye(4, k=2), np.linalg.cholesky(motion.noise[0])
    for _ in range(STEPS):
        truth = truth @ f.T + rng.normal(size=(TARGETS, 4)) @ root.T
        modes = predict_modes(modes, motion, np.full(TARGETS, np.inf))
        modes = update_targets(
            modes, motion, truth, rng, rng.random(TARGETS) < design.association.detection_probability
        )
        assert low <= errors(modes, truth).mean() <= high


def test_interacting_modes_are_nearly_consistent():
    """Truth that drives straight, turns, stops and starts by the design's own chances.

    The filter keeps one Gaussian a mode where the truth has a tree of them: the mean NEES is no exact χ². It
    must stay within a factor of 1.5 of 4, which is a factor of 1.25 in every standard deviation.
    """
    rng = np.random.default_rng(1)
    design = plain_tracker().replace({"motion.model": "imm"})
    motion = motion_model(design, DT)
    truth = np.column_stack([rng.uniform(0, 500, (TARGETS, 2)), rng.normal(0, 6, (TARGETS, 2))])
    mode = np.zeros(TARGETS, int)
    eye = np.repeat(np.eye(2)[None], TARGETS, axis=0)
    first = truth[:, :2] + rng.normal(0, SIGMA_M, (TARGETS, 2))
    modes = initial_modes(first, SIGMA_M**2 * eye, 64.0 * eye, 4)
    found = []
    for k in range(STEPS):
        slow = np.exp(-0.5 * (truth[:, 2:] ** 2).sum(axis=1) / motion.stopping2)
        stays = rng.random(TARGETS) >= slow  # what drives fast does not stand at the next look
        drawn = np.array([rng.choice(4, p=motion.transition[m]) for m in mode])
        mode = np.where((drawn == motion.stopped) & stays, mode, drawn)
        place = truth[:, :2] + np.einsum("nij,nj->ni", motion.reach[mode], truth[:, 2:])
        velocity = np.einsum("nij,nj->ni", motion.turn[mode], truth[:, 2:])
        roots = np.linalg.cholesky(motion.noise)[mode]
        truth = np.concatenate([place, velocity], axis=1) + np.einsum(
            "nij,nj->ni", roots, rng.normal(size=(TARGETS, 4))
        )
        modes = predict_modes(modes, motion, np.full(TARGETS, np.inf))
        modes = update_targets(modes, motion, truth, rng, rng.random(TARGETS) < motion.detection[mode])
        if k >= 5:  # a new target's modes are guessed
            found.append(errors(modes, truth).mean())
    assert np.mean(found) == pytest.approx(4.0, rel=0.5)
