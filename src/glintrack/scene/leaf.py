"""Transmittance of a leaf from its reflectance: the generalised plate model, run backwards.

A leaf is N layers of one absorbing plate (Allen et al., J. Opt. Soc. Am. 59, 1376 (1969); 60, 542 (1970);
Jacquemoud and Baret, Remote Sens. Environ. 34, 75 (1990), "PROSPECT"). At each wavelength the plate's inner
transmittance is chosen so that the stack reflects what was measured; the stack's transmittance is the answer.
It is synthetic: reflectance is measured, transmittance is not.
"""

import math
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from glintrack.core.arrays import Array

_CONE_RAD = math.radians(40)  # light meets the first layer within this cone (PROSPECT-5)
_NODES = 64  # of the average over directions
_HALVINGS = 40  # to 1e-12 of the range
_CUTS, _PARTS = 7, 64  # of the range of layers, to as much
_MOST_LAYERS = 30.0


def leaf_transmittance(
    reflectance: Float[Array, "wavelength"], absorptance: float, refractive_index: float
) -> Float[Array, "wavelength"]:
    """Hemispherical transmittance of a leaf by its reflectance. [1]

    Parameters
    ----------
    reflectance
        Of the leaf, 0 to 1. [1]
    absorptance
        What it absorbs at its reflectance's maximum, in the near infrared: about 0.05 for a single leaf. This
        fixes the number of layers. [1]
    refractive_index
        Of the leaf's wax and cell walls, over 1. [1]

    Raises
    ------
    ValueError
        If reflectance and absorptance leave nothing to be let through.
    """
    highest = float(np.max(reflectance))
    if not 0 < absorptance < 1 - highest:
        raise ValueError(
            f"`leaf_absorptance` must lie above 0 and leave light to pass: below {1 - highest:.3g}, "
            f"got {absorptance:g}"
        )
    low, high = 1.0, _MOST_LAYERS
    for _ in range(_CUTS):  # more layers reflect more, so that more must be absorbed
        layers = np.linspace(low, high, _PARTS + 1)
        through = _inverse(np.full(_PARTS - 1, highest), layers[1:-1], refractive_index)
        below = np.count_nonzero(1 - highest - through <= absorptance)
        low, high = layers[below : below + 2].tolist()
    return _inverse(np.asarray(reflectance, float), low, refractive_index)


def plate_stack(
    inner: ArrayLike, layers: ArrayLike, refractive_index: float
) -> tuple[Float[Array, "*any"], Float[Array, "*any"]]:
    """Reflectance and transmittance of a stack of absorbing plates.

    Parameters
    ----------
    inner
        Transmittance of one plate's inside, 0 to 1. [1]
    layers
        How many plates, at least 1, whole or not. [1]
    refractive_index
        Of the plates, over 1. [1]
    """
    first, inside = _entering(refractive_index, _CONE_RAD), _entering(refractive_index, math.pi / 2)
    inner = np.clip(np.asarray(inner, float), 1e-9, 1 - 1e-9)  # the ends are limits of the formulae
    top_r, top_t = _plate(inner, first, inside, refractive_index)
    r, t = _plate(inner, inside, inside, refractive_index)
    # Stokes' solution for layers − 1 equal plates
    root = np.sqrt(np.maximum((t**2 - r**2 - 1) ** 2 - 4 * r**2, 0))
    a, b = (1 + r**2 - t**2 + root) / (2 * r), (1 - r**2 + t**2 + root) / (2 * t)
    power = b ** (np.asarray(layers) - 1)
    whole = a * power - 1 / (a * power)
    below_r, below_t = (power - 1 / power) / whole, (a - 1 / a) / whole
    between = 1 - r * below_r
    return top_r + top_t * t * below_r / between, top_t * below_t / between


def _plate(inner: Array, entering: float, inside: float, n: float) -> tuple[Array, Array]:
    """Reflectance and transmittance of one plate; what enters leaves it diffuse."""
    back = n**2 - inside  # n² times the reflectance from within
    between = n**4 - (inner * back) ** 2
    transmitted = entering * inside * inner * n**2 / between
    return 1 - entering + entering * inside * inner**2 * back / between, transmitted


@lru_cache(maxsize=64)
def _entering(n: float, cone_rad: float) -> float:
    """Fresnel transmittance for unpolarized light averaged over a cone (Stern, Appl. Opt. 3, 111 (1964))."""
    node, weight = np.polynomial.legendre.leggauss(_NODES)
    s2 = (
        0.5 * (node + 1) * math.sin(cone_rad) ** 2
    )  # sin²: even steps of it are even in projected solid angle
    c, ct = np.sqrt(1 - s2), np.sqrt(1 - s2 / n**2)
    rs, rp = (c - n * ct) / (c + n * ct), (n * c - ct) / (n * c + ct)
    return float(np.sum(weight * (1 - 0.5 * (rs**2 + rp**2))) / 2)


def _inverse(reflectance: Array, layers: ArrayLike, n: float) -> Array:
    """Transmittance of a stack that reflects so much; 0 where even a black inside reflects more."""
    low, high = np.zeros(reflectance.shape), np.ones(reflectance.shape)
    for _ in range(_HALVINGS):
        inner = 0.5 * (low + high)
        more = plate_stack(inner, layers, n)[0] > reflectance
        low, high = np.where(more, low, inner), np.where(more, inner, high)
    return np.where(low > 0, plate_stack(low, layers, n)[1], 0.0)
