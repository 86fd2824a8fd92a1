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
    Bases,
    Probes,
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
    plain, own
        Mirrored components without dispersion, and with spectra of their own.
    mirrored_step, mirrored_here, at, facet, mixed
        See `interface`.
    """

    radiance: Float[Array, "sky_component 3"]
    plain: Float[Array, "component 3"]
    own: Float[Array, "component 3"]
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


class Interfaces(NamedTuple):
    """Tables of interfaces: see `MaterialTables`, `Light` and `PrefilteredReflection`."""

    fresnel: Float[Array, "optics term cosine 3"]
    reference: Float[Array, "optics term"]
    sky_map: Float[Array, "disc disc sky_component 3"]
    mirrored: Float[Array, "airmass group component channel"]
    first: Int[Array, "optics normal look"]
    gathered: Float[Array, "row value"]
    soft: Int[Array, "optics"]


@nb.njit(cache=True, forceinline=True)
def _scratch(frame):
    light, gathered = frame.light, frame.rough.gathered
    mirrored, skies = light.mirrored, light.sky_map.shape[2]
    return Scratch(
        np.empty((skies, 3), np.float32),
        np.empty((mirrored.shape[2], 3), np.float32),
        np.empty((mirrored.shape[2], 3), np.float32),
        np.full(mirrored.shape[1], -1),
        np.empty(mirrored.shape[1:], np.float32),
        np.full((CACHED_FACETS, 5), -2.0),
        np.empty((CACHED_FACETS, 2, 2 * frame.surfaces.terms.max(), gathered.shape[1]), np.float32),
        np.empty(gathered.shape[1], np.float32),
    )


@nb.njit(cache=True, forceinline=True)
def _bases(lit, components):
    return Bases(
        lit,
        np.full(lit.shape[1], -1),
        np.empty(lit.shape[1:], np.float32),
        np.zeros(lit.shape[2], np.float32),
        np.empty(components, np.float32),
        np.empty((3, lit.shape[3]), np.float32),
    )


@nb.njit(cache=True, forceinline=True)
def _parts(frame):
    return frame.rays, frame.surfaces, frame.light, frame.sun, frame.rays.detector_axis


@nb.njit(cache=True, forceinline=True)
def _tables(frame):
    rays, surfaces, light, rough = frame.rays, frame.surfaces, frame.light, frame.rough
    probes = Probes(
        rays.probe_cells, rays.probe_facing, rays.probe_patches, light.probes, light.of_patch, light.by_patch,
        light.near_sun, light.irradiance, light.followed,
    )  # fmt: skip
    interfaces = Interfaces(
        surfaces.fresnel, surfaces.reference, light.sky_map, light.mirrored, rough.first, rough.gathered,
        rough.soft,
    )  # fmt: skip
    return probes, interfaces


@nb.njit(cache=True, forceinline=True)
def _between_looks(looks, row, column):
    """Node before a row and its part toward the next, the same of a column, and the numbers of nodes."""
    rows, columns = looks.direction.shape[0], looks.direction.shape[1]
    r, c = looks.row_low[row], looks.column_low[column]
    return r, looks.row_part[row], c, looks.column_part[column], rows, columns


@nb.njit(cache=True, forceinline=True)
def _mirrored_surface(rays, ray):
    """Fields of `Hits` for the surface that a ray's mirror image shows, without its material."""
    cell, part = rays.mirror_cell[ray], rays.mirror_part
    left, here = rays.mirror_left[ray] / 255.0, rays.mirror_here[ray]
    return rays.mirror_sun[ray], rays.mirror_sky[ray], cell, part[ray, 0], part[ray, 1], here, left


@nb.njit(nogil=True, cache=True, error_model="numpy")
def shade_pixels(start, stop, index, frame, out):
    """Fill ``out`` (pixel, 3, channel) for rows of ``index``."""
    rays, surfaces, light, sun, axis = _parts(frame)
    probes, interfaces = _tables(frame)
    scratch, bases = _scratch(frame), _bases(light.lit, light.irradiance.shape[1])
    materials, at_angle, grid, looks = rays.material, surfaces.at_angle, light.grid, frame.rough.grid
    plain, own, total = scratch.plain, scratch.own, bases.total
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
        look = _between_looks(looks, row, column)
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
            cell, part_x, part_y = rays.light_cell[ray], rays.light_part[ray, 0], rays.light_part[ray, 1]
            here, left = rays.sky_here[ray], rays.sky_left[ray] / 255.0
            hit = Hit(
                dx, dy, dz, nx, ny, nz, view, sunward, sunlight, sky_view, m, cell, part_x, part_y, here, left
            )
            scale = share / math.pi * _mottle(px, py, pz, contrast, frame.lattice)
            enter, even, coat, degree = interpolate_angles(at_angle, m, view)
            enter *= groove_factor(hit, sun, surfaces.groove[m])
            q, u = -degree * turn_c, degree * turn_s
            place = add_base(
                hit, scale, enter, even, q, u, step, width, at_angle, surfaces.leaf, bases, probes
            )
            if surfaces.polarized[m] > 0 and sunward > 0 and sunlight > 0:
                add_polarized(hit, surfaces, share, sun, axis, plain)
            weight, k = surfaces.weight[m] * share, surfaces.optics[m]
            if weight == 0.0:
                continue
            there, alpha, terms = int(rays.mirror_material[ray]), surfaces.alpha[k], surfaces.terms[k]
            lobe = k, weight * hit.sunlight if sunward > 0 else 0.0, alpha, surfaces.distribution[k], terms
            shown = _add_interface(
                hit, place, there >= 0, lobe, light.group[k], look, (weight, share * coat), step,
                width, sun, axis, interfaces, scratch, total,
            )  # fmt: skip
            if there >= 0:
                mirror_base(there, shown, _mirrored_surface(rays, ray), step, width, bases, probes)
        if ground > 0:
            fill_air_row(light.mirrored, step, 0, scratch.mirrored_step, scratch.mirrored_here, width)
            _add_mirrored_light(plain, block, scratch.mirrored_here, 0, width, total)
        for s in range(3):
            for channel in range(out.shape[2]):
                out[j, s, channel] = total[s, channel]


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _add_interface(
    hit, place, mirrors, lobe, group, look, weights, step, width, sun, axis, tables, scratch, total
):
    """Add mirrored light: to ``plain``, or to ``total`` for an interface with spectra of its terms.

    Return I, Q and U of unpolarized light 1 off mirrored surfaces.
    """
    (k, glint, alpha, distribution, terms), (weight, coat), skies = lobe, weights, tables.sky_map.shape[2]
    block, shown = 2 + skies, (0.0, 0.0, 0.0)
    target = scratch.own if group > 0 else scratch.plain
    _clear(scratch.own, terms * block if group > 0 else 0, 3)
    if alpha >= MIRROR_ROUGHNESS:
        normal, rough = (hit.nx, hit.ny, hit.nz), (tables.first, tables.gathered, tables.soft)
        slot = gather_around(normal, k, terms, look, rough, scratch.at, scratch.facet)
        around = coat, (place[0], 0.0 if mirrors else place[1]), hit.sunlight if glint > 0 else 0.0
        facet, mixed = scratch.facet, scratch.mixed
        shown = add_gathered(around, terms, tables.reference[k], skies, look, facet, slot, mixed, target)
        glint = 0.0 if tables.soft[k] else glint
    elif mirrors:
        shown = mirror_unit_light(hit, weight, k, terms, tables.fresnel, tables.reference, axis)
    else:
        mirror_sky(hit, weight, k, terms, tables.fresnel, axis, tables.sky_map, scratch.radiance, target)
    if glint > 0:
        add_glint(hit, sun, (k, glint, alpha, distribution, terms), tables.fresnel, axis, block, target)
    if group > 0:
        fill_air_row(tables.mirrored, step, group, scratch.mirrored_step, scratch.mirrored_here, width)
        _add_mirrored_light(scratch.own, terms * block, scratch.mirrored_here, group, width, total)
    return shown


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
