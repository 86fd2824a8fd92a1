"""Interface of a surface along one ray: mirror image, lobe around it, and polarized first surfaces.

Polarization of a base by first surfaces of all tilts follows Umov's law.

    R_p = C exp(−tan α) ½(Rs − Rp)(α, n = 1.5) / (4 (cos θs + cos θv)),

α half the phase angle: polarized reflectance as Maignan et al. fitted it to PARASOL's measurements of land
(Eq. 21, with e^−NDVI in C). It does not depend on wavelength: degree times reflectance is constant, which is
Umov's law. Light is polarized across the plane of sun and look, and not at all toward the sun's direction.
Intensity stays that of the base. Only the sun's light is polarized, and only on directly visible surfaces.
The fit holds for all that a surface polarizes. The reflection of the sun by its interface's facets
(`rough.add_glint`) is therefore subtracted, down to 0. A sum cos θs + cos θv under ½, both near grazing,
without measurements, counts as ½.

References
----------
Maignan, Bréon, Fédèle and Bouvier, Remote Sensing of Environment 113, 2642 (2009).
"""

import math

import numba as nb
import numpy as np

from glintrack.render.light.lattice import OPEN
from glintrack.render.light.sky import LEVEL_NODE, NORMAL_NODES, look_up, north_axis, square_cell
from glintrack.render.shading.diffuse import blend_cell, fill_air_row, surface_gain
from glintrack.render.shading.materials import facet_lobe, fresnel
from glintrack.render.shading.rough import (
    ABOVE,
    BELOW,
    SKY,
    SUN,
    SUN_HALF_VECTOR_RADIUS,
    add_mirrored,
    fresnel_term,
    plane_of_incidence,
)
from glintrack.stokes import axis_turn, rotate_qu

CACHED_FACETS = 128  # a power of two; a row of a frame has more, several times each
_MIX_X, _MIX_Y, _MIX_Z = 40993.0, 79193.0, 15437.0  # spread the normals over the slots


@nb.njit(cache=True, fastmath=True, forceinline=True)
def facet_slot(nx, ny, nz, optical, look, at):
    """Slot of a facet's normal, class and look in `gather_around`, whose key is written; True if it is known.

    The next row meets the same facets.
    """
    row_low, _, column_low, _, _, columns = look
    place = float(row_low * columns + column_low)
    slot = int(abs(nx * _MIX_X + ny * _MIX_Y + nz * _MIX_Z) + optical * 11 + place * 5) & (CACHED_FACETS - 1)
    known = at[slot, 0] == optical and at[slot, 1] == place
    known = known and at[slot, 2] == nx and at[slot, 3] == ny and at[slot, 4] == nz
    at[slot, 0], at[slot, 1], at[slot, 2], at[slot, 3], at[slot, 4] = optical, place, nx, ny, nz
    return slot, known


@nb.njit(cache=True, fastmath=True, forceinline=True)
def gather_around(slot, normal, optical, terms, look, soft, first_row, gathered, facet):
    """Interpolate the table of rough reflection to the normal of a slot, at each of the four looks around."""
    row_low, _, column_low, _, rows, columns = look
    stride = 2 if soft else 1
    i, k, fx, fy = square_cell(normal[0], normal[1], normal[2], stride)
    w11 = np.float32(fx * fy)
    w10, w01 = np.float32(fx) - w11, np.float32(fy) - w11
    w00 = np.float32(1.0) - w10 - w01 - w11
    corner = i * NORMAL_NODES + k
    across = stride * NORMAL_NODES if fx > 0 else 0  # what has no part need not be in the table
    along = stride if fy > 0 else 0
    values = gathered.shape[1] * terms * min(columns, 2)  # rows of two looks side by side follow each other
    for near in range(2):
        node = min(row_low + near, rows - 1) * columns + column_low
        a, b = first_row[optical, corner, node], first_row[optical, corner + along, node]
        c, d = first_row[optical, corner + across, node], first_row[optical, corner + across + along, node]
        for x in range(values):
            low = w00 * gathered[a, x] + w01 * gathered[b, x]
            facet[slot, near, 0, x] = low + w10 * gathered[c, x] + w11 * gathered[d, x]


@nb.njit(cache=True, fastmath=True, forceinline=True)
def add_gathered(around, terms, amounts, skies, look, facet, slot, mixed, mirrored):
    """Interpolate between the looks around, and add the light of sun, surroundings and sky.

    ``around`` is the weight of the reflection, the result of `diffuse.mirror_place`, and the transmittance of
    the sun's light. [1] Return I, Q and U off surfaces of radiance 1, for Fresnel terms of some ``amounts``.
    """
    weight, (sky_view, off_mean), sunlight = around
    _, row_part, _, column_part, _, columns = look
    w11 = np.float32(weight * row_part * column_part)
    w10, w01 = np.float32(weight * row_part) - w11, np.float32(weight * column_part) - w11
    w00 = np.float32(weight) - w10 - w01 - w11
    sky, glint = np.float32(sky_view), np.float32(sunlight)
    below, above = np.float32(off_mean), np.float32((1.0 - sky_view) * off_mean)
    side, i, q, u = terms if columns > 1 else 0, 0.0, 0.0, 0.0
    for term in range(terms):
        for x in range(facet.shape[3]):
            low = w00 * facet[slot, 0, term, x] + w01 * facet[slot, 0, side + term, x]
            mixed[x] = low + w10 * facet[slot, 1, term, x] + w11 * facet[slot, 1, side + term, x]
        to = term * (2 + skies)
        for s in range(3):
            mirrored[to, s] += glint * mixed[3 * SUN + s]
            mirrored[to + 1, s] += above * mixed[3 * ABOVE + s] + below * mixed[3 * BELOW + s]
        for e in range(skies):
            for s in range(3):
                mirrored[to + 2 + e, s] += sky * mixed[3 * (SKY + e) + s]
        i += amounts[term] * ((1.0 - sky_view) * mixed[3 * ABOVE] + mixed[3 * BELOW])
        q += amounts[term] * ((1.0 - sky_view) * mixed[3 * ABOVE + 1] + mixed[3 * BELOW + 1])
        u += amounts[term] * ((1.0 - sky_view) * mixed[3 * ABOVE + 2] + mixed[3 * BELOW + 2])
    return i, q, u


@nb.njit(cache=True, fastmath=True, forceinline=True)
def set_path(where, path, share, width, total):
    """Begin with path radiance, interpolated between rows and columns of the frame."""
    row_low, row_part, column_low, column_part = where
    row_high = min(row_low + 1, path.shape[0] - 1)
    column_high = min(column_low + 1, path.shape[1] - 1)
    raised, right = np.float32(row_part), np.float32(share * column_part)
    left = np.float32(share) - right
    for s in range(3):
        for x in range(width):
            low, before = path[row_low, column_low, s, x], path[row_low, column_high, s, x]
            here = low + raised * (path[row_high, column_low, s, x] - low)
            after = before + raised * (path[row_high, column_high, s, x] - before)
            total[s, x] = left * here + right * after


@nb.njit(cache=True, forceinline=True)
def mirror_unit_light(hit, weight, optical, terms, fresnel, amounts, axis):
    """I, Q and U of unpolarized light 1 after reflection by a smooth surface."""
    c_out, s_out = plane_of_incidence(hit.dx, hit.dy, hit.dz, hit.nx, hit.ny, hit.nz, axis)[3:]
    intensity, polarized = 0.0, 0.0
    for term in range(terms):
        m00, m01, _ = fresnel_term(fresnel, optical, term, hit.cos_view)
        intensity += amounts[optical, term] * m00
        polarized += amounts[optical, term] * m01
    q, u = rotate_qu(polarized, 0.0, c_out, s_out)
    return weight * intensity, weight * q, weight * u


@nb.njit(cache=True, forceinline=True)
def mirror_base(there, mirrored, seen, step, width, bases, probes, total):
    """Add the mirrored base, lit by sun, sky and surroundings.

    ``mirrored`` are I, Q and U of unpolarized light 1 after the reflection. ``seen`` are `Hits.mirror_sun`,
    `Hits.mirror_sky` and the place of the mirrored surface of material ``there``.
    """
    sun, sky_view, place = seen
    base, around, here = bases.base, bases.around, bases.here
    base[0] = sun / math.pi
    if place.cell != OPEN:
        off = surface_gain(place.here, sky_view)
        blend_cell(place, False, place.here, (off, off), probes.cells, probes.lit, around)
        base[1] = 0.0 if probes.followed else (1.0 - sky_view) / math.pi
        for k in range(base.shape[0] - 2):
            base[2 + k] = place.left * around[k] / math.pi
    else:
        base[1] = (1.0 - sky_view) / math.pi
        for k in range(base.shape[0] - 2):
            base[2 + k] = sky_view / math.pi * probes.irradiance[LEVEL_NODE, k]
    fill_air_row(bases.lit, step, there, bases.step, here, width)
    for c in range(width):
        shining = 0.0
        for e in range(here.shape[1]):
            shining += base[e] * here[there, e, c]
        total[0, c] += mirrored[0] * shining
        total[1, c] += mirrored[1] * shining
        total[2, c] += mirrored[2] * shining


@nb.njit(cache=True, forceinline=True)
def mirror_sky(hit, weight, optical, terms, fresnel, axis, sky_map, radiance, mirrored):
    """Add the mirrored sky of a smooth surface, or the surroundings for a ray that goes down."""
    dx, dy, dz, nx, ny, nz, cosine = hit.dx, hit.dy, hit.dz, hit.nx, hit.ny, hit.nz, hit.cos_view
    rx, ry, rz = dx + 2 * cosine * nx, dy + 2 * cosine * ny, dz + 2 * cosine * nz
    sx, sy, sz, c_out, s_out = plane_of_incidence(dx, dy, dz, nx, ny, nz, axis)
    block = 2 + radiance.shape[0]
    c_in, s_in = 1.0, 0.0
    if rz > 0:
        look_up(sky_map, rx, ry, rz, radiance)
        fx, fy, fz = north_axis(rx, ry, rz)
        c_in, s_in = axis_turn(fx, fy, fz, sx, sy, sz, -rx, -ry, -rz)
    for term in range(terms):
        m00, m01, m22 = fresnel_term(fresnel, optical, term, cosine)
        first = term * block
        if rz > 0:
            add_mirrored(m00, m01, m22, c_in, s_in, c_out, s_out, weight, radiance, mirrored, first + 2)
        else:
            q, u = rotate_qu(m01, 0.0, c_out, s_out)
            mirrored[first + 1, 0] += weight * m00
            mirrored[first + 1, 1] += weight * q
            mirrored[first + 1, 2] += weight * u


@nb.njit(cache=True, forceinline=True)
def fill_sky_ray(dx, dy, dz, axis, sky_map, share, radiance, own):
    """Write the coefficients of a ray of look to the sky."""
    look_up(sky_map, dx, dy, dz, radiance)
    fx, fy, fz = north_axis(dx, dy, dz)
    c, s = axis_turn(fx, fy, fz, axis[0], axis[1], axis[2], -dx, -dy, -dz)
    for k in range(2):
        own[k, 0], own[k, 1], own[k, 2] = 0.0, 0.0, 0.0
    for component in range(radiance.shape[0]):
        q, u = rotate_qu(radiance[component, 1], radiance[component, 2], c, s)
        own[2 + component, 0] = share * radiance[component, 0]
        own[2 + component, 1], own[2 + component, 2] = share * q, share * u


INDEX, MIN_COSINE_SUM = 1.5, 0.5


@nb.njit(cache=True)
def polarized_reflectance(scale, cos_sun, cos_view, cos_half):
    """Polarized reflectance R_p, π times radiance over the sun's irradiance of the facet. [1]

    Parameters
    ----------
    scale
        C. [1]
    cos_sun, cos_view
        Of the angles of sun and look from the normal. [1]
    cos_half
        Of half the phase angle, α. [1]
    """
    c = min(max(cos_half, 1e-3), 1.0)
    tangent = math.sqrt(1.0 - c * c) / c
    _, polarized, _ = fresnel(c, INDEX, 0.0)
    return scale * math.exp(-tangent) * polarized / (4.0 * max(cos_sun + cos_view, MIN_COSINE_SUM))


@nb.njit(cache=True, forceinline=True)
def add_polarized(hit, lobe, scale, fresnel, reference, share, sun, axis, out):
    """Add Q and U per unit of the sun's irradiance to the head of ``out``.

    ``lobe`` is that of `rough.add_glint`, and ``scale`` the base's own polarization.
    """
    hx, hy, hz = sun[0] - hit.dx, sun[1] - hit.dy, sun[2] - hit.dz
    norm = 1.0 / math.sqrt(max(hx * hx + hy * hy + hz * hz, 1e-12))
    hx, hy, hz = hx * norm, hy * norm, hz * norm
    cos_half, mirrored = -(hit.dx * hx + hit.dy * hy + hit.dz * hz), 0.0
    k, weight, alpha, distribution, terms = lobe
    for term in range(terms):
        mirrored += reference[k, term] * fresnel_term(fresnel, k, term, cos_half)[1]
    facing, view = hit.nx * hx + hit.ny * hy + hit.nz * hz, max(hit.cos_view, 1e-3)
    wide = math.hypot(alpha, SUN_HALF_VECTOR_RADIUS)
    mirrored *= facet_lobe(distribution, facing, view, hit.cos_sun, wide) * weight
    whole = polarized_reflectance(scale, hit.cos_sun, hit.cos_view, cos_half) / math.pi
    strength = max(whole - mirrored, 0.0) * hit.cos_sun
    c_out, s_out = plane_of_incidence(hit.dx, hit.dy, hit.dz, hx, hy, hz, axis)[3:]
    q, u = rotate_qu(strength * share * hit.sunlight, 0.0, c_out, s_out)
    out[0, 1] += q
    out[0, 2] += u
