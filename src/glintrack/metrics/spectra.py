"""Errors of measured spectra and bands against the truth."""

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.image_shift import displacement_between
from glintrack.metrics.pictures import rmse


def spectral_angle(
    measured: Float[Array, "*spectrum wavelength"], truth: Float[Array, "*spectrum wavelength"]
) -> Float[Array, "*spectrum"]:
    """Angle between spectra as vectors, blind to brightness (SAM). [rad]

    NaN where a spectrum has a gap or is nought.

    References
    ----------
    Kruse et al., Remote Sensing of Environment 44, 145 (1993).
    """
    a, b = np.asarray(measured, float), np.asarray(truth, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        a = a / np.linalg.norm(a, axis=-1, keepdims=True)
        b = b / np.linalg.norm(b, axis=-1, keepdims=True)
    # half the chord: no loss of digits at small angles, as the arc cosine has
    return 2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))


def spectral_rmse(
    measured: Float[Array, "*spectrum wavelength"], truth: Float[Array, "*spectrum wavelength"]
) -> float:
    """RMS difference over all spectra and wavelengths that both have. [unit of the spectra]"""
    return rmse(measured, truth)


def band_misregistration(
    bands: Float[Array, "y x band"], reference: int = 0, most_px: float = 8.0
) -> Float[Array, "band"]:
    """Displacement of each band of one picture against one of them; NaN where none stands out. [pixel]

    Parameters
    ----------
    bands
        Rectified bands of the same ground.
    reference
        Which band the others are held against.
    most_px
        Larger displacements are not looked for. [pixel]
    """
    if not 0 <= reference < bands.shape[-1]:
        raise ValueError(f"`reference` must be one of {bands.shape[-1]} bands, got {reference}")
    shifts = [
        displacement_between(bands[..., k], bands[..., reference], most_px)[:2]
        for k in range(bands.shape[-1])
    ]
    return np.hypot(*np.array(shifts).T)
