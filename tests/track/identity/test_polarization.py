"""Polarization features: DoLP and angle as a vector, forgetting, and that they tell rivals apart."""

import numpy as np

from glintrack.track.detect.frame import Frame, Grid, grid_of
from glintrack.track.identity import polarization
from tests.track.moving_blobs import image

EXTENT = (0.0, 0.0, 30.0, 30.0)


def test_features_are_the_stokes_ratios_about_the_detection():
    """Q = DoLP · I over one patch, nothing elsewhere; no light gives none."""
    pan, dolp = np.full((20, 20), 4.0), np.zeros((20, 20))
    dolp[8:13, 8:13] = 0.3
    pan[:5] = 0.0
    frame = image(pan, EXTENT, 1.5, dolp)
    grid = grid_of(Frame(0.0, frame), None)
    assert isinstance(grid, Grid)
    where = np.array([[15.75, 14.25], [3.75, 3.75], [15.0, 29.0]])
    got = polarization.of_detections(frame, grid, where)
    np.testing.assert_allclose(got[:2], [[0.3, 0.0], [0.0, 0.0]], atol=1e-6)
    assert np.isnan(got[2]).all()


def test_angle_of_polarization_has_no_jump():
    """179° and 1° of one DoLP lie side by side."""
    angle = np.deg2rad([179.0, 1.0, 90.0])
    u = 0.3 * np.stack([np.cos(2 * angle), np.sin(2 * angle)], axis=-1)
    assert np.linalg.norm(u[0] - u[1]) < 0.03 < np.linalg.norm(u[0] - u[2])


def test_mean_forgets_and_missing_looks_leave_it():
    mean, observations = np.zeros((1, 2)), np.zeros(1)
    for _ in range(30):
        mean, observations = polarization.remember(mean, observations, np.array([[0.4, 0.0]]))
    np.testing.assert_allclose(mean, [[0.4, 0.0]])
    for _ in range(30):
        mean, observations = polarization.remember(mean, observations, np.array([[0.0, 0.2]]))
    assert np.abs(mean - [[0.0, 0.2]]).max() < 0.4 * (5 / 6) ** 29
    same, count = polarization.remember(mean, observations, np.full((1, 2), np.nan))
    assert (same == mean).all() and (count == observations).all()
