"""The sky cut into patches about the sun: what a scene hides is kept patch by patch, without a wavelength.

A third to two fifths of the skylight on level ground comes from within 30° of the sun, which is just what a
shading object hides. So the patches are small there, a cap of 12° and a ring to 30° in four quarters, and
three bands of height in sectors elsewhere. A probe keeps which part of each it sees; `shade` multiplies that
with the irradiance that each component of the sky sends from it.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array

_CAP, _RING = math.radians(12.0), math.radians(30.0)
QUARTERS = 4
_BANDS = ((0.0, 0.35, 6), (0.35, 0.7, 6), (0.7, 1.0, 3))  # lowest and highest sine of the elevation, sectors
PATCHES = 1 + QUARTERS + sum(sectors for *_, sectors in _BANDS)
_RAYS = (4, *QUARTERS * (2,), *6 * (2,), *6 * (2,), *3 * (3,))  # of a probe to each patch
SETS = 4  # of directions: neighbouring probes have different ones, and share what they find
_DENSE = 8192  # directions that stand for the hemisphere where patches are measured
_BELOW = 16  # directions below the horizon
_DEPTH, _AROUND_SUN, _SPREAD_RAD = 0.25, 6.0, 0.2  # of `clear_sky`
_ROUNDS = 12  # of Lloyd's iteration


class PatchRays(NamedTuple):
    """Directions of a probe's rays: above the horizon patch by patch, then below.

    Parameters
    ----------
    direction
        Unit vectors, ENU. [1]
    patch
        Patch of each; −1 below the horizon.
    solid_angle
        That each stands for. [sr]
    brightness
        A clear sky's, in each direction, beside that of others of the same patch: it is brighter toward the
        horizon and about the sun. [1]
    """

    direction: Float[Array, "set ray 3"]
    patch: Int[Array, "ray"]
    solid_angle: Float[Array, "ray"]
    brightness: Float[Array, "set ray"]


def patch_of(direction: Float[Array, "direction 3"], sun: Float[Array, "3"]) -> Int[Array, "direction"]:
    """Patch of each unit vector above the horizon; those below get that of the horizon above them."""
    direction, sun = np.asarray(direction, float), np.asarray(sun, float)
    up = np.clip(direction[:, 2], 0.0, 1.0 - 1e-12)
    turn = np.mod(np.arctan2(direction[:, 0], direction[:, 1]) / (2 * math.pi), 1.0)
    patch = np.zeros(len(direction), np.int64)
    first = 1 + QUARTERS
    for low, high, sectors in _BANDS:
        inside = (up >= low) & (up < high)
        patch[inside] = first + np.minimum((turn[inside] * sectors).astype(int), sectors - 1)
        first += sectors
    level = np.array([sun[1], -sun[0], 0.0]) if math.hypot(sun[0], sun[1]) > 1e-6 else np.array([1.0, 0, 0])
    level /= np.linalg.norm(level)
    upright = np.cross(level, sun)
    cosine = direction @ sun
    around = np.mod(np.arctan2(direction @ upright, direction @ level) / (2 * math.pi) + 0.125, 1.0)
    ring = cosine > math.cos(_RING)
    patch[ring] = 1 + np.minimum((around[ring] * QUARTERS).astype(int), QUARTERS - 1)
    patch[cosine > math.cos(_CAP)] = 0
    return patch


def even_directions(count: int) -> Float[Array, "direction 3"]:
    """Unit vectors spread evenly over the upper hemisphere. [1]

    References
    ----------
    The Fibonacci spiral: Marques et al., "Spherical Fibonacci Point Sets for Illumination Integrals",
    Computer Graphics Forum 32 (2013).
    """
    k = np.arange(count)
    up = (k + 0.5) / count
    azimuth = 2 * math.pi * np.mod(k * (math.sqrt(5) - 1) / 2, 1)
    across = np.sqrt(1 - up * up)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), up], axis=1)


def patch_rays(sun: Float[Array, "3"]) -> PatchRays:
    """Directions spread evenly over each patch (centres of Lloyd's cells), and evenly below the horizon."""
    dense = even_directions(_DENSE)
    patch = patch_of(dense, sun)
    share = 2 * math.pi / _DENSE
    directions, patches, angles = [], [], []
    for b, wanted in enumerate(_RAYS):
        mine = dense[patch == b]
        if len(mine) < SETS * wanted:  # below the horizon, or hidden behind the cap
            continue
        centres = mine[np.linspace(0, len(mine) - 1, SETS * wanted).round().astype(int)]
        for _ in range(_ROUNDS):
            nearest = np.argmax(mine @ centres.T, axis=1)
            sums = np.array([mine[nearest == c].sum(axis=0) for c in range(len(centres))])
            lengths = np.linalg.norm(sums, axis=1, keepdims=True)
            centres = np.where(lengths > 0, sums / np.maximum(lengths, 1e-9), centres)
        directions += [centres[k * SETS : (k + 1) * SETS] for k in range(wanted)]
        patches += wanted * [b]
        angles += wanted * [share * len(mine) / wanted]
    below = even_directions(SETS * _BELOW) * np.array([1.0, 1.0, -1.0])
    directions += [below[k * SETS : (k + 1) * SETS] for k in range(_BELOW)]
    every = np.stack(directions, axis=1)
    return PatchRays(
        np.ascontiguousarray(every, np.float32),
        np.concatenate([patches, np.full(_BELOW, -1)]),
        np.concatenate([angles, np.full(_BELOW, 2 * math.pi / _BELOW)]).astype(np.float32),
        clear_sky(every, sun).astype(np.float32),
    )


def clear_sky(direction: Float[Array, "... 3"], sun: Float[Array, "3"]) -> Float[Array, "..."]:
    """Usual brightness of a clear sky: (1 − exp(−0.25/cos θ)) (1 + 6 exp(−angle to the sun/0.2))."""
    up = np.maximum(direction[..., 2], 1e-3)
    angle = np.arccos(np.clip(direction @ np.asarray(sun, float), -1, 1))
    return (1 - np.exp(-_DEPTH / up)) * (1 + _AROUND_SUN * np.exp(-angle / _SPREAD_RAD))


def even_irradiance(
    normals: Float[Array, "normal 3"], sun: Float[Array, "3"]
) -> Float[Array, "normal patch"]:
    """Irradiance of open facets from each patch of a sky of radiance 1. [sr]"""
    dense = even_directions(_DENSE // 4)
    patch, share = patch_of(dense, sun), 2 * math.pi / len(dense)
    cosine = np.maximum(normals @ dense.T, 0) * share
    return np.stack([cosine[:, patch == b].sum(axis=1) for b in range(PATCHES)], axis=1)
