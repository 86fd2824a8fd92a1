"""Mirror image along one ray: a base that stands there, or the sky.

Rough surfaces of vehicles show that base too, in place of the frame's mean light.
"""

import math
from typing import NamedTuple

import numba as nb
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.render.shading.diffuse import OPEN
from glintrack.render.shading.neighbours import through_air
from glintrack.render.shading.probe_light import off_surfaces, read_cell
from glintrack.render.shading.projection import OPEN_NODE
from glintrack.render.shading.rough import add_mirrored, fresnel_term, plane_of_incidence
from glintrack.render.sky import carried_north, look_up
from glintrack.stokes import axis_turn, rotate_qu


class Lights(NamedTuple):
    """What lights bases, `Light.lit`, and what of it `through_air` keeps for one airmass."""

    lit: Float[Array, "airmass row light channel"]
    step: int
    known_step: Int[Array, "row"]
    here: Float[Array, "row light channel"]
    width: int


@nb.njit(cache=True, forceinline=True)
def mirrored_once(hit, weight, optical, terms, surfaces, axis):
    """I, Q and U that a smooth surface mirrors of unpolarized light 1."""
    c_out, s_out = plane_of_incidence(hit.dx, hit.dy, hit.dz, hit.nx, hit.ny, hit.nz, axis)[3:]
    intensity, polarized = 0.0, 0.0
    for term in range(terms):
        m00, m01, _ = fresnel_term(surfaces.fresnel, optical, term, hit.cos_view)
        intensity += surfaces.reference[optical, term] * m00
        polarized += surfaces.reference[optical, term] * m01
    q, u = rotate_qu(polarized, 0.0, c_out, s_out)
    return weight * intensity, weight * q, weight * u


@nb.njit(cache=True, forceinline=True)
def mirror_base(hit, mirrored, rays, light, lights, scratch):
    """Add the base of what a surface shows, lit by sun, sky and surroundings.

    ``mirrored`` are I, Q and U that it mirrors of unpolarized light 1.
    """
    there, cell = int(rays.mirror_material[hit.ray]), rays.mirror_cell[hit.ray]
    base, around, total = scratch.base, scratch.around, scratch.total
    base[0] = rays.mirror_sun[hit.ray] / math.pi
    sky_view = rays.mirror_sky[hit.ray]
    if cell != OPEN:
        part, here = rays.mirror_part[hit.ray], rays.mirror_here[hit.ray]
        left, off = rays.mirror_left[hit.ray] / 255.0, off_surfaces(here, sky_view)
        read_cell((cell, part[0], part[1]), False, here, (off, off), rays.probe_cells, light.probes, around)
        scratch.faced[0] = 2.0
        base[1] = 0.0 if light.followed else (1.0 - sky_view) / math.pi
        for k in range(base.shape[0] - 2):
            base[2 + k] = left * around[k] / math.pi
    else:
        base[1] = (1.0 - sky_view) / math.pi
        for k in range(base.shape[0] - 2):
            base[2 + k] = sky_view / math.pi * light.irradiance[OPEN_NODE, k]
    here = lights.here
    through_air(lights.lit, lights.step, there, lights.known_step, here, lights.width)
    for c in range(lights.width):
        shining = 0.0
        for e in range(here.shape[1]):
            shining += base[e] * here[there, e, c]
        total[0, c] += mirrored[0] * shining
        total[1, c] += mirrored[1] * shining
        total[2, c] += mirrored[2] * shining


@nb.njit(cache=True, forceinline=True)
def mirror_sky(hit, weight, optical, terms, fresnel, axis, sky_map, radiance, mirrored):
    """Add the sky that a smooth surface shows, or the surroundings if it looks down."""
    dx, dy, dz, nx, ny, nz, cosine = hit.dx, hit.dy, hit.dz, hit.nx, hit.ny, hit.nz, hit.cos_view
    rx, ry, rz = dx + 2 * cosine * nx, dy + 2 * cosine * ny, dz + 2 * cosine * nz
    sx, sy, sz, c_out, s_out = plane_of_incidence(dx, dy, dz, nx, ny, nz, axis)
    block = 2 + radiance.shape[0]
    c_in, s_in = 1.0, 0.0
    if rz > 0:
        look_up(sky_map, rx, ry, rz, radiance)
        fx, fy, fz = carried_north(rx, ry, rz)
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
def sky_ray(dx, dy, dz, axis, sky_map, share, radiance, own):
    """Coefficients of a ray that looks at the sky."""
    look_up(sky_map, dx, dy, dz, radiance)
    fx, fy, fz = carried_north(dx, dy, dz)
    c, s = axis_turn(fx, fy, fz, axis[0], axis[1], axis[2], -dx, -dy, -dz)
    for k in range(2):
        own[k, 0], own[k, 1], own[k, 2] = 0.0, 0.0, 0.0
    for component in range(radiance.shape[0]):
        q, u = rotate_qu(radiance[component, 1], radiance[component, 2], c, s)
        own[2 + component, 0] = share * radiance[component, 0]
        own[2 + component, 1], own[2 + component, 2] = share * q, share * u
