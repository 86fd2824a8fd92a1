"""Errors of DoLP and AoP against the truth."""

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.metrics.pictures import rmse
from glintrack.stokes import aop, dolp


def dolp_error(
    stokes: Float[Array, "*pixel s"], truth: Float[Array, "*pixel s"], floor: float = 0.0
) -> float:
    """RMS error of the degree of linear polarization. [1]

    Parameters
    ----------
    stokes, truth
        Stokes vectors in one reference axis. [radiance]
    floor
        Pixels whose S0 is at or below this in either are left out. [radiance]
    """
    return rmse(dolp(stokes, floor), dolp(truth, floor))


def aop_error(
    stokes: Float[Array, "*pixel s"],
    truth: Float[Array, "*pixel s"],
    least_dolp: float = 0.05,
    floor: float = 0.0,
) -> float:
    """RMS error of the angle of polarization, the short way round. [rad]

    Parameters
    ----------
    stokes, truth
        Stokes vectors in one reference axis. [radiance]
    least_dolp
        Pixels whose true DoLP is less are left out: their angle means nothing. [1]
    floor
        Pixels whose S0 is at or below this in either are left out. [radiance]
    """
    meant = (dolp(truth, floor) >= least_dolp) & np.isfinite(dolp(stokes, floor))
    turned = np.remainder(aop(stokes) - aop(truth) + np.pi / 2, np.pi) - np.pi / 2
    return rmse(np.where(meant, turned, np.nan), np.zeros(meant.shape))
