"""An overcast sky against the asymptotic theory of thick layers and the CIE standard overcast sky."""

from dataclasses import replace

import numpy as np
import pytest

from glintrack.atmosphere import AtmosphereDesign
from glintrack.atmosphere.aerosol import aerosol_optics
from glintrack.atmosphere.assemble import build_medium
from glintrack.atmosphere.solve import Directions, solve_fields, solve_ground

DEPTH, SUN = 30.0, 0.7  # optical depth at 0.55 µm, cosine of the sun's zenith angle
DESIGN = AtmosphereDesign(
    aerosol="none",
    cloud_optical_depth=DEPTH,
    cloud_base_m=4000.0,
    altitudes_m=(500.0,),
    wavelengths_um=(0.7,),
)
COS_ZENITH = np.array([1.0, 0.8, SUN, 0.6, 0.4, 0.25])  # toward the sun too: it does not shine through


@pytest.fixture(scope="module")
def directions():
    return Directions(
        SUN, np.arccos(COS_ZENITH), np.zeros(1), np.radians([0.0, 90.0, 180.0]), np.array([500.0])
    )


@pytest.fixture(scope="module")
def medium():
    medium = build_medium(DESIGN, SUN)
    medium = replace(medium, gas_absorption=0 * medium.gas_absorption)  # in neither of the references
    assert np.trapezoid(medium.particles["cloud"].extinction[:, 0], medium.height_m) > 0.4 * DEPTH
    return medium


@pytest.fixture(scope="module")
def sky(medium, directions):
    return solve_fields(medium, directions, 0.0, 16).sky[0]


def test_asymmetry_of_droplets():
    """0.86 in the visible for an effective radius of 10 µm (Hu and Stamnes, J. Climate 6, 728 (1993))."""
    moments = aerosol_optics("cloud", np.array([0.55])).moments
    assert moments[0, 0, 1] / 3 == pytest.approx(0.862, abs=0.005)


def test_light_on_the_ground(medium, directions):
    """T = 4/3 · K(μ0) / ((1 − g) τ + 1.43) below a layer that absorbs nothing (King 1987)."""
    expected = 4 / 3 * 3 / 7 * (1 + 2 * SUN) / ((1 - 0.864) * DEPTH + 1.43)
    share = solve_ground(medium, directions, 16).dark_irradiance[0] / SUN
    assert share == pytest.approx(expected, rel=0.04)  # air above and below is not in the formula
    assert DESIGN.cloud_transmittance(SUN) == pytest.approx(expected)
    assert AtmosphereDesign().cloud_transmittance(1.0) <= 1


def test_shape_of_the_sky(sky):
    """The CIE standard overcast sky: (1 + 2 cos θ) / 3 of the zenith's luminance, whatever the azimuth."""
    relative = sky[..., 0] / sky[:1, :, 0]
    standard = (1 + 2 * COS_ZENITH[:, None]) / 3
    np.testing.assert_allclose(relative / standard, 1, rtol=0.03)


def test_overcast_light_is_hardly_polarized(sky):
    dolp = np.hypot(sky[..., 1], sky[..., 2]) / sky[..., 0]
    assert dolp.max() < 0.02
