"""Light behind a wire-grid polarizer: the exact Mueller matrix, and the paper's Eqs. (10)–(12) by name.

Both give the same irradiance, so a detector that does not care for polarization reads the same; what differs
is the polarization of the light behind the polarizer.
"""

import math
from typing import Literal

import numpy as np
from jaxtyping import Float

from glintrack.arrays import Array
from glintrack.stokes import apply, linear_diattenuator, rotate


def transmitted(
    stokes: Float[Array, "... 3"],
    pass_transmittance: float,
    block_transmittance: float,
    angle_rad: float = 0.0,
    model: Literal["mueller", "paper"] = "mueller",
    retardance_rad: float = 0.0,
) -> Float[Array, "... 3"]:
    """Stokes vector behind a linear polarizer, in the reference axis of the light.

    Parameters
    ----------
    stokes
        Light before it, I Q U. [radiance]
    pass_transmittance, block_transmittance
        Irradiance transmittance across and along the wires, 0 to 1. [1]
    angle_rad
        Pass axis from the reference axis. [rad]
    model
        ``"mueller"``: a linear diattenuator. ``"paper"``: the light is split into an unpolarized and a
        completely polarized part; each passes with T(0°)cos²ψ + T(90°)sin²ψ and leaves with S1 = D·S0 and
        S2 = 0 about the pass axis.
    retardance_rad
        Of the pass over the block amplitude; the paper has none. [rad]

    References
    ----------
    Presnar et al., Proc. SPIE 7672, 76720T (2010), Eqs. (10)–(12).
    """
    s = np.asarray(stokes, dtype=float)
    matrix = linear_diattenuator(pass_transmittance, block_transmittance, angle_rad, retardance_rad)[:3, :3]
    exact = apply(matrix, s)
    if model == "mueller":
        return exact
    if model != "paper":
        raise ValueError(f"`model` must be 'mueller' or 'paper', got {model!r}")
    both = pass_transmittance + block_transmittance
    diattenuation = (pass_transmittance - block_transmittance) / both if both > 0 else 0.0
    polarized = np.hypot(s[..., 1], s[..., 2])
    psi = 0.5 * np.arctan2(s[..., 2], s[..., 1]) - angle_rad
    share = pass_transmittance * np.cos(psi) ** 2 + block_transmittance * np.sin(psi) ** 2
    total = (s[..., 0] - polarized) * both / 2 + polarized * share
    about_axis = np.stack([total, diattenuation * total, np.zeros_like(total)], axis=-1)
    return rotate(about_axis, -angle_rad)


def dolp_bias(diattenuation: float, degree: float) -> float:
    """Error of DoLP when polarizers of diattenuation D pass for ideal: (D − 1)·DoLP. [1]

    Unpolarized light calibrates each element, so S0 comes out right and S1, S2 too small by D.
    """
    if not 0 <= diattenuation <= 1:
        raise ValueError(f"`diattenuation` must lie within 0 to 1, got {diattenuation}")
    return (diattenuation - 1) * degree


def extinction_ratio(diattenuation: float) -> float:
    """Extinction ratio of a polarizer from its diattenuation, Eq. (9) the other way round. [1]"""
    return math.inf if diattenuation >= 1 else (1 + diattenuation) / (1 - diattenuation)
