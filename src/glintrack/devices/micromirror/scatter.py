"""Light that a micromirror scatters: its amount (roughness) and its direction (ABg).

The mirror's roughness is small compared with a wavelength: the share that leaves the specular beam is
1 − exp(−(4πσ cosθ/λ)²), and it spreads over β = sin θ_s − sin θ_i as the surface's power spectrum does, with
a shoulder at λ/(2πl) and a slope beyond it (ABg, i.e. Harvey and Shack's shift-invariant scatter).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from glintrack.core.arrays import Array
from glintrack.devices.micromirror.equilibrium import MicromirrorDesign, SurfaceDesign

_NODES = 400  # of integrals over β, even in its logarithm: 1e-5 of the scattered share


@dataclass(frozen=True)
class Scatter:
    """ABg scatter about the specular beam: BSDF = A/(Bᵍ + |β − β₀|ᵍ).

    Parameters
    ----------
    wavelength_um
        Rising or not. [µm]
    total
        Share of the reflected light that is scattered. [1]
    scale
        A, so that the BSDF integrates to ``total``. [sr⁻¹ × B's power]
    shoulder
        B, the β of the shoulder. [1]
    slope
        g. [1]
    """

    wavelength_um: Float[Array, "wavelength"]
    total: Float[Array, "wavelength"]
    scale: Float[Array, "wavelength"]
    shoulder: Float[Array, "wavelength"]
    slope: float


def scatter(surface: SurfaceDesign, wavelength_um: ArrayLike, incidence_rad: float = 0.0) -> Scatter:
    """ABg parameters of a surface at each wavelength.

    Parameters
    ----------
    surface
        Roughness, correlation length and slope.
    incidence_rad
        Of the chief ray; only the amount depends on it. [rad]

    References
    ----------
    Bennett and Porteus, J. Opt. Soc. Am. 51, 123 (1961), for the total: 1 − exp(−(4πσ cosθ/λ)²).
    Harvey, Choi, Krywonos and Marcen, Proc. SPIE 7426, 74260I (2009); Dittman, Proc. SPIE 6291 (2006).
    """
    wavelength = np.atleast_1d(np.asarray(wavelength_um, float))
    phase = 4 * np.pi * surface.roughness_nm * np.cos(incidence_rad) / (wavelength * 1e3)
    total = -np.expm1(-(phase**2))
    shoulder = wavelength / (2 * np.pi * surface.correlation_length_um)
    unit = np.array([_inside(1.0, b, surface.rolloff) for b in shoulder])
    return Scatter(wavelength, total, total / unit, shoulder, surface.rolloff)


def wing_fraction(model: Scatter, beta: ArrayLike) -> Float[Array, "wavelength"]:
    """Share of the reflected light that is scattered further than ``beta`` from the specular beam. [1]

    Parameters
    ----------
    beta
        One number or one a wavelength: for the stop of a relay at F/N, 1/(2N); for a circle of radius r in an
        image at a distance f behind the mirror, r/f.
    """
    limit = np.broadcast_to(np.asarray(beta, float), model.wavelength_um.shape)
    if np.any((limit < 0) | (limit > 1)):
        raise ValueError(f"`beta` must lie in 0 to 1, a sine; got {limit.min():g} to {limit.max():g}.")
    inside = [
        a * _inside(float(b), s, model.slope)
        for a, b, s in zip(model.scale, limit, model.shoulder, strict=True)
    ]
    return np.clip(model.total - np.array(inside), 0, None)


def relay_throughput(
    design: MicromirrorDesign, wavelength_um: ArrayLike, f_number: float
) -> Float[Array, "wavelength"]:
    """Share of the light on the mirror that it sends through a relay's stop. [1]

    Reflectance times what is not scattered beyond the stop's half angle; the specular beam is taken to fill
    the middle of the stop.
    """
    model = scatter(design.surface, wavelength_um)
    return design.surface.reflectance * (1 - wing_fraction(model, 0.5 / f_number))


def _inside(limit: float, shoulder: float, slope: float) -> float:
    """∫ 2πβ dβ/(Bᵍ + βᵍ) from 0 to a limit; dΩ cosθ = dβ² of directions about the normal. [1]"""
    if limit <= 0:
        return 0.0
    if slope == 2:
        return float(np.pi * np.log1p((limit / shoulder) ** 2))
    least = min(shoulder, limit) * 1e-4
    node = np.geomspace(least, limit, _NODES)
    value = 2 * np.pi * node**2 / (shoulder**slope + node**slope)
    core = np.pi * least**2 / shoulder**slope
    return float(core + np.trapezoid(value, np.log(node)))
