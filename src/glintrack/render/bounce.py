"""Light that surfaces get from what stands around them, kept without a wavelength.

Spectra of reflectance and transmittance are written as sums of three of them, the library's extremes;
a surface keeps how much of each it gets, by the light that fell there: E = Σ_c ρ_c(λ) [S_c E_sun(λ)
+ D_c E_sky(λ) + M_c E_around(λ)]. S holds what the sun lights (a leaf from behind too), D what the sky
lights, M what the surroundings light in turn, as far as they lie in the sun themselves.
"""

from functools import lru_cache
from typing import NamedTuple

import numba as nb
import numpy as np
import xarray as xr
from jaxtyping import Float, Int
from scipy.optimize import nnls

from glintrack.arrays import Array

LIGHTS, CLASSES = 3, 3
BOUNCES = LIGHTS * CLASSES
BY_SUN, BY_SKY, BY_SURROUNDINGS = range(LIGHTS)
ALL_ROUND = 0.25  # ∫ max(n·d, 0) over all n: what a leaf of any tilt gets of a direction


class MaterialClasses(NamedTuple):
    """How materials are written as sums of a few spectra.

    Parameters
    ----------
    rows
        Which of (reflectance of each material, transmittance of each) are the spectra.
    shares
        What each row has of each of them. [1]
    """

    rows: Int[Array, "class"]
    shares: Float[Array, "row class"]


class Met(NamedTuple):
    """What the rays of some probes meet.

    Parameters
    ----------
    material
        −1 for sky.
    sun
        Cosine of the sun's incidence times the part of its light that arrives; below 0 from behind. [1]
    up
        Upward component of the normal. [1]
    shares
        `MaterialClasses.shares`.
    """

    material: Int[Array, "ray"]
    sun: Float[Array, "ray"]
    up: Float[Array, "ray"]
    shares: Float[Array, "row class"]


def material_classes(materials: xr.Dataset) -> MaterialClasses:
    """The extremes among a library's spectra, and every spectrum as a sum of them with no negative part.

    References
    ----------
    Successive projection: Araújo et al., Chemometrics and Intelligent Laboratory Systems 57, 65 (2001).
    """
    reflectance = np.ascontiguousarray(materials["reflectance"].values, dtype=float)
    through = (
        materials["transmittance"].values if "transmittance" in materials else np.zeros_like(reflectance)
    )
    return _classes(np.concatenate([reflectance, through]).tobytes(), reflectance.shape[1])


@lru_cache(maxsize=8)
def _classes(spectra: bytes, width: int) -> MaterialClasses:
    rows = np.frombuffer(spectra).reshape(-1, width)
    left, chosen = rows.copy(), []
    for _ in range(CLASSES):
        far = int(np.argmax((left**2).sum(axis=1)))
        chosen.append(far)
        length = np.linalg.norm(left[far])
        if length > 0:
            along = left[far] / length
            left = left - (left @ along)[:, None] * along
    basis = rows[chosen].T
    return MaterialClasses(np.array(chosen), np.stack([nnls(basis, row)[0] for row in rows]))


@nb.njit(nogil=True, cache=True, fastmath=True)
def bounce_light(start, stop, direction, solid_angle, facing, view, met, out):
    """Fill ``out`` (probe, light × class) with what each probe's facet gets from where its rays end.

    ``facing`` is zero for leaves, which take the mean over all tilts; ``view`` is the part of the even sky
    that each probe sees, taken for what the surfaces around it see.
    """
    rays, half = direction.shape[0], met.shares.shape[0] // 2
    for p in range(start, stop):
        for k in range(out.shape[1]):
            out[p, k] = 0.0
        if half == 0:
            continue
        nx, ny, nz = facing[p, 0], facing[p, 1], facing[p, 2]
        leaf = nx * nx + ny * ny + nz * nz < 0.5
        lit, all_of = 0.0, 0.0
        for r in range(rays):
            ray = p * rays + r
            m = met.material[ray]
            if m < 0:
                continue
            cosine = nx * direction[r, 0] + ny * direction[r, 1] + nz * direction[r, 2]
            weight = (ALL_ROUND if leaf else max(cosine, 0.0)) * solid_angle[r] / np.pi
            all_of += weight
            lit += weight * abs(met.sun[ray])
        if all_of == 0.0:
            continue
        around = lit / all_of
        for r in range(rays):
            ray = p * rays + r
            m = met.material[ray]
            if m < 0:
                continue
            cosine = nx * direction[r, 0] + ny * direction[r, 1] + nz * direction[r, 2]
            weight = (ALL_ROUND if leaf else max(cosine, 0.0)) * solid_angle[r] / np.pi
            if weight == 0.0:
                continue
            above, below = 0.5 * (1 + met.up[ray]) * view[p], 0.5 * (1 - met.up[ray]) * view[p]
            sun = met.sun[ray]
            for c in range(CLASSES):
                back, through = met.shares[m, c], met.shares[half + m, c]
                by_sun = sun * back if sun > 0 else -sun * through
                rest = back * (1 - above) + through * (1 - below)
                out[p, BY_SUN * CLASSES + c] += weight * by_sun
                out[p, BY_SKY * CLASSES + c] += weight * (back * above + through * below)
                out[p, BY_SURROUNDINGS * CLASSES + c] += weight * rest * around
