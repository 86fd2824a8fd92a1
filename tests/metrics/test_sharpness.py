"""Edge response and noise of frames without a target."""

import numpy as np
import pytest
from scipy.special import ndtr

from glintrack.metrics.sharpness import edge_rises, robust_sigma, temporal_noise

TEN_TO_NINETY = 2.563  # standard deviations of a Gaussian


@pytest.mark.parametrize("sigma_px", [0.6, 1.5])
def test_the_rise_of_a_blurred_edge_is_that_of_its_gaussian(sigma_px):
    """A slanted step of which the line-spread function is a Gaussian."""
    row, column = np.mgrid[:80, :80]
    image = 20 + 100 * ndtr((column - 40 + 0.1 * (row - 40)) / np.hypot(1, 0.1) / sigma_px)
    place, rise = edge_rises(image)
    assert len(rise) >= 5
    assert np.median(rise) == pytest.approx(TEN_TO_NINETY * sigma_px, rel=0.1)  # of cubic interpolation
    assert np.abs(place[:, 1] - 40 + 0.1 * (place[:, 0] - 40)).max() < 1  # a pixel


def test_temporal_noise_is_that_of_one_frame():
    """White noise over a ramp, with a corner of no data."""
    rng = np.random.default_rng(0)
    ramp = np.tile(np.linspace(0, 20, 200), (200, 1))
    first, second = (ramp + rng.normal(0, 1.5, ramp.shape) for _ in range(2))
    second[:20, :20] = np.nan
    noise = temporal_noise(first, second)
    known = noise[np.isfinite(noise)]
    assert robust_sigma(known) == pytest.approx(1.5, rel=0.05)  # of 12,000 pixels
    assert np.isnan(noise[:20, :20]).all()
    assert np.isnan(temporal_noise(first, np.full_like(first, np.nan))).all()
