"""Vertical structure and slant paths: levels, unit columns, optical depth through spherical shells.

Everything between levels is linear in height, as in the solver.
"""

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array

EARTH_RADIUS_M = 6_371_000.0
LEVELS_M: tuple[float, ...] = (
    *range(0, 3001, 250),
    3500,
    *range(4000, 10001, 1000),
    *range(12000, 30001, 3000),
    40000,
    50000,
    70000,
    100000,
)
"""Heights at which the atmosphere is given; fine where the aerosol and the aircraft are. [m]"""


def column_weights(profile: Float[Array, "level"], height_m: Float[Array, "level"]) -> Float[Array, "level"]:
    """A profile scaled to unit column (trapezoid, as the solver integrates it). [m⁻¹]"""
    return profile / np.trapezoid(profile, height_m)


def exponential_profile(
    height_m: Float[Array, "level"], scale_height_m: float, top_m: float = np.inf
) -> Float[Array, "level"]:
    """exp(−z/H) below a top, zero above. [1]"""
    return np.where(height_m <= top_m, np.exp(-height_m / scale_height_m), 0.0)


def slant_weights(
    cos_zenith: float, height_m: Float[Array, "level"], up_to_m: float = np.inf
) -> Float[Array, "level"]:
    """Weights whose product with an extinction profile is the optical depth along a slant path. [m]

    Parameters
    ----------
    cos_zenith
        Cosine of the path's zenith angle at the ground.
    height_m
        Levels, from 0 upward; extinction is linear between them. [m]
    up_to_m
        Where the path ends; at the top by default. [m]

    Returns
    -------
    Weight of each level, straight rays through spherical shells.
    """
    edges = np.unique(np.r_[height_m[height_m < up_to_m], min(up_to_m, height_m[-1])])
    nodes, node_weights = np.polynomial.legendre.leggauss(8)
    half = np.diff(edges) / 2
    at = (edges[:-1] + half)[:, None] + half[:, None] * nodes
    radius = 1 + at / EARTH_RADIUS_M
    per_height = radius / np.sqrt(radius**2 - (1 - cos_zenith**2))  # ds/dz of a straight ray, Chapman
    quadrature = (half[:, None] * node_weights * per_height).ravel()
    at = at.ravel()
    upper = np.clip(np.searchsorted(height_m, at, side="right"), 1, height_m.size - 1)
    fraction = (at - height_m[upper - 1]) / (height_m[upper] - height_m[upper - 1])
    weights = np.zeros(height_m.size)
    np.add.at(weights, upper - 1, quadrature * (1 - fraction))
    np.add.at(weights, upper, quadrature * fraction)
    return weights
