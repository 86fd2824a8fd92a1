"""Phase correlation: known displacements come back, and nothing is claimed where nothing can be known."""

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from glintrack.ortho.image_shift import displacement_between

TENTH_PX = 0.1


def texture(rows=96, columns=128, seed=0):
    """Band-limited random ground as a function of place, so that any displacement of it is exact."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(0, 0.08, (300, 2)), rng.uniform(0, 2 * math.pi, 300)

    def at(row_shift=0.0, column_shift=0.0):
        y, x = np.mgrid[:rows, :columns].astype(float)
        phase = (
            2
            * np.pi
            * (waves[0][:, 0, None, None] * (y - row_shift) + waves[0][:, 1, None, None] * (x - column_shift))
        )
        return np.cos(phase + waves[1][:, None, None]).sum(axis=0)

    return at


@pytest.mark.parametrize("moved", [(0, 0), (3, -2), (0.37, 1.62), (-5.25, 0.5), (7.9, -9.1)])
def test_a_known_displacement_comes_back(moved):
    at = texture()
    rows, columns, clearness = displacement_between(at(*moved) * 3 + 100, at())
    assert (rows, columns) == pytest.approx(moved, abs=TENTH_PX)
    assert clearness > 2


def test_noise_and_missing_pixels_are_borne():
    at, rng = texture(), np.random.default_rng(1)
    image = at(1.4, -0.8) + rng.normal(0, 0.2 * at().std(), (96, 128))
    image[20:30, 40:70] = np.nan
    image[:, :5] = np.nan
    rows, columns, _ = displacement_between(image, at())
    assert (rows, columns) == pytest.approx((1.4, -0.8), abs=2 * TENTH_PX)


def test_displacements_beyond_reach_are_not_claimed():
    at = texture()
    rows, columns, _ = displacement_between(at(12, 9), at(), max_px=5)
    assert math.isnan(rows) and math.isnan(columns)


def test_unrelated_pictures_have_none():
    first, second = (gaussian_filter(np.random.default_rng(k).normal(size=(96, 128)), 1.0) for k in (1, 2))
    for picture in (second, np.zeros((96, 128)), np.full((96, 128), np.nan)):
        assert math.isnan(displacement_between(first, picture)[0])


def test_sizes_must_agree():
    with pytest.raises(ValueError, match="must be of one size"):
        displacement_between(np.zeros((20, 20)), np.zeros((20, 21)))
