"""Stokes and Mueller algebra, and the one place where Stokes vectors change their reference axis.

A Stokes vector is ``[I, Q, U]`` or ``[I, Q, U, V]`` on the last axis, and means nothing without its
reference axis e1: with k the direction the light travels and e2 = k × e1, ``Q = |E1|² − |E2|²`` and
``U = 2 Re(E1 E2*)``, angles counter-clockwise from e1 as seen looking *at* the source; with fields as
e^(−iωt), ``V = 2 Im(E1 E2*)``, positive where the field turns clockwise as seen looking at the source (right
circular, Born & Wolf). The three axes in use (``detector``, ``meridian``, ``incidence``) are defined in
``docs/conventions.md``.

Implements Eqs. (1)–(3) of Presnar et al., Proc. SPIE 7672, 76720T (2010), and Fesenkov's method (§2.1).
"""

import math

import numba as nb
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from glintrack.core.arrays import Array

FRAMES = ("detector", "meridian", "incidence")
COMPONENTS = ("I", "Q", "U", "V")


def dolp(stokes: ArrayLike, floor: float = 0.0) -> Float[Array, "..."]:
    """Degree of linear polarization, Eq. (2).

    Parameters
    ----------
    stokes
        Stokes vectors on the last axis, three or four components. [radiance]
    floor
        Pixels whose total radiance S0 is at or below this are masked (NaN): a dark pixel has no DoLP.

    Returns
    -------
    √(S1² + S2²)/S0; 0 to 1 for a physical vector, NaN where masked. [1]
    """
    s = _stokes_array(stokes)
    bright = s[..., 0] > floor
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(bright, np.hypot(s[..., 1], s[..., 2]) / s[..., 0], np.nan)


def aop(stokes: ArrayLike) -> Float[Array, "..."]:
    """Angle of polarization ½ arctan2(S2, S1), Eq. (3), in [0, π). [rad]"""
    s = _stokes_array(stokes)
    angle = np.mod(0.5 * np.arctan2(s[..., 2], s[..., 1]), np.pi)
    return np.where(angle >= np.pi, 0.0, angle)  # mod of a tiny negative rounds up to π itself


def rotate(stokes: ArrayLike, angle_rad: ArrayLike) -> Float[Array, "... s"]:
    """Stokes vector of the same light in a reference axis turned by ``angle_rad``.

    Parameters
    ----------
    stokes
        Stokes vectors on the last axis, three or four components.
    angle_rad
        From the old axis to the new one, counter-clockwise looking at the source; broadcasts
        against ``stokes[..., 0]``. [rad]

    Returns
    -------
    Rotated vectors; I and V unchanged. Light polarized along the new axis comes out with Q = +I.
    """
    s = _stokes_array(stokes)
    angle = np.asarray(angle_rad, dtype=float)
    q, u = rotate_qu.py_func(s[..., 1], s[..., 2], np.cos(2 * angle), np.sin(2 * angle))
    total = np.broadcast_to(s[..., 0], np.shape(q))
    rest = [np.broadcast_to(s[..., 3], np.shape(q))] if s.shape[-1] == 4 else []
    return np.stack([total, q, u, *rest], axis=-1)


@nb.njit(cache=True)
def rotate_qu(q, u, cos2, sin2):
    """(Q, U) in an axis turned by α from the present one, given cos 2α and sin 2α: `rotate` for kernels."""
    return cos2 * q + sin2 * u, cos2 * u - sin2 * q


@nb.njit(cache=True)
def axis_turn(ax, ay, az, bx, by, bz, kx, ky, kz):
    """(cos 2α, sin 2α) of the turn from axis a to axis b about the travel direction k (unit).

    Neither axis need be a unit vector or transverse to k; only their transverse parts count. An axis along k
    has no direction: the turn is then zero.
    """
    a_dot_b = ax * bx + ay * by + az * bz
    a_dot_k = ax * kx + ay * ky + az * kz
    b_dot_k = bx * kx + by * ky + bz * kz
    c = a_dot_b - a_dot_k * b_dot_k
    s = kx * (ay * bz - az * by) + ky * (az * bx - ax * bz) + kz * (ax * by - ay * bx)
    norm2 = c * c + s * s
    if norm2 < 1e-24:
        return 1.0, 0.0
    return (c * c - s * s) / norm2, 2.0 * c * s / norm2


def frame_angle(
    axis_from: Float[Array, "... 3"], axis_to: Float[Array, "... 3"], travel: Float[Array, "... 3"]
) -> Float[Array, "..."]:
    """Angle from one reference axis to another about the direction of travel, for `rotate`. [rad]

    Parameters
    ----------
    axis_from, axis_to
        Reference axes; only their parts transverse to ``travel`` count. [m or 1]
    travel
        Unit direction the light travels. [1]

    Returns
    -------
    Counter-clockwise looking at the source, modulo π; 0 where an axis lies along the ray. [rad]
    """
    a, b, k = (np.asarray(v, dtype=float) for v in (axis_from, axis_to, travel))
    cosine = np.sum(a * b, -1) - np.sum(a * k, -1) * np.sum(b * k, -1)
    sine = np.sum(k * np.cross(a, b), -1)
    return np.arctan2(sine, cosine)


def fesenkov(i0: ArrayLike, i60: ArrayLike, i120: ArrayLike) -> Float[Array, "... 3"]:
    """Stokes vector from irradiances behind *ideal* polarizers at 0°, 60° and 120° (Fesenkov).

    Parameters
    ----------
    i0, i60, i120
        What passes a perfect linear polarizer at each angle from the reference axis; at most half of
        unpolarized light does. [radiance or irradiance]

    Returns
    -------
    ``[S0, S1, S2]`` on a new last axis, in the unit of the arguments.

    References
    ----------
    Presnar et al., Proc. SPIE 7672, 76720T (2010), §2.1.
    """
    i0, i60, i120 = np.broadcast_arrays(*(np.asarray(i, dtype=float) for i in (i0, i60, i120)))
    return np.stack(
        [
            (2 / 3) * (i0 + i60 + i120),
            (2 / 3) * (2 * i0 - i60 - i120),
            (2 / math.sqrt(3)) * (i60 - i120),
        ],
        axis=-1,
    )


def rotation_mueller(angle_rad: float) -> Float[Array, "4 4"]:
    """Mueller matrix R(α) that turns the reference axis by ``angle_rad``; ``R @ s == rotate(s, α)``. [1]"""
    c, s = math.cos(2 * angle_rad), math.sin(2 * angle_rad)
    return np.array([[1, 0, 0, 0], [0, c, s, 0], [0, -s, c, 0], [0, 0, 0, 1.0]])


def linear_diattenuator(
    pass_transmittance: float,
    block_transmittance: float,
    angle_rad: float = 0.0,
    retardance_rad: float = 0.0,
) -> Float[Array, "4 4"]:
    """Mueller matrix of a linear diattenuator (a real polarizer).

    Parameters
    ----------
    pass_transmittance, block_transmittance
        *Irradiance* transmittance of light polarized along and across the pass axis, 0 to 1. [1]
    angle_rad
        Pass axis from the reference axis, counter-clockwise looking at the source. [rad]
    retardance_rad
        Phase of the pass amplitude minus that of the block amplitude, fields as e^(−iωt). [rad]

    Returns
    -------
    The matrix in the same reference axis as the light; it acts on the left. [1]

    Raises
    ------
    ValueError
        If a transmittance lies outside 0 to 1.

    Notes
    -----
    Goldstein's fields are e^(+iωt), so his retarder has the opposite signs of sin(retardance).

    References
    ----------
    Goldstein, *Polarized Light*, 3rd ed. (2011), §5.3; Presnar et al. (2010), Eqs. (8)–(9).
    """
    for name, value in (
        ("pass_transmittance", pass_transmittance),
        ("block_transmittance", block_transmittance),
    ):
        if not 0 <= value <= 1:
            raise ValueError(f"`{name}` must be an irradiance transmittance in [0, 1]; got {value}.")
    both = 0.5 * (pass_transmittance + block_transmittance)
    difference = 0.5 * (pass_transmittance - block_transmittance)
    geometric = math.sqrt(pass_transmittance * block_transmittance)
    c, s = geometric * math.cos(retardance_rad), geometric * math.sin(retardance_rad)
    along_axis = np.array(
        [[both, difference, 0, 0], [difference, both, 0, 0], [0, 0, c, -s], [0, 0, s, c]], dtype=float
    )
    return rotation_mueller(-angle_rad) @ along_axis @ rotation_mueller(angle_rad)


def apply(mueller: Float[Array, "... n n"], stokes: ArrayLike) -> Float[Array, "... n"]:
    """Mueller matrix times Stokes vector; leading axes broadcast."""
    return np.einsum("...ij,...j->...i", mueller, np.asarray(stokes, dtype=float))


def _stokes_array(stokes: ArrayLike) -> Array:
    s = np.asarray(stokes, dtype=float)
    if s.ndim == 0 or s.shape[-1] not in (3, 4):
        raise ValueError(f"`stokes` must have 3 or 4 components on its last axis; got shape {s.shape}.")
    return s
