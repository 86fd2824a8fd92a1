"""Light that surfaces get from the surfaces around them, without a wavelength.

Spectra of reflectance and transmittance are written as sums of six (`material_classes`). A probe holds the
amount of each that it gets, by the light that fell there:

    E(λ) = Σ_c b_c [S_c E_s + D_c E_d] + (Σ_cj b_c b_j T_cj E_s + Σ_c b_c R_c r E_d)/(1 − q r) + F … + K …

S holds sunlit surfaces (a leaf also from behind) and D those lit by the sky. Light of the sky about the sun
comes with the sun's: E_s is E_sun and that light, E_d the rest of the sky (`projection`; Hay and Davies,
"Calculation of the solar radiation incident on an inclined surface", First Canadian Solar Radiation Data
Workshop, 1980). T holds sunlight over two surfaces, found by rays onward from the ends of some rays; of the
second spectrum the first two components are used. R is skylight over two surfaces, of the frame's mean
reflectance r. Light over more surfaces is a geometric series of r, of which q meets surfaces again. Between
leaves it is one of ω, the part that a leaf scatters to either side, of which p meets leaves again: F holds
the difference, ½ω² [1/(1 − pω) − 1/(1 − q r)] E_s, and K that of the sky's light, ω p [ω/(1 − pω) − r/(1 −
q r)] E_d. A crown of leaf area index L has p = 0.88 (1 − exp(−0.7 L^0.75)) (Smolander and Stenberg, Remote
Sensing of Environment 94, 2005).

Of the blocked rays every third goes on, in a direction spread by the cosine about the normal where it ended,
of a leaf from the front and from the back in turn. The direction depends on the number of the probe's rays
onward before it, and on its place: neighbours have others and share their light.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numba as nb
import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int
from scipy.constants import Boltzmann, Planck, speed_of_light

from glintrack.core.arrays import Array

EVERY = 3  # of blocked rays, one goes on
_ONWARD_M = 3e-3  # off the facet, as `surfaces.SHADOW_OFFSET_M`
# steps that spread points evenly over a square (Roberts, "The Unreasonable Effectiveness of Quasirandom
# Sequences", 2018): 1/x and 1/x² with x³ = x + 1
_STEPS = (0.7548776662466927, 0.5698402909980532)
_THIRD = 0.3247179572447460  # 1 − 1/x³: of a place's third coordinate


class Onward(NamedTuple):
    """Rays onward from the ends of others.

    Parameters
    ----------
    of
        Number of the ray onward from each ray's end; −1 for none.
    behind
        True for a ray from a leaf's other side.
    start, direction
        Origin [m], and unit vector [1].
    """

    of: Int[Array, "ray"]
    behind: Bool[Array, "onward"]
    start: Float[Array, "onward 3"]
    direction: Float[Array, "onward 3"]


class Met(NamedTuple):
    """Surfaces that the rays of some probes meet.

    Parameters
    ----------
    material
        Material; −1 for sky.
    sun
        Cosine of the sun's incidence times the transmittance of its light; below 0 from behind. [1]
    point, normal
        Place [m], and the facet's normal [1].
    range_m
        Length of the ray. [m]
    """

    material: Int[Array, "ray"]
    sun: Float[Array, "ray"]
    point: Float[Array, "ray 3"]
    normal: Float[Array, "ray 3"]
    range_m: Float[Array, "ray"]


def rays_onward(
    first: Int[Array, "probe+1"],
    centre: Float[Array, "probe 3"],
    sets: Int[Array, "probe"],
    met: Met,
    translucent: Bool[Array, "material"],
) -> Onward:
    """Choose the rays onward from the ends of the rays of some probes.

    ``first`` is the first ray of each probe, and one more; ``centre`` its place [m], ``sets`` the number of
    its set of directions. The rays ``met`` surfaces; some materials are ``translucent``.
    """
    count, blocked = np.diff(first), met.material >= 0
    before = np.cumsum(blocked) - blocked  # blocked rays before each, of all probes
    turn = before - np.repeat(np.append(before, 0)[first[:-1]] - sets, count)
    goes_on = blocked & (turn % EVERY == 0)
    of = np.where(goes_on, np.cumsum(goes_on) - 1, -1).astype(np.int32)
    total = int(goes_on.sum())
    rays = Onward(of, np.empty(total, np.bool_), *(np.empty((total, 3), np.float32) for _ in range(2)))
    _aim(first, centre, sets, met.material, met.point, met.normal, translucent, rays)
    return rays


@nb.njit(nogil=True, cache=True)
def _aim(first, centre, sets, material, point, normal, translucent, rays):
    for p in range(len(sets)):
        x, y, z = float(centre[p, 0]), float(centre[p, 1]), float(centre[p, 2])
        along = x * _STEPS[0] + y * _STEPS[1] + z * _THIRD
        across = x * _STEPS[1] + y * _THIRD + z * _STEPS[0]
        before = 0
        for ray in range(first[p], first[p + 1]):
            onward = rays.of[ray]
            if onward < 0:
                continue
            before += 1
            u, v = (along + before * _STEPS[0]) % 1.0, (across + before * _STEPS[1]) % 1.0
            behind = translucent[material[ray]] and (before + sets[p]) % 2 == 1
            side = -1.0 if behind else 1.0
            nx, ny, nz = side * normal[ray, 0], side * normal[ray, 1], side * normal[ray, 2]
            up, out, turn = math.sqrt(1.0 - u), math.sqrt(u), 2 * math.pi * v
            s, t = out * math.cos(turn), out * math.sin(turn)
            # an upright frame about the normal (Duff et al., J. Computer Graphics Techniques 6, 2017)
            sign = 1.0 if nz >= 0 else -1.0
            a = -1.0 / (sign + nz)
            b = nx * ny * a
            rays.behind[onward] = behind
            rays.direction[onward, 0] = s * (1 + sign * nx * nx * a) + t * b + up * nx
            rays.direction[onward, 1] = s * sign * b + t * (sign + ny * ny * a) + up * ny
            rays.direction[onward, 2] = -s * sign * nx - t * ny + up * nz
            for c in range(3):
                rays.start[onward, c] = point[ray, c] + side * _ONWARD_M * normal[ray, c]


CLASSES, SECOND = 6, 2  # components of a surface's spectrum, and of those of the surface that lights it
BY_SUN, BY_SKY, TWICE_BY_SKY, TWICE_BY_SUN = (CLASSES * k for k in range(4))
AMONG_LEAVES = TWICE_BY_SUN + CLASSES * SECOND
AMONG_LEAVES_BY_SKY = AMONG_LEAVES + 1
BOUNCES = AMONG_LEAVES_BY_SKY + 1
MET_AGAIN = 0.7  # p, that of a leaf area index of 3: single crowns lose light at their sides
ENCLOSED = 0.9  # q: part of the light from surfaces lit by others that meets others again
COVERED_M = 1.8  # largest height of an object over a level probe that is under a car or a bench
_TOP_PATCHES = 3  # number of the last patches, those about the zenith
_SUN_K = 5772.0  # effective temperature, of the weights of spectra
_RARE = 0.1  # weight of coated surfaces (vehicles, glass): little of the ground is covered by them
_DARK = 0.7  # negative power of a spectrum's size in its weight: relative errors matter


class MaterialClasses(NamedTuple):
    """Materials as sums of a few spectra.

    Parameters
    ----------
    wavelength_um
        Wavelengths of the spectra. [µm]
    spectra
        Principal spectra. [1]
    shares
        Amount of each in each row of (reflectance of each material, transmittance of each). [1]
    leaf
        Mean reflectance plus transmittance of the materials that transmit light. [1]
    """

    wavelength_um: Float[Array, "wavelength"]
    spectra: Float[Array, "class wavelength"]
    shares: Float[Array, "row class"]
    leaf: Float[Array, "wavelength"]


class Gathered(NamedTuple):
    """Results of probes.

    Parameters
    ----------
    patches
        Open part of each patch of the sky. [1/255]
    bounced
        Irradiance over that of its light, by light and class of material. [1]
    sky_view
        Sky view factor of each facing. [1]
    past_leaves
        Transmittance of leaves for the first facing's light of an even sky past solids. [1]
    alive
        False for a probe in a building or under a car.
    """

    patches: Int[Array, "probe patch"]
    bounced: Float[Array, "probe facing bounce"]
    sky_view: Float[Array, "probe facing"]
    past_leaves: Float[Array, "probe"]
    alive: Bool[Array, "probe"]


def material_classes(materials: xr.Dataset) -> MaterialClasses:
    """Find the principal components of a library's spectra, weighted with sunlight."""
    rows = np.ascontiguousarray(materials["reflectance"].values, dtype=float)
    through = materials["transmittance"].values if "transmittance" in materials else np.zeros_like(rows)
    coated = np.asarray(materials["specular_weight"].values, float) > 0.5
    wavelength_um = materials["wavelength"].values.astype(float)
    rows = np.concatenate([rows, through])
    photon = Planck * speed_of_light / (1e-6 * wavelength_um * Boltzmann * _SUN_K)
    sunlight = np.sqrt(wavelength_um**-5 / np.expm1(photon))
    sunlight /= sunlight.max()
    weighed = rows * sunlight
    weight = np.maximum(np.linalg.norm(weighed, axis=1), 1e-3) ** -_DARK
    weight *= np.where(np.tile(coated, 2), _RARE, 1.0)
    components = _components((weighed * weight[:, None]).tobytes(), len(wavelength_um))
    principal = np.zeros((CLASSES, len(wavelength_um)))
    principal[: len(components)] = components[:CLASSES]
    shares = weighed @ principal.T
    size = np.maximum(np.abs(shares).max(axis=0), 1e-9)
    half = len(rows) // 2
    leaves = rows[half:].max(axis=1) > 0
    leaf = (rows[:half] + rows[half:])[leaves].mean(axis=0) if leaves.any() else np.zeros(len(wavelength_um))
    return MaterialClasses(wavelength_um, principal * size[:, None] / sunlight, shares / size, leaf)


@lru_cache(maxsize=8)
def _components(spectra: bytes, wavelengths: int) -> Float[Array, "component wavelength"]:
    """Principal components of spectra, once for all frames."""
    return np.linalg.svd(np.frombuffer(spectra).reshape(-1, wavelengths), full_matrices=False)[2]


@nb.njit(nogil=True, cache=True, fastmath=True)
def gather_light(start, stop, first, rays, facing, is_level, met, leafy, onward, beyond, shares, out):
    """Fill ``out`` (`Gathered`) for probes ``start`` to ``stop``; without ``shares`` the sky alone.

    Probe p has ``rays`` (`sky.PatchRays`, without sets) from ``first[p]`` to ``first[p + 1]``, its normals in
    ``facing``, and may be on level ground. Rays that only leaves keep from the sky are ``leafy``; ``beyond``
    is the `Met` of the rays ``onward``.
    """
    patches = out.patches.shape[1]
    seen, whole = np.empty(patches), np.empty(patches)
    for p in range(start, stop):
        low, high = first[p], first[p + 1]
        one = facing.shape[1] == 1
        fx, fy, fz = facing[p, 0, 0], facing[p, 0, 1], facing[p, 0, 2]
        seen[:], whole[:] = 0.0, 0.0
        above_all = 0
        for r in range(low, high):
            b = rays.patch[r]
            if b < 0:
                continue
            d = rays.direction[r]
            weight = rays.brightness[r] * (max(fx * d[0] + fy * d[1] + fz * d[2], 0.05) if one else 1.0)
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
        out.alive[p] = (some and not (is_level[p] and above_all == 0)) or not one
        for f in range(facing.shape[1]):
            _gather_facing(p, f, low, high, rays, facing, met, leafy, onward, beyond, shares, out)


@nb.njit(cache=True, fastmath=True, forceinline=True)
def _gather_facing(p, f, low, high, rays, facing, met, leafy, onward, beyond, shares, out):
    """Gather a facing's sky view factor, its part past leaves, and light of the surfaces that rays meet."""
    nx, ny, nz = facing[p, f, 0], facing[p, f, 1], facing[p, f, 2]
    sky, open_sky, past, every, blocked, followed = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for r in range(low, high):
        d = rays.direction[r]
        weight = max(nx * d[0] + ny * d[1] + nz * d[2], 0.0) * rays.solid_angle[r]
        every += weight
        if rays.patch[r] >= 0:
            sky += weight
            open_sky += weight if met.material[r] < 0 else 0.0
            past += weight if leafy[r] else 0.0
        if met.material[r] >= 0:
            blocked += weight
            followed += weight if onward.of[r] >= 0 else 0.0
    view = open_sky / sky if sky > 0 else 0.0
    out.sky_view[p, f] = view
    if f == 0:
        out.past_leaves[p] = open_sky / (open_sky + past) if open_sky + past > 0 else 1.0
    bounced = out.bounced[p, f]
    for k in range(bounced.shape[0]):
        bounced[k] = 0.0
    if bounced.shape[0] == 0 or blocked == 0.0:
        return
    half, skylit = shares.shape[0] // 2, 0.0
    for r in range(low, high):
        m = met.material[r]
        if m < 0:
            continue
        d = rays.direction[r]
        weight = max(nx * d[0] + ny * d[1] + nz * d[2], 0.0) * rays.solid_angle[r] / every
        if weight == 0.0:
            continue
        up, sun, leaf = met.normal[r, 2], met.sun[r], False
        above, below = 0.5 * (1 + up) * view, 0.5 * (1 - up) * view
        skylit += weight * above
        for c in range(CLASSES):
            back, through = shares[m, c], shares[half + m, c]
            leaf |= through != 0
            by_sun = sun * back if sun > 0 else -sun * through
            bounced[BY_SUN + c] += weight * by_sun
            bounced[BY_SKY + c] += weight * (back * above + through * below)
        for c in range(CLASSES):
            if leaf:
                both = shares[m, c] + shares[half + m, c]  # each with half of what comes to the two sides
                bounced[TWICE_BY_SKY + c] += weight * (1 - 0.5 * view) * both
            else:
                bounced[TWICE_BY_SKY + c] += weight * (1 - above) * shares[m, c]
        if leaf:
            bounced[AMONG_LEAVES_BY_SKY] += weight * (1 - 0.5 * view)
        n = onward.of[r]
        if n >= 0:
            light = weight * blocked / followed
            _add_twice(bounced, m, leaf, onward.behind[n], light, beyond.material[n], beyond.sun[n], shares)
    for c in range(CLASSES):
        bounced[TWICE_BY_SKY + c] *= skylit * every / blocked
    bounced[AMONG_LEAVES_BY_SKY] *= skylit * every / blocked


@nb.njit(cache=True, fastmath=True, forceinline=True)
def _add_twice(bounced, m, leaf, behind, weight, there, sun, shares):
    """Add sunlight that came over a second surface, ``there``."""
    half = shares.shape[0] // 2
    if there < 0 or sun == 0.0:
        return
    light = weight * abs(sun)
    row = (half + m if behind else m) if leaf else m
    there_row = there if sun > 0 else half + there
    for c in range(CLASSES):
        sent_on = light * shares[row, c] * (2.0 if leaf else 1.0)  # one of two sides was looked from
        for j in range(SECOND):
            bounced[TWICE_BY_SUN + c * SECOND + j] += sent_on * shares[there_row, j]
    if leaf:
        for c in range(CLASSES):
            if shares[half + there, c] != 0:
                bounced[AMONG_LEAVES] += light
                break
