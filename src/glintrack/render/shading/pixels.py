"""The kernel of `shade`: light of each pixel's samples, channel by channel."""

import math
from functools import lru_cache
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.render.light.lattice import OPEN, SPACE, node_of_normal
from glintrack.render.shading.diffuse import (
    FINE_STEPS,
    Bases,
    Place,
    Probes,
    add_base_light,
    add_sky_of_body,
    fill_air_row,
    fill_around,
    fill_irradiance,
    groove_factor,
    interpolate_angles,
    set_diffuse,
    take_near_sun,
)
from glintrack.render.shading.hits import Hits
from glintrack.render.shading.interface import (
    CACHED_FACETS,
    add_gathered,
    add_polarized,
    facet_slot,
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
_PARKED = 1_000_000 - 2  # offset of the draws of parked vehicles, ids −2, −3, …
_APART = 77  # cells between the octaves
_ZERO, _ONE, _TWO, _THREE, _FINE, _COARSE = (np.float32(x) for x in (0, 1, 2, 3, 0.25, 0.0625))
# of the lattice's planes, so that walls are mottled too
_LEAN_X, _LEAN_Y = np.float32(0.37), np.float32(0.61)
_UNIT = np.float32(math.sqrt(3) / 1.6)  # makes the variance of the lattice's values 1
_HALF, _PER_PATCH, _PATCHED = (np.float32(x) for x in (0.5, 0.2, 1.3))  # 1/m, 1/m; 19 % of the patches differ
_NORMAL_INCIDENCE = np.float32(1e-12)


@lru_cache(maxsize=1)
def mottle_lattice() -> Float[Array, "cell cell"]:
    """Draw even noise of zero mean for the mottle, the same for every frame."""
    return np.random.default_rng(5).uniform(-1.6, 1.6, (_LATTICE, _LATTICE)).astype(np.float32)


@nb.njit(cache=True, fastmath=True, error_model="numpy", forceinline=True)
def _incidence(dx, dy, dz, nx, ny, nz, sun, axis):
    """Cosines toward lens and sun, and the turn from the plane of look and normal to the detector's axis."""
    sx, sy, sz = np.float32(sun[0]), np.float32(sun[1]), np.float32(sun[2])
    ax, ay, az = np.float32(axis[0]), np.float32(axis[1]), np.float32(axis[2])
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


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _vary(px, py, pz, vehicle, spread, lattice):
    """Factor of reflectance of a vehicle's paint, share of the other base, and factor of the interface.

    Noise over the place, for ground and walls: smooth on 2 m and 16 m, and rectangular patches of 5 m, such
    as repairs. One draw each, for a vehicle, moving or parked.
    """
    shade, colour, gloss = spread
    last = _LATTICE - 1
    if vehicle != -1:
        vehicle = vehicle if vehicle >= 0 else _PARKED - vehicle
        i, j = int(vehicle) & last, (int(vehicle) // _LATTICE) & last
        scale = max(_ONE + shade * _UNIT * lattice[i, j], _ZERO)
        share, shine = _UNIT * lattice[i, (j + _APART) & last], _UNIT * lattice[(i + _APART) & last, j]
    else:
        scale, x, y = _ONE, px + _LEAN_X * pz, py + _LEAN_Y * pz
        i, j = math.floor(x * _PER_PATCH), math.floor(y * _PER_PATCH)
        patch = lattice[(int(i) + 1000) & last, (int(j) + 1000) & last]
        patch = patch if abs(patch) > _PATCHED else _ZERO
        share = _octave(lattice, x * _HALF, y * _HALF, 2 * _APART) + patch
        shine = _octave(lattice, x * _COARSE, y * _COARSE, 3 * _APART) + patch
    return scale, colour * share, max(_ONE + gloss * shine, _ZERO)


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
    )


@nb.njit(cache=True, forceinline=True)
def _probes(rays, light):
    return Probes(
        rays.probe_cells, rays.probe_facing, rays.probe_patches, light.probes, light.of_patch, light.by_patch,
        light.near_sun, light.irradiance, light.followed,
    )  # fmt: skip


@nb.njit(cache=True, forceinline=True)
def _between_looks(looks, row, column):
    """Node before a row and its part toward the next, the same of a column, and the numbers of nodes."""
    rows, columns = looks.direction.shape[0], looks.direction.shape[1]
    r, c = looks.row_low[row], looks.column_low[column]
    return r, looks.row_part[row], c, looks.column_part[column], rows, columns


@nb.njit(cache=True, forceinline=True)
def _air_step(down, light):
    """Fine step of airmass of a direction of look with ``down`` as its upward component."""
    airmass = -1.0 / min(float(down), -1e-6)
    node = min(max((airmass - light.airmass_start) / light.airmass_step, 0.0), light.lit.shape[0] - 2.0)
    return int(node * FINE_STEPS + 0.5)


@nb.njit(cache=True, forceinline=True)
def _place(ray, cell, part, here, left):
    return Place(cell[ray], part[ray, 0], part[ray, 1], here[ray], left[ray] / 255.0)


@nb.njit(nogil=True, cache=True, error_model="numpy")
def shade_pixels(start, stop, index, frame, out):
    """Fill ``out`` (pixel, 3, channel) for rows of ``index``.

    numba counts references to each array of a tuple that a function takes: the loops hand on single arrays.
    """
    samples = 0
    for element in index[start:stop]:
        samples += frame.rays.first[element + 1] - frame.rays.first[element]
    bases, mirrored = _bases(frame.light.lit, frame.light.irradiance.shape[1]), np.empty((samples, 3))
    _shade_bases(index[start:stop], frame, bases, mirrored, out[start:stop])
    _add_interfaces(index[start:stop], frame, bases, mirrored, out[start:stop])


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _shade_bases(index, frame, bases, mirrored, out):
    """Fill ``out`` with path radiance and bases, ``mirrored`` with what `_add_interfaces` needs of samples.

    These are the two values of `mirror_place`, and the factor of the interface by `_vary`.
    """
    rays, surfaces, light, sun, lattice = frame.rays, frame.surfaces, frame.light, frame.sun, frame.lattice
    probes, axis, grid, at_angle = _probes(rays, light), rays.detector_axis, light.grid, surfaces.at_angle
    cells, probes_lit, irradiance, near_sun = probes.cells, probes.lit, probes.irradiance, probes.near_sun
    lit, lit_step, lit_here, base, around = bases
    leaf, toward, variation = surfaces.leaf, surfaces.toward, surfaces.variation
    width, sample = out.shape[2], -1
    for j in range(len(index)):
        element, total, ground = index[j], out[j], 0.0
        for ray in range(rays.first[element], rays.first[element + 1]):
            ground += rays.weight[ray] if rays.material[ray] >= 0 else 0.0
        row = element // rays.columns
        column = element - row * rays.columns
        where = grid.row_low[row], grid.row_part[row], grid.column_low[column], grid.column_part[column]
        set_path(where, light.path, ground, width, total)
        dx, dy, dz = rays.look[element, 0], rays.look[element, 1], rays.look[element, 2]
        step = _air_step(dz, light)
        for ray in range(rays.first[element], rays.first[element + 1]):
            m, sample = int(rays.material[ray]), sample + 1
            if m < 0:
                continue
            nx, ny, nz = rays.normal[ray, 0], rays.normal[ray, 1], rays.normal[ray, 2]
            view, sunward, turn_c, turn_s = _incidence(dx, dy, dz, nx, ny, nz, sun, axis)
            sunlight, sky_view = float(rays.sun_visible[ray]), float(rays.sky_view[ray])
            hit = Hit(dx, dy, dz, nx, ny, nz, view, sunward, sunlight, sky_view, m)
            place = _place(ray, rays.light_cell, rays.light_part, rays.sky_here, rays.sky_left)
            contrast = np.float32(surfaces.mottle[m]) if rays.vehicle_id[ray] < 0 else _ZERO
            px, py, pz = rays.point[ray, 0], rays.point[ray, 1], rays.point[ray, 2]
            scale = float(rays.weight[ray]) / math.pi * _mottle(px, py, pz, contrast, lattice)
            enter, even, reflected, degree = interpolate_angles(at_angle, m, view)
            other, share, gloss = toward[m], _ZERO, _ONE
            if other >= 0:
                spread = variation[m, 0], variation[m, 1], variation[m, 2]
                factor, share, gloss = _vary(px, py, pz, rays.vehicle_id[ray], spread, lattice)
                share = min(max(share, variation[m, 3]), _ONE)
                gloss = min(gloss, _ONE / max(surfaces.weight[m], np.float32(1e-3)))  # at most Fresnel's law
                # a stronger interface transmits less light to the base, and polarizes more what leaves it
                below, kept = max(1 - reflected, 1e-3), max(1 - gloss * reflected, 1e-3)
                scale *= factor * kept / below
                degree *= gloss * below / kept
            mirrored[sample, 2] = gloss
            enter *= groove_factor(hit, sun, surfaces.groove[m])
            q, u = -degree * turn_c, degree * turn_s
            base[0], on_body = 0.0, place.cell <= SPACE and not leaf[m]
            if sunward > 0 and sunlight > 0:
                leave = interpolate_angles(at_angle, m, sunward)[0]
                base[0] = scale * enter * leave * sunward * sunlight
            for behind in range(2 if leaf[m] else 1):
                if place.cell == OPEN:
                    fill_irradiance(hit, behind, irradiance, around)
                else:
                    cap = fill_around(hit, place, behind, on_body, cells, probes_lit, around)
                    if on_body:
                        add_sky_of_body(place, node_of_normal(nx, ny, nz), probes, around)
                    elif place.cell >= 0 and place.left == 1.0 and sunward > 0 and not behind:
                        take_near_sun(hit, cap, place.here, near_sun, around)
                part = scale if behind else scale * even
                seen = set_diffuse(hit, place, part, behind, probes.followed, base, around)
                if behind:
                    base[0] = scale * -sunward * sunlight if sunward < 0 else 0.0
                else:
                    mirrored[sample, 0], mirrored[sample, 1] = seen
                lit_row = m + behind * leaf.shape[0]
                fill_air_row(lit, step, lit_row, lit_step, lit_here, width)
                add_base_light(base, lit_here, lit_row, _ONE - share, q, u, width, total)
                if share != 0:
                    lit_row = other + behind * leaf.shape[0]
                    fill_air_row(lit, step, lit_row, lit_step, lit_here, width)
                    add_base_light(base, lit_here, lit_row, share, q, u, width, total)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _add_interfaces(index, frame, bases, mirrored, out):
    """Add mirrored light to ``out``: by way of ``plain``, or directly for terms with spectra of their own."""
    rays, surfaces, light, rough, sun = frame.rays, frame.surfaces, frame.light, frame.rough, frame.sun
    probes, scratch, axis = _probes(rays, light), _scratch(frame), rays.detector_axis
    fresnel, reference, sky_map, first = surfaces.fresnel, surfaces.reference, light.sky_map, rays.first
    first_row, gathered, soft, lights = rough.first, rough.gathered, rough.soft, light.mirrored
    radiance, plain, own, step_of, here, at, facet, mixed = scratch
    skies, width, sample = sky_map.shape[2], out.shape[2], -1
    block, space = 2 + skies, (lights.shape[0] - 1) * FINE_STEPS
    for j in range(len(index)):
        element, total, ground = index[j], out[j], False
        _clear(plain, block, 3)
        dx, dy, dz = rays.look[element, 0], rays.look[element, 1], rays.look[element, 2]
        step = _air_step(dz, light)
        row = element // rays.columns
        look = _between_looks(rough.grid, row, element - row * rays.columns)
        for ray in range(first[element], first[element + 1]):
            m, share, sample = int(rays.material[ray]), float(rays.weight[ray]), sample + 1
            if m < 0:
                fill_sky_ray(dx, dy, dz, axis, sky_map, share, radiance, own)
                fill_air_row(lights, space, 0, step_of, here, width)
                _add_mirrored_light(own, block, here, 0, width, total)
                continue
            ground, share = True, share * mirrored[sample, 2]
            nx, ny, nz = rays.normal[ray, 0], rays.normal[ray, 1], rays.normal[ray, 2]
            view, sunward, _, _ = _incidence(dx, dy, dz, nx, ny, nz, sun, axis)
            sunlight, k = float(rays.sun_visible[ray]), surfaces.optics[m]
            hit = Hit(dx, dy, dz, nx, ny, nz, view, sunward, sunlight, 0.0, m)
            alpha, terms, group = surfaces.alpha[k], surfaces.terms[k], light.group[k]
            lobe = k, surfaces.weight[m], alpha, surfaces.distribution[k], terms
            if surfaces.polarized[m] > 0 and sunward > 0 and sunlight > 0:
                add_polarized(hit, lobe, surfaces.polarized[m], fresnel, reference, share, sun, axis, plain)
            weight, there = surfaces.weight[m] * share, int(rays.mirror_material[ray])
            if weight == 0.0:
                continue
            glint, shown = weight * sunlight if sunward > 0 else 0.0, (0.0, 0.0, 0.0)
            target = own if group > 0 else plain
            _clear(own, terms * block if group > 0 else 0, 3)
            if alpha >= MIRROR_ROUGHNESS:
                slot, known = facet_slot(nx, ny, nz, k, look, at)
                if not known:
                    gather_around(slot, (nx, ny, nz), k, terms, look, soft[k], first_row, gathered, facet)
                coat = share * interpolate_angles(surfaces.at_angle, m, view)[2]
                others = 0.0 if there >= 0 else mirrored[sample, 1]
                mixing = coat, (mirrored[sample, 0], others), sunlight if glint > 0 else 0.0
                amounts = reference[k]
                shown = add_gathered(mixing, terms, amounts, skies, look, facet, slot, mixed, target)
                glint = 0.0 if soft[k] else glint
            elif there >= 0:
                shown = mirror_unit_light(hit, weight, k, terms, fresnel, reference, axis)
            else:
                mirror_sky(hit, weight, k, terms, fresnel, axis, sky_map, radiance, target)
            if glint > 0:
                lobe = k, glint, alpha, surfaces.distribution[k], terms
                add_glint(hit, sun, lobe, fresnel, axis, block, target)
            if group > 0:
                fill_air_row(lights, step, group, step_of, here, width)
                _add_mirrored_light(own, terms * block, here, group, width, total)
            if there >= 0:
                place = _place(ray, rays.mirror_cell, rays.mirror_part, rays.mirror_here, rays.mirror_left)
                seen = rays.mirror_sun[ray], rays.mirror_sky[ray], place
                mirror_base(there, shown, seen, step, width, bases, probes, total)
        if ground:
            fill_air_row(lights, step, 0, step_of, here, width)
            _add_mirrored_light(plain, block, here, 0, width, total)


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
