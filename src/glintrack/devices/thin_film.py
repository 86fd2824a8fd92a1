"""Transfer matrix of a stack of plane layers: any angle, both polarizations, complex refractive indices.

Fields follow e^(−iωt), so absorbing layers have Im(n) > 0. Each layer's characteristic matrix is multiplied
by the layer's own e^(iδ): what grows through a thick metal then stays finite, and no layer is too thick.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Complex, Float

from glintrack.core.arrays import Array

Polarization = Literal["s", "p"]


@dataclass(frozen=True)
class StackResponse:
    """Response of a stack to a plane wave; all arrays have the shape of the broadcast arguments.

    Parameters
    ----------
    transmittance, reflectance, absorptance
        Of irradiance; they add up to 1. [1]
    transmission, reflection
        Complex amplitudes of the electric field; for p, of the field itself, not of its tangential part, and
        positive reflection means that the tangential field keeps its sign. [1]
    """

    transmittance: Float[Array, "*shape"]
    reflectance: Float[Array, "*shape"]
    absorptance: Float[Array, "*shape"]
    transmission: Complex[Array, "*shape"]
    reflection: Complex[Array, "*shape"]


def stack_response(
    indices: list[Array | complex],
    thicknesses_um: list[Array | float],
    wavelength_um: Array | float,
    incidence_rad: Array | float = 0.0,
    polarization: Polarization = "s",
) -> StackResponse:
    """Transmittance and reflectance of a plane wave through a stack of layers.

    Parameters
    ----------
    indices
        Refractive index of the medium the light comes from (real), of each layer in the light's order, and of
        the medium behind; complex where they absorb, Im ≥ 0. [1]
    thicknesses_um
        Of each layer, two fewer than ``indices``; not negative. [µm]
    wavelength_um
        In vacuum. [µm]
    incidence_rad
        In the first medium, 0 to under π/2. [rad]
    polarization
        ``"s"``: electric field across the plane of incidence; ``"p"``: in it.

    Returns
    -------
    Every argument may be an array; they are broadcast against each other. Only what depends on a large array
    is computed at its size: sweep a gap with thickness (gap, 1) over wavelengths (wavelength,).

    Raises
    ------
    ValueError
        For a layer too few or too many, a negative thickness, an absorbing first medium, a medium with gain,
        or an angle outside the range.

    References
    ----------
    Born and Wolf, Principles of Optics, §1.6; Byrnes, arXiv:1603.02720, for the power in absorbing media.
    """
    n = [np.asarray(index, dtype=complex) for index in indices]
    d = [np.asarray(thickness, dtype=float) for thickness in thicknesses_um]
    wavelength_um, incidence_rad = np.asarray(wavelength_um, float), np.asarray(incidence_rad, float)
    _check(n, d, wavelength_um, incidence_rad, polarization)

    along = np.real(n[0]) * np.sin(incidence_rad)  # n sin θ, the same in all layers
    across = [np.sqrt(index**2 - along**2) for index in n]  # n cos θ; the root with Im ≥ 0 decays forward
    admittance = across if polarization == "s" else [i**2 / q for i, q in zip(n, across, strict=True)]
    electric, magnetic = np.ones(()), admittance[-1]
    decay = np.zeros(())
    for q, eta, thickness in reversed(list(zip(across[1:-1], admittance[1:-1], d, strict=True))):
        phase = (2j * np.pi / wavelength_um) * q * thickness
        decay = decay + phase
        round_trip = np.exp(2 * phase)
        even, odd = 0.5 * (1 + round_trip), 0.5 * (round_trip - 1)  # cos δ and i sin δ, times e^(iδ)
        electric, magnetic = (
            even * electric - (odd / eta) * magnetic,
            even * magnetic - (odd * eta) * electric,
        )
    first, last = admittance[0], admittance[-1]
    total = first * electric + magnetic
    tangential = 2 * first * np.exp(decay) / total
    reflection = (first * electric - magnetic) / total
    transmittance = np.real(last) / np.real(first) * np.abs(tangential) ** 2
    reflectance = np.abs(reflection) ** 2
    if polarization == "p":  # the field from its tangential part: E = E_t / cos θ
        tangential = tangential * (across[0] / n[0]) / (across[-1] / n[-1])
    return StackResponse(
        *np.broadcast_arrays(
            transmittance, reflectance, 1 - transmittance - reflectance, tangential, reflection
        )
    )


def _check(
    n: list[Array], d: list[Array], wavelength_um: Array, incidence_rad: Array, polarization: str
) -> None:
    if polarization not in ("s", "p"):
        raise ValueError(f"`polarization` must be 's' or 'p'; got {polarization!r}.")
    if len(n) < 2 or len(d) != len(n) - 2:
        raise ValueError(
            f"`thicknesses_um` must have two entries fewer than `indices` (which hold both outer media); "
            f"got {len(d)} for {len(n)}."
        )
    for k, thickness in enumerate(d):
        if not np.all(thickness >= 0):
            raise ValueError(f"`thicknesses_um[{k}]` must be 0 or more; got {np.min(thickness):g}.")
    if not np.all(wavelength_um > 0):
        raise ValueError(f"`wavelength_um` must be positive; got {np.min(wavelength_um):g}.")
    if not np.all((incidence_rad >= 0) & (incidence_rad < np.pi / 2)):
        raise ValueError(f"`incidence_rad` must lie in 0 to under π/2; got {np.max(incidence_rad):g}.")
    if np.any(np.imag(n[0]) != 0) or np.any(np.real(n[0]) <= 0):
        raise ValueError("`indices[0]` must be real and positive; got an absorbing medium before the stack.")
    for k, index in enumerate(n):
        if np.any(np.imag(index) < 0):
            raise ValueError(
                f"`indices[{k}]` must have Im ≥ 0 (fields follow e^(−iωt)); got {np.min(np.imag(index)):g}."
            )
