"""The kernel of `shade`: light of each pixel's samples, channel by channel."""

import math
from functools import lru_cache
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.render.shading.diffuse import (
    FINE_STEPS,
    add_base,
    fill_air_row,
    groove_factor,
    interpolate_angles,
)
from glintrack.render.shading.hits import Hits
from glintrack.render.shading.interface import (
    CACHED_FACETS,
    add_gathered,
    add_polarized,
    fill_sky_ray,
    gather_around,
    mirror_base,
    mirror_sky,
    mirror_unit_light,
    set_path,
)
from glintrack.render.shading.materials import MIRROR_ROUGHNESS, MaterialTables
from glintrack.render.shading.projection import Light
from glintrack.render.shading.rough import Hit, PrefilteredReflection, add_glint

_LATTICE = 256  # cells of the mottle before it repeats: 1 km for the finer octave
_APART = 77  # cells between the octaves
_ZERO, _ONE, _TWO, _THREE, _FINE, _COARSE = (np.float32(x) for x in (0, 1, 2, 3, 0.25, 0.0625))
# of the lattice's planes, so that walls are mottled too
_LEAN_X, _LEAN_Y = np.float32(0.37), np.float32(0.61)
_NORMAL_INCIDENCE = np.float32(1e-12)


@lru_cache(maxsize=1)
def mottle_lattice() -> Float[Array, "cell cell"]:
    """Draw even noise of zero mean for the mottle, the same for every frame."""
    return np.random.default_rng(5).uniform(-1.6, 1.6, (_LATTICE, _LATTICE)).astype(np.float32)


@nb.njit(cache=True, fastmath=True, error_model="numpy", forceinline=True)
def _incidence(dx, dy, dz, nx, ny, nz, sun, axis):
    """Cosines toward lens and sun, and the turn from the plane of look and normal to the detector's axis."""
    (sx, sy, sz), (ax, ay, az) = sun, axis
    vx, vy, vz = -dx, -dy, -dz
    view = vx * nx + vy * ny + vz * nz
    # of the s axis n × v on the detector's, and across it (see `stokes.axis_turn`)
    c = nx * (vy * az - vz * ay) + ny * (vz * ax - vx * az) + nz * (vx * ay - vy * ax)
    s = nx * ax + ny * ay + nz * az - view * (vx * ax + vy * ay + vz * az)
    norm = _ONE / (c * c + s * s + _NORMAL_INCIDENCE)
    turn_c, turn_s = (c * c - s * s + _NORMAL_INCIDENCE) * norm, _TWO * c * s * norm
    return view, sx * nx + sy * ny + sz * nz, turn_c, turn_s


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _mottle(px, py, pz, contrast, lattice):
    """Smooth value noise about 1 of variance contrast²: patches and wear, on lattices of 4 m and 16 m."""
    if contrast == _ZERO:
        return _ONE
    x, y = px + _LEAN_X * pz, py + _LEAN_Y * pz
    noise = _octave(lattice, x * _FINE, y * _FINE, 0)
    noise += _octave(lattice, x * _COARSE, y * _COARSE, _APART)
    return max(_ONE + contrast * noise, _ZERO)


@nb.njit(cache=True, fastmath=True, forceinline=True)
def _octave(lattice, px, py, apart):
    i, j = math.floor(px), math.floor(py)
    fx, fy = px - np.float32(i), py - np.float32(j)
    fx, fy = fx * fx * (_THREE - _TWO * fx), fy * fy * (_THREE - _TWO * fy)
    i, j = int(i) + 1000, int(j) + 1000 + apart
    last = _LATTICE - 1  # a power of two: the remainder is a mask
    i0, i1, j0, j1 = i & last, (i + 1) & last, j & last, (j + 1) & last
    low = lattice[i0, j0] + fy * (lattice[i0, j1] - lattice[i0, j0])
    high = lattice[i1, j0] + fy * (lattice[i1, j1] - lattice[i1, j0])
    return low + fx * (high - low)


class Scratch(NamedTuple):
    """Working arrays of a kernel; most hold from one element to the next.

    Parameters
    ----------
    radiance
        Radiance of the sky components in one direction.
    base
        Light on a base: sun, surroundings, and each diffuse component.
    around
        Irradiance of each diffuse component on a facet.
    total
        Stokes radiance of one element by channel.
    plain, own
        Mirrored components without dispersion, and with spectra of their own.
    lit_step, lit_here, mirrored_step, mirrored_here, at, facet, mixed
        See `interface`.
    """

    radiance: Float[Array, "sky_component 3"]
    base: Float[Array, "light"]
    around: Float[Array, "diffuse_component"]
    total: Float[Array, "3 channel"]
    plain: Float[Array, "component 3"]
    own: Float[Array, "component 3"]
    lit_step: Int[Array, "row"]
    lit_here: Float[Array, "row light channel"]
    mirrored_step: Int[Array, "group"]
    mirrored_here: Float[Array, "group component channel"]
    at: Float[Array, "slot 5"]
    facet: Float[Array, "slot 2 look_and_term value"]
    mixed: Float[Array, "value"]


class ShadedFrame(NamedTuple):
    """Hits, sun, and prepared tables of a frame."""

    rays: Hits
    surfaces: MaterialTables
    light: Light
    rough: PrefilteredReflection
    sun: Float[Array, "3"]
    lattice: Float[Array, "cell cell"]


@nb.njit(cache=True, forceinline=True)
def _scratch(frame):
    light, gathered = frame.light, frame.rough.gathered
    lit, mirrored, skies, width = light.lit, light.mirrored, light.sky_map.shape[2], light.lit.shape[3]
    return Scratch(
        np.empty((skies, 3), np.float32),
        np.zeros(lit.shape[2], np.float32),
        np.empty(light.irradiance.shape[1], np.float32),
        np.empty((3, width), np.float32),
        np.empty((mirrored.shape[2], 3), np.float32),
        np.empty((mirrored.shape[2], 3), np.float32),
        np.full(lit.shape[1], -1),
        np.empty(lit.shape[1:], np.float32),
        np.full(mirrored.shape[1], -1),
        np.empty(mirrored.shape[1:], np.float32),
        np.full((CACHED_FACETS, 5), -2.0),
        np.empty((CACHED_FACETS, 2, 2 * frame.surfaces.terms.max(), gathered.shape[1]), np.float32),
        np.empty(gathered.shape[1], np.float32),
    )


@nb.njit(nogil=True, cache=True, error_model="numpy")
def shade_pixels(start, stop, index, frame, out):
    """Fill ``out`` (pixel, 3, channel) for rows of ``index``."""
    scratch, axis = _scratch(frame), frame.rays.detector_axis
    rays, surfaces, light, sun = frame.rays, frame.surfaces, frame.light, frame.sun
    materials, at_angle, grid = rays.material, surfaces.at_angle, light.grid
    plain, own, total = scratch.plain, scratch.own, scratch.total
    airmasses, columns, width = light.lit.shape[0] - 1, rays.columns, light.lit.shape[3]
    block = 2 + light.sky_map.shape[2]
    toward_sun = np.float32(sun[0]), np.float32(sun[1]), np.float32(sun[2])
    right = np.float32(axis[0]), np.float32(axis[1]), np.float32(axis[2])
    for j in range(start, stop):
        element = index[j]
        row = element // columns
        column = element - row * columns
        begin, end = rays.first[element], rays.first[element + 1]
        _clear(plain, block, 3)
        _clear(total, 3, width)
        step, ground = 0, 0.0
        for ray in range(begin, end):
            ground += rays.weight[ray] if materials[ray] >= 0 else 0.0
        if ground > 0:
            airmass = -1.0 / min(float(rays.look[element, 2]), -1e-6)
            node = min(max((airmass - light.airmass_start) / light.airmass_step, 0.0), airmasses - 1.0)
            step = int(node * FINE_STEPS + 0.5)
            where = grid.row_low[row], grid.row_part[row], grid.column_low[column], grid.column_part[column]
            set_path(where, light.path, ground, width, total)
        for ray in range(begin, end):
            m, share = int(materials[ray]), float(rays.weight[ray])
            dx, dy, dz = rays.look[element, 0], rays.look[element, 1], rays.look[element, 2]
            if m < 0:
                fill_sky_ray(dx, dy, dz, axis, light.sky_map, share, scratch.radiance, own)
                mirrored_here = scratch.mirrored_here
                fill_air_row(
                    light.mirrored, airmasses * FINE_STEPS, 0, scratch.mirrored_step, mirrored_here, width
                )
                _add_mirrored_light(own, block, mirrored_here, 0, width, total)
                continue
            nx, ny, nz = rays.normal[ray, 0], rays.normal[ray, 1], rays.normal[ray, 2]
            view, sunward, turn_c, turn_s = _incidence(dx, dy, dz, nx, ny, nz, toward_sun, right)
            contrast = np.float32(surfaces.mottle[m]) if rays.vehicle_id[ray] < 0 else _ZERO
            px, py, pz = rays.point[ray, 0], rays.point[ray, 1], rays.point[ray, 2]
            sunlight, sky_view = float(rays.sun_visible[ray]), float(rays.sky_view[ray])
            hit = Hit(dx, dy, dz, nx, ny, nz, view, sunward, sunlight, sky_view, m, ray)
            scale = share / math.pi * _mottle(px, py, pz, contrast, frame.lattice)
            enter, even, coat, degree = interpolate_angles(at_angle, m, view)
            enter *= groove_factor(hit, sun, surfaces.groove[m])
            q, u = -degree * turn_c, degree * turn_s
            place = add_base(hit, scale, enter, even, q, u, rays, step, width, surfaces, light, scratch)
            if surfaces.polarized[m] > 0 and sunward > 0 and sunlight > 0:
                add_polarized(hit, surfaces, share, sun, axis, plain)
            _add_interface(hit, place, row, column, coat, share, step, width, frame, scratch)
        if ground > 0:
            fill_air_row(light.mirrored, step, 0, scratch.mirrored_step, scratch.mirrored_here, width)
            _add_mirrored_light(plain, block, scratch.mirrored_here, 0, width, total)
        for s in range(3):
            for channel in range(out.shape[2]):
                out[j, s, channel] = total[s, channel]


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _add_interface(hit, place, r, c, coat, share, step, width, frame, scratch):
    """Add mirrored light: to ``plain``, or directly for an interface with spectra of its terms."""
    rays, surfaces, light, rough = frame.rays, frame.surfaces, frame.light, frame.rough
    axis = rays.detector_axis
    m, skies = hit.material, light.sky_map.shape[2]
    weight, k = surfaces.weight[m] * share, surfaces.optics[m]
    if weight == 0.0:
        return
    terms, alpha, block, group = surfaces.terms[k], surfaces.alpha[k], 2 + skies, light.group[k]
    target = scratch.own if group > 0 else scratch.plain
    _clear(scratch.own, terms * block if group > 0 else 0, 3)
    glint = weight * hit.sunlight if hit.cos_sun > 0 else 0.0
    mirrors, shown = rays.mirror_material[hit.ray] >= 0, (0.0, 0.0, 0.0)
    if alpha >= MIRROR_ROUGHNESS:
        slot = gather_around(hit.nx, hit.ny, hit.nz, k, terms, r, c, rough, scratch.at, scratch.facet)
        shining = hit.sunlight if glint > 0 else 0.0
        around, amounts = (
            (share * coat, (place[0], 0.0 if mirrors else place[1]), shining),
            surfaces.reference[k],
        )
        facet, mixed = scratch.facet, scratch.mixed
        shown = add_gathered(around, terms, amounts, skies, r, c, rough, facet, slot, mixed, target)
        glint = 0.0 if rough.soft[k] else glint
    elif mirrors:
        shown = mirror_unit_light(hit, weight, k, terms, surfaces, axis)
    else:
        mirror_sky(hit, weight, k, terms, surfaces.fresnel, axis, light.sky_map, scratch.radiance, target)
    if mirrors:
        mirror_base(hit, shown, rays, step, width, light, scratch)
    if glint > 0:
        add_glint(hit, frame.sun, k, glint, surfaces, axis, block, target)
    if group > 0:
        fill_air_row(light.mirrored, step, group, scratch.mirrored_step, scratch.mirrored_here, width)
        _add_mirrored_light(scratch.own, terms * block, scratch.mirrored_here, group, width, scratch.total)


@nb.njit(cache=True, forceinline=True)
def _clear(values, rows, columns):
    for row in range(rows):
        for column in range(columns):
            values[row, column] = 0.0


@nb.njit(cache=True, fastmath=True, forceinline=True)
def _add_mirrored_light(mirrored, count, lights, row, width, total):
    """Add the light of mirrored coefficients in each channel."""
    zero = np.float32(0.0)
    for e in range(0, count, 2):
        after = min(e + 1, count - 1)
        i, q, u = mirrored[e, 0], mirrored[e, 1], mirrored[e, 2]
        v, w, z = zero, zero, zero
        if after > e:
            v, w, z = mirrored[after, 0], mirrored[after, 1], mirrored[after, 2]
        for x in range(width):
            light, other = lights[row, e, x], lights[row, after, x]
            total[0, x] += i * light + v * other
            total[1, x] += q * light + w * other
            total[2, x] += u * light + z * other
