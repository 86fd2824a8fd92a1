"""Spectral eigenvectors times angular maps: what makes 211 bands cost what one costs."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array

LARGEST_INTENSITY_ERROR = 1e-3
"""Of I, relative, in any direction at any wavelength. [1]"""
LARGEST_DOLP_ERROR = 1e-3
"""Of the degree of linear polarization, in any direction at any wavelength. [1]"""
MOST_COMPONENTS = 16


@dataclass(frozen=True)
class Factors:
    """field[λ] = Σ_k spectrum[k, λ]·map[k], and how far off that is.

    Parameters
    ----------
    spectrum
        Shape (component, wavelength), in the field's unit.
    maps
        Shape (component, *directions, stokes), largest magnitude 1. [1]
    intensity_error
        Largest relative error of I. [1]
    dolp_error
        Largest error of the degree of linear polarization. [1]
    """

    spectrum: Float[Array, "component wavelength"]
    maps: Float[Array, "component *direction 3"]
    intensity_error: float
    dolp_error: float


def factorize(field: Float[Array, "wavelength *direction 3"]) -> Factors:
    """The fewest components that keep I and DoLP within their limits.

    Each wavelength is divided by its mean I, and each direction by its own, so that the singular vectors
    spend themselves on changes of shape and a dark horizon counts like the bright aureole.

    Parameters
    ----------
    field
        Stokes radiance, I > 0. [radiance]
    """
    bands, directions = field.shape[0], field.shape[1:-1]
    flat = field.reshape(bands, -1, 3)
    level = flat[..., 0].mean(axis=1)
    shape = flat / level[:, None, None]
    weight = 1 / shape[..., 0].mean(axis=0)
    u, s, vt = np.linalg.svd((shape * weight[:, None]).reshape(bands, -1), full_matrices=False)
    for count in range(1, min(bands, MOST_COMPONENTS) + 1):
        maps = vt[:count].reshape(count, -1, 3) / weight[:, None]
        spectrum = (u[:, :count] * s[:count]).T * level
        size = abs(maps).max(axis=(1, 2)) * np.where(maps[..., 0].sum(axis=1) < 0, -1.0, 1.0)
        maps, spectrum = (maps / size[:, None, None]).astype(np.float32), spectrum * size[:, None]
        intensity_error, dolp_error = _errors(flat, np.einsum("kw,kns->wns", spectrum, maps))
        if intensity_error <= LARGEST_INTENSITY_ERROR and dolp_error <= LARGEST_DOLP_ERROR:
            break
    return Factors(spectrum, maps.reshape(count, *directions, 3), intensity_error, dolp_error)


def _errors(true: Array, approximate: Array) -> tuple[float, float]:
    """Largest relative error of I and largest error of DoLP."""
    intensity = abs(approximate[..., 0] / true[..., 0] - 1).max()
    dolp = [np.hypot(x[..., 1], x[..., 2]) / x[..., 0] for x in (true, approximate)]
    return float(intensity), float(abs(dolp[1] - dolp[0]).max())
