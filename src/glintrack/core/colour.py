"""Colours of radiance and reflectance for a display: CIE XYZ to sRGB (IEC 61966-2-1)."""

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.spectral import cie_xyz, quadrature_weights

# linear sRGB from CIE XYZ with a D65 white
SRGB_FROM_XYZ = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
_BLUE_UM, _RED_UM = 0.45, 0.65
_D65_XYZ = np.array([0.9505, 1.0, 1.089])


def holds_colours(wavelength_um: Float[Array, "wavelength"]) -> bool:
    """Return True if spectra on these wavelengths include blue, green and red: 0.45 to 0.65 µm."""
    return bool(wavelength_um[0] <= _BLUE_UM and wavelength_um[-1] >= _RED_UM)


def colour_channels(wavelength_um: Float[Array, "wavelength"]) -> Float[Array, "3 wavelength"]:
    """Channel weights that turn a radiance spectrum into CIE XYZ, for `render.shade`."""
    return cie_xyz(wavelength_um) * quadrature_weights(wavelength_um)


def natural_colour(
    xyz: Float[Array, "y x 3"], white_xyz: Float[Array, "3"], exposure: float | None = None
) -> Float[Array, "y x 3"]:
    """Convert XYZ radiance to an sRGB picture, white-balanced to the light on the ground.

    Parameters
    ----------
    xyz
        From `colour_channels`.
    white_xyz
        XYZ of a white panel in the same light; sets the white balance and the scale.
    exposure
        Factor on the reflectance scale; by default the picture's 97th percentile is made nearly white.
    """
    linear = _linear_srgb(xyz, white_xyz)
    linear = np.nan_to_num(linear) * (exposure_of(xyz, white_xyz) if exposure is None else exposure)
    return encode_srgb(np.clip(linear, 0, 1))


def exposure_of(xyz: Float[Array, "y x 3"], white_xyz: Float[Array, "3"]) -> float:
    """Factor that makes a picture's 97th percentile nearly white, for `natural_colour`. [1]"""
    linear = _linear_srgb(xyz, white_xyz)
    bright = np.nanpercentile(linear, 97) if np.isfinite(linear).any() else 1.0
    return 0.8 / max(float(bright), 1e-9)


def encode_srgb(linear: Float[Array, "..."]) -> Float[Array, "..."]:
    """Gamma-encoded sRGB of linear sRGB, 0 to 1. [1]"""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def decode_srgb(srgb: Float[Array, "..."]) -> Float[Array, "..."]:
    """Linear sRGB of gamma-encoded sRGB, 0 to 1. [1]"""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _linear_srgb(xyz: Array, white_xyz: Array) -> Array:
    balanced = xyz / np.asarray(white_xyz) * _D65_XYZ
    return np.clip(balanced @ SRGB_FROM_XYZ.T, 0, None)
