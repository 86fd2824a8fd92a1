"""Light that surfaces get from what stands around them, kept without a wavelength.

Spectra of reflectance and transmittance are written as sums of six (`material_classes`); a surface keeps how
much of each it gets, by the light that fell there:

    E(λ) = Σ_c b_c(λ) [S_c E_sun + D_c E_sky + R_c r/(1 − ½r) (s E_sun + d E_sky)] + F ½ ω²/(1 − p ω) E_sun

S holds what the sun lights (a leaf from behind too) and D what the sky lights. R is what lies beside that and
gets light that went twice: as much as s and d, the mean sunlight and skylight on what the point sees, of
surfaces of the frame's mean reflectance r. F is light that went between leaves more than once: ω is what
a leaf scatters to either side, p the part of that which meets leaves again, which a crown of leaf area index
L has as 0.88 (1 − exp(−0.7 L^0.75)) (Smolander and Stenberg, Remote Sensing of Environment 94, 2005).
"""

from functools import lru_cache
from typing import NamedTuple

import numba as nb
import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int
from scipy.constants import Boltzmann, Planck, speed_of_light

from glintrack.arrays import Array

LIGHTS, CLASSES = 4, 6
BOUNCES = LIGHTS * CLASSES + 1
BY_SUN, BY_SKY, TWICE_BY_SUN, TWICE_BY_SKY = range(LIGHTS)
AMONG_LEAVES = BOUNCES - 1
MET_AGAIN = 0.7  # p, that of a leaf area index of 3: crowns stand alone, and let light out at their sides
_ON_LEAVES = 0.16  # mean sunlight on the leaves of a crown of leaf area index 6: (1 − exp(−3))/6
COVERED_M = 1.8  # a level probe with something overhead nearer than this stands under a car or a bench
_TOP_PATCHES = 3  # the last so many of the sky are those about the zenith
_SUN_K = 5772.0  # effective temperature: spectra count as the sun shines
_RARE = 0.1  # weight of coated surfaces (vehicles, glass): little of the ground is covered by them
_DARK = 0.7  # spectra count by this power of their size less: relative errors matter


class MaterialClasses(NamedTuple):
    """How materials are written as sums of a few spectra.

    Parameters
    ----------
    wavelength_um
        Of the spectra. [µm]
    spectra
        Those that all are sums of. [1]
    shares
        What each row of (reflectance of each material, transmittance of each) has of each of them. [1]
    leaf
        Mean of reflectance and transmittance together of what lets light through. [1]
    """

    wavelength_um: Float[Array, "wavelength"]
    spectra: Float[Array, "class wavelength"]
    shares: Float[Array, "row class"]
    leaf: Float[Array, "wavelength"]


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
    range_m
        How far it is. [m]
    """

    material: Int[Array, "ray"]
    sun: Float[Array, "ray"]
    up: Float[Array, "ray"]
    range_m: Float[Array, "ray"]


class Sent(NamedTuple):
    """Rays of some probes: those of probe p are ``first[p]`` to ``first[p + 1]`` of `Met`.

    Parameters
    ----------
    first
        First ray of each probe, and one more.
    direction, patch, solid_angle, brightness
        Of each ray, as in `sky_patches.PatchRays`. [1, 1, sr, 1]
    facing
        Normals for which each probe gathers: one of a facet, six about a point in a crown. [1]
    level
        Whether a probe stands on level ground.
    """

    first: Int[Array, "probe+1"]
    direction: Float[Array, "ray 3"]
    patch: Int[Array, "ray"]
    solid_angle: Float[Array, "ray"]
    brightness: Float[Array, "ray"]
    facing: Float[Array, "probe facing 3"]
    level: Bool[Array, "probe"]


class Gathered(NamedTuple):
    """What each probe gathers.

    Parameters
    ----------
    patches
        Part of each patch of the sky that is open, 0 to 255.
    bounced
        Irradiance over that of its light, by light and class of material. [1]
    sky_view
        Sky view factor of each facing. [1]
    alive
        Whether it stands where light comes: not in a building nor under a car.
    """

    patches: Int[Array, "probe patch"]
    bounced: Float[Array, "probe facing bounce"]
    sky_view: Float[Array, "probe facing"]
    alive: Bool[Array, "probe"]


def material_classes(materials: xr.Dataset) -> MaterialClasses:
    """The principal components of a library's spectra, weighed with sunlight."""
    rows = np.ascontiguousarray(materials["reflectance"].values, dtype=float)
    through = materials["transmittance"].values if "transmittance" in materials else np.zeros_like(rows)
    coated = np.asarray(materials["specular_weight"].values, float) > 0.5
    wavelength_um = materials["wavelength"].values.astype(float)
    both = np.concatenate([rows, through])
    return _classes(both.tobytes(), wavelength_um.tobytes(), np.tile(coated, 2).tobytes())


@lru_cache(maxsize=8)
def _classes(spectra: bytes, grid: bytes, coated: bytes) -> MaterialClasses:
    wavelength_um = np.frombuffer(grid)
    rows = np.frombuffer(spectra).reshape(-1, len(wavelength_um))
    photon = Planck * speed_of_light / (1e-6 * wavelength_um * Boltzmann * _SUN_K)
    sunlight = np.sqrt(wavelength_um**-5 / np.expm1(photon))
    sunlight /= sunlight.max()
    weighed = rows * sunlight
    weight = np.maximum(np.linalg.norm(weighed, axis=1), 1e-3) ** -_DARK
    weight *= np.where(np.frombuffer(coated, np.bool_), _RARE, 1.0)
    _, _, components = np.linalg.svd(weighed * weight[:, None], full_matrices=False)
    kept = np.zeros((CLASSES, len(wavelength_um)))
    kept[: len(components)] = components[:CLASSES]
    shares = weighed @ kept.T
    size = np.maximum(np.abs(shares).max(axis=0), 1e-9)
    half = len(rows) // 2
    leaves = rows[half:].max(axis=1) > 0
    leaf = (rows[:half] + rows[half:])[leaves].mean(axis=0) if leaves.any() else np.zeros(len(wavelength_um))
    return MaterialClasses(wavelength_um, kept * size[:, None] / sunlight, shares / size, leaf)


@nb.njit(nogil=True, cache=True, fastmath=True)
def gather_light(start, stop, sent, met, shares, out):
    """Fill ``out`` (`Gathered`) for probes ``start`` to ``stop``; without ``shares`` the sky alone."""
    patches = out.patches.shape[1]
    seen, whole = np.empty(patches), np.empty(patches)
    for p in range(start, stop):
        low, high = sent.first[p], sent.first[p + 1]
        one = sent.facing.shape[1] == 1
        fx, fy, fz = sent.facing[p, 0, 0], sent.facing[p, 0, 1], sent.facing[p, 0, 2]
        seen[:], whole[:] = 0.0, 0.0
        above_all = 0
        for r in range(low, high):
            b = sent.patch[r]
            if b < 0:
                continue
            d = sent.direction[r]
            weight = sent.brightness[r] * (max(fx * d[0] + fy * d[1] + fz * d[2], 0.05) if one else 1.0)
            whole[b] += weight
            if met.material[r] < 0:
                seen[b] += weight
            elif b >= patches - _TOP_PATCHES and met.range_m[r] < COVERED_M:
                above_all += 1
            if b >= patches - _TOP_PATCHES:
                above_all -= 1
        some = False
        for b in range(patches):
            part = seen[b] / whole[b] if whole[b] > 0 else 0.0
            out.patches[p, b] = np.uint8(255.0 * part + 0.5)
            some |= part > 0
        out.alive[p] = (some and not (sent.level[p] and above_all == 0)) or not one
        for f in range(sent.facing.shape[1]):
            _gather_facing(p, f, low, high, sent, met, shares, out)


@nb.njit(cache=True, fastmath=True, forceinline=True)
def _gather_facing(p, f, low, high, sent, met, shares, out):
    """What one facing gets: its sky view factor, and light from where rays end."""
    nx, ny, nz = sent.facing[p, f, 0], sent.facing[p, f, 1], sent.facing[p, f, 2]
    sky, open_sky, every, lit, blocked = 0.0, 0.0, 0.0, 0.0, 0.0
    for r in range(low, high):
        d = sent.direction[r]
        weight = max(nx * d[0] + ny * d[1] + nz * d[2], 0.0) * sent.solid_angle[r]
        every += weight
        if sent.patch[r] >= 0:
            sky += weight
            open_sky += weight if met.material[r] < 0 else 0.0
        if met.material[r] >= 0:
            blocked += weight
            lit += weight * abs(met.sun[r])
    view = open_sky / sky if sky > 0 else 0.0
    out.sky_view[p, f] = view
    for k in range(out.bounced.shape[2]):
        out.bounced[p, f, k] = 0.0
    if out.bounced.shape[2] == 0 or blocked == 0.0:
        return
    half, among, skylit, twice = shares.shape[0] // 2, 0.0, 0.0, np.zeros(CLASSES)
    for r in range(low, high):
        m = met.material[r]
        if m < 0:
            continue
        d = sent.direction[r]
        weight = max(nx * d[0] + ny * d[1] + nz * d[2], 0.0) * sent.solid_angle[r] / every
        if weight == 0.0:
            continue
        above, below = 0.5 * (1 + met.up[r]) * view, 0.5 * (1 - met.up[r]) * view
        sun, leaf = met.sun[r], False
        for c in range(CLASSES):
            back, through = shares[m, c], shares[half + m, c]
            leaf |= through != 0
            by_sun = sun * back if sun > 0 else -sun * through
            out.bounced[p, f, BY_SUN * CLASSES + c] += weight * by_sun
            out.bounced[p, f, BY_SKY * CLASSES + c] += weight * (back * above + through * below)
        skylit += weight * above
        among += weight * (1 - 0.5 * view) if leaf else 0.0
        for c in range(CLASSES):
            if leaf:  # of both its sides as much as leaves leave open
                twice[c] += weight * (1 - MET_AGAIN) * 0.5 * (shares[m, c] + shares[half + m, c])
            else:
                twice[c] += weight * (1 - above) * shares[m, c]
    sunlit, skylit = lit / blocked, skylit * every / blocked
    for c in range(CLASSES):
        out.bounced[p, f, TWICE_BY_SUN * CLASSES + c] = twice[c] * sunlit
        out.bounced[p, f, TWICE_BY_SKY * CLASSES + c] = twice[c] * skylit
    out.bounced[p, f, AMONG_LEAVES] = among * max(sunlit, _ON_LEAVES)
