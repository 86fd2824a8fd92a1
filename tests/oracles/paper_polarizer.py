"""Light behind a polarizer by the paper's Eqs. (10)–(12), which the Mueller matrix is compared with."""

import numpy as np

from glintrack.stokes import rotate


def behind(stokes, pass_transmittance, block_transmittance, angle_rad=0.0):
    """Stokes vector behind a polarizer, as Presnar et al. (2010), Eqs. (10)–(12), have it.

    The light is split into an unpolarized and a completely polarized part; each passes with
    T(0°)cos²ψ + T(90°)sin²ψ and leaves with S1 = D·S0 and S2 = 0 about the pass axis.
    """
    s = np.asarray(stokes, dtype=float)
    both = pass_transmittance + block_transmittance
    diattenuation = (pass_transmittance - block_transmittance) / both
    polarized = np.hypot(s[..., 1], s[..., 2])
    psi = 0.5 * np.arctan2(s[..., 2], s[..., 1]) - angle_rad
    share = pass_transmittance * np.cos(psi) ** 2 + block_transmittance * np.sin(psi) ** 2
    total = (s[..., 0] - polarized) * both / 2 + polarized * share
    about_axis = np.stack([total, diattenuation * total, np.zeros_like(total)], axis=-1)
    return rotate(about_axis, -angle_rad)
