"""The published Coulson/Natraj rows: sunlight leaving the top of a Rayleigh slab."""

import numpy as np
import pytest

from glintrack.atmosphere import rayleigh_slab

# Natraj, Li and Yung, Astrophys. J. 691, 1909 (2009): solar flux π, τ = 0.5, μ0 = 0.2, no depolarization.
# Columns albedo, μ, φ [°], I, Q, U in the *table's* signs: its Q is the opposite of ours, its U the same.
ROWS = [
    (0.0, 0.40, 60.0, 0.12752450, -0.06066038, 0.05293867),
    (0.0, 0.92, 60.0, 0.05643322, -0.01979730, 0.03822653),
    (0.8, 0.40, 60.0, 0.18923236, -0.06041229, 0.05293867),
]
FORTY_STREAMS = 1e-5  # radiance of a unit flux π


@pytest.mark.parametrize(("albedo", "mu", "azimuth_deg", "i", "q", "u"), ROWS)
def test_published_rows(albedo, mu, azimuth_deg, i, q, u):
    ours = rayleigh_slab(0.5, 0.2, albedo, mu, azimuth_deg)
    np.testing.assert_allclose(ours, [i, -q, u], atol=FORTY_STREAMS)


def test_rows_broadcast():
    both = rayleigh_slab(0.5, 0.2, 0.0, [0.4, 0.92], 60.0)
    one = rayleigh_slab(0.5, 0.2, 0.0, 0.4, 60.0)
    assert both.shape == (2, 3)
    np.testing.assert_allclose(both[0], one, rtol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((0.5, 0.0, 0.0, 0.4, 60.0), "`mu0` must be above 0 and at most 1; got 0"),
        ((-1.0, 0.2, 0.0, 0.4, 60.0), "`optical_depth` must be above 0"),
        ((0.5, 0.2, 1.5, 0.4, 60.0), "`albedo` must lie within 0 to 1; got 1.5"),
        ((0.5, 0.2, 0.0, 1.4, 60.0), "`mu` must be above 0 and at most 1; got 1.4"),
    ],
)
def test_bad_input(arguments, sentence):
    with pytest.raises(ValueError, match=sentence):
        rayleigh_slab(*arguments)
