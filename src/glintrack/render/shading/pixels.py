"""The kernel of `shade`: what each pixel's rays bring, channel by channel."""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.arrays import Array
from glintrack.render.hits import Hits
from glintrack.render.rays.borrowed import borrowed
from glintrack.render.shading.contraction import OPEN_NODE
from glintrack.render.shading.incidence import (
    DX,
    DY,
    DZ,
    INCIDENCE_FIELDS,
    MOST,
    MOTTLE,
    NX,
    NY,
    NZ,
    SUNWARD,
    TURN_C,
    TURN_S,
    VIEW,
    meet_rays,
)  # fmt: skip
from glintrack.render.shading.neighbours import (
    FACETS_KEPT,
    FINE_STEPS,
    add_gathered,
    gather_around,
    set_path,
    through_air,
)
from glintrack.render.shading.normals import NORMAL_NODES, square_cell
from glintrack.render.shading.pbrdf import oren_nayar
from glintrack.render.shading.rough import add_glint, add_mirrored, fresnel_term, plane_of_incidence
from glintrack.render.shading.surfaces import MIRROR_ROUGHNESS
from glintrack.render.sky import carried_north, look_up
from glintrack.stokes import axis_turn, rotate_qu


class Rays(NamedTuple):
    """The fields of `Hits` that the kernel reads."""

    rows: int
    columns: int
    oversampling: int
    axis: Float[Array, "3"]
    direction: Float[Array, "ray 3"]
    point: Float[Array, "ray 3"]
    normal: Float[Array, "ray 3"]
    material: Int[Array, "ray"]
    vehicle_id: Int[Array, "ray"]
    sun_visible: Float[Array, "ray"]
    sky_view: Float[Array, "ray"]
    sky_behind: Float[Array, "ray"]
    mirror_material: Int[Array, "ray"]
    mirror_sun: Float[Array, "ray"]
    mirror_sky: Float[Array, "ray"]


def unpack_rays(hits: Hits) -> Rays:
    """Plain arrays for the kernel."""
    fields = (np.ascontiguousarray(getattr(hits, name)) for name in Rays._fields[4:])
    axis = np.asarray(hits.detector_axis, dtype=float)
    return Rays(hits.rows, hits.columns, hits.oversampling, axis, *fields)


class Scratch(NamedTuple):
    """What a kernel writes to on its way; most of it is kept from one element to the next.

    Parameters
    ----------
    radiance
        Of the sky components in one direction.
    base
        What lights a base: sun, surroundings, and each diffuse component.
    faced, around
        Normal of the facet met last, and the irradiance of each diffuse component on it.
    total
        Stokes radiance of one element by channel.
    plain, own
        Mirrored components without dispersion, and with spectra of their own.
    met
        See `incidence`.
    lit_step, lit_here, mirrored_step, mirrored_here, path_at, path_here, at, facet, mixed
        See `neighbours`.
    """

    radiance: Float[Array, "sky_component 3"]
    base: Float[Array, "light"]
    faced: Float[Array, "3"]
    around: Float[Array, "diffuse_component"]
    total: Float[Array, "3 channel"]
    plain: Float[Array, "component 3"]
    own: Float[Array, "component 3"]
    met: Float[Array, "value"]
    lit_step: Int[Array, "row"]
    lit_here: Float[Array, "row light channel"]
    mirrored_step: Int[Array, "group"]
    mirrored_here: Float[Array, "group component channel"]
    path_at: Float[Array, "2"]
    path_here: Float[Array, "2 3 channel"]
    at: Float[Array, "slot 5"]
    facet: Float[Array, "slot 2 look_and_term value"]
    mixed: Float[Array, "value"]


@nb.njit(nogil=True, cache=True)
def shade_pixels(start, stop, index, rays, surfaces, light, rough, sun, lattice, out):
    """Fill ``out`` (pixel, 3, channel) for rows ``start`` to ``stop`` of ``index``."""
    lit, mirrored, skies, width = light.lit, light.mirrored, light.sky_map.shape[2], light.lit.shape[3]
    scratch = Scratch(
        np.empty((skies, 3), np.float32),
        np.zeros(2 + light.irradiance.shape[1], np.float32),
        np.full(3, 2.0),
        np.empty(light.irradiance.shape[1], np.float32),
        np.empty((3, width), np.float32),
        np.empty((mirrored.shape[2], 3), np.float32),
        np.empty((mirrored.shape[2], 3), np.float32),
        np.empty(INCIDENCE_FIELDS * MOST, np.float32),
        np.full(lit.shape[1], -1),
        np.empty(lit.shape[1:], np.float32),
        np.full(mirrored.shape[1], -1),
        np.empty(mirrored.shape[1:], np.float32),
        np.full(2, -1.0),
        np.empty((2, 3, width), np.float32),
        np.full((FACETS_KEPT, 5), -2.0),
        np.empty((FACETS_KEPT, 2, 2 * surfaces.terms.max(), rough.gathered.shape[1]), np.float32),
        np.empty(rough.gathered.shape[1], np.float32),
    )
    if width == 1 and rays.oversampling == 1:  # the usual case: a compiler then knows its loops' one turn
        _shade_rows(start, stop, index, rays, surfaces, light, rough, sun, lattice, scratch, 1, 1, out)
    else:
        _shade_rows(
            start, stop, index, rays, surfaces, light, rough, sun, lattice, scratch, rays.oversampling, width,
            out,
        )  # fmt: skip


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _shade_rows(start, stop, index, rays, surfaces, light, rough, sun, lattice, scratch, n, width, out):
    index, sun, lattice, out = borrowed(index), borrowed(sun), borrowed(lattice), borrowed(out)
    rays, surfaces, light = borrowed(rays), borrowed(surfaces), borrowed(light)
    rough, scratch = borrowed(rough), borrowed(scratch)
    (_, frame_columns, _, axis, direction, point, normal, materials, vehicle_id, sun_visible, sky_view,
     sky_behind, _, _, _) = rays  # fmt: skip
    _, _, mottle, groove, leaf, _, _, _, _, _, _, _, at_angle = surfaces
    start_x, step_x, lit, mirrored, _, sky_map, irradiance, path, path_grid = light
    _, pr_low, pr_part, pc_low, pc_part = path_grid
    (radiance, base, faced, around, total, plain, own, met, lit_step, lit_here, mirrored_step, mirrored_here,
     path_at, path_here, _, _, _) = scratch  # fmt: skip
    airmasses, columns, skies = lit.shape[0] - 1, frame_columns * n, sky_map.shape[2]
    share, block = 1.0 / (n * n), 2 + skies
    line, met_from, met_to = start * n * n, 0, 0
    for j in range(start, stop):
        row = index[j] // frame_columns
        column = (index[j] - row * frame_columns) * n
        row *= n
        _clear(plain, block, 3)
        _clear(total, 3, width)
        step, (ground, first) = 0, _rays_that_end(materials, row, column, columns, n)
        if ground > 0:
            step = _air_step(float(direction[first, 2]), start_x, step_x, airmasses)
            where = pr_low[row], pr_part[row], pc_low[column], pc_part[column]
            set_path(where, path, share * ground, path_at, path_here, width, total)
        for sub in range(n * n):
            below = sub // n if n > 1 else 0
            r, c = row + below, column + sub - below * n
            m, ray = materials[r * columns + c], r * columns + c
            if line >= met_to:
                met_from, met_to = line, min(line + MOST, stop * n * n)
                fields = direction, point, normal, materials, vehicle_id
                meet_rays(met_from, met_to, index, n, frame_columns, fields, mottle, sun, axis, lattice, met)
            at_ray = line - met_from
            line += 1
            dx, dy, dz = float(met[DX + at_ray]), float(met[DY + at_ray]), float(met[DZ + at_ray])
            if m < 0:
                _sky_ray(dx, dy, dz, axis, sky_map, share, radiance, own)
                through_air(mirrored, airmasses * FINE_STEPS, 0, mirrored_step, mirrored_here, width)
                _add_mirrored_light(own, block, mirrored_here, 0, width, total)
                continue
            nx, ny, nz = float(met[NX + at_ray]), float(met[NY + at_ray]), float(met[NZ + at_ray])
            view, sunward = float(met[VIEW + at_ray]), float(met[SUNWARD + at_ray])
            sunlight, openness = float(sun_visible[ray]), float(sky_view[ray])
            scale = share / math.pi * met[MOTTLE + at_ray]
            enter, even, shine, degree = _seen_at(at_angle, m, *_between_cosines(view, at_angle))
            ridges = _grooved(dx, dy, dz, view, sunward, sun, groove[m])
            _add_base(
                nx, ny, nz, sunward, sunlight, openness, float(sky_behind[ray]), scale, ridges * enter, even,
                -degree * met[TURN_C + at_ray], degree * met[TURN_S + at_ray], m, leaf, at_angle, irradiance,
                faced, around, step, lit, lit_step, lit_here, base, width, total,
            )  # fmt: skip
            hit = dx, dy, dz, nx, ny, nz, view, sunward, sunlight, openness
            _add_interface(
                m, ray, r, c, hit, shine, share, step, width, rays, surfaces, light, rough, sun, scratch
            )
        if ground > 0:
            through_air(mirrored, step, 0, mirrored_step, mirrored_here, width)
            _add_mirrored_light(plain, block, mirrored_here, 0, width, total)
        _copy(total, out, j)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _add_interface(m, ray, r, c, hit, shine, share, step, width, rays, surfaces, light, rough, sun, scratch):
    """Add what the interface of a surface mirrors: to ``plain``, or at once if its terms have spectra."""
    optics, weights, _, _, _, alphas, slopes, counts, fresnel, _, reference, _, _ = surfaces
    _, _, lit, mirrored, groups, sky_map, irradiance, _, _ = light
    (radiance, base, _, _, total, plain, own, _, lit_step, lit_here, mirrored_step, mirrored_here, _, _, at,
     facet, mixed) = scratch  # fmt: skip
    dx, dy, dz, nx, ny, nz, view, sunward, sunlight, openness = hit
    weight, k = weights[m] * share, optics[m]
    if weight == 0.0:
        return
    terms, block, group = counts[k], 2 + sky_map.shape[2], groups[k]
    target = own if group > 0 else plain
    _clear(own, terms * block if group > 0 else 0, 3)
    glint = weight * sunlight if sunward > 0 else 0.0
    if alphas[k] >= MIRROR_ROUGHNESS:
        slot = gather_around(nx, ny, nz, k, terms, r, c, rough, at, facet)
        shining = sunlight if glint > 0 else 0.0
        add_gathered(
            share * shine, openness, shining, terms, sky_map.shape[2], r, c, rough, facet, slot, mixed, target
        )
        glint = 0.0 if rough.soft[k] else glint
    else:
        _add_mirror(
            dx, dy, dz, nx, ny, nz, view, weight, k, terms, fresnel, reference, rays.axis,
            rays.mirror_material[ray], rays.mirror_sun[ray], rays.mirror_sky[ray], sky_map, radiance,
            irradiance, step, lit, lit_step, lit_here, base, width, total, target,
        )  # fmt: skip
    if glint > 0:
        lobe = k, glint, alphas[k], slopes[k], terms
        add_glint(dx, dy, dz, nx, ny, nz, sun, *lobe, fresnel, rays.axis, block, target)
    if group > 0:
        through_air(mirrored, step, group, mirrored_step, mirrored_here, width)
        _add_mirrored_light(own, terms * block, mirrored_here, group, width, total)


@nb.njit(cache=True, forceinline=True)
def _rays_that_end(materials, row, column, columns, n):
    """How many of an element's rays meet a surface, and the first of them."""
    count, first = 0, 0
    for r in range(row, row + n):
        for ray in range(r * columns + column, r * columns + column + n):
            if materials[ray] >= 0:
                if count == 0:
                    first = ray
                count += 1
    return count, first


@nb.njit(cache=True, forceinline=True)
def _air_step(dz, first, spacing, airmasses):
    """Fine step of the airmass along a ray that goes down."""
    node = (-1.0 / min(dz, -1e-6) - first) / spacing
    return int(min(max(node, 0.0), airmasses - 1.0) * FINE_STEPS + 0.5)


@nb.njit(cache=True, forceinline=True)
def _add_base(
    nx, ny, nz, sunward, sunlight, openness, open_behind, scale, enter, even, q, u, m, leaf, at_angle,
    irradiance, faced, around, step, lit, lit_step, lit_here, base, width, total,
):  # fmt: skip
    """Add what the base scatters, and what a leaf lets through from behind."""
    if nx != faced[0] or ny != faced[1] or nz != faced[2]:
        _fill_irradiance(nx, ny, nz, irradiance, around)
        faced[0], faced[1], faced[2] = nx, ny, nz
    base[0] = 0.0
    if sunward > 0 and sunlight > 0:
        leave, _, _, _ = _seen_at(at_angle, m, *_between_cosines(sunward, at_angle))
        base[0] = scale * enter * leave * sunward * sunlight
    _set_diffuse(nz, openness, scale * even, around, base)
    through_air(lit, step, m, lit_step, lit_here, width)
    _add_lit(base, lit_here, m, q, u, width, total)
    if leaf[m]:
        behind = m + leaf.shape[0]
        base[0] = scale * -sunward * sunlight if sunward < 0 else 0.0
        _fill_irradiance(-nx, -ny, -nz, irradiance, around)
        faced[0] = 2.0
        _set_diffuse(-nz, open_behind, scale, around, base)
        through_air(lit, step, behind, lit_step, lit_here, width)
        _add_lit(base, lit_here, behind, q, u, width, total)


@nb.njit(cache=True, forceinline=True)
def _copy(total, out, j):
    for s in range(3):
        for channel in range(out.shape[2]):
            out[j, s, channel] = total[s, channel]


@nb.njit(cache=True, forceinline=True)
def _clear(values, rows, columns):
    for row in range(rows):
        for column in range(columns):
            values[row, column] = 0.0


@nb.njit(cache=True, forceinline=True)
def _between_cosines(cosine, tables):
    """Node of the tables over `COSINES` before a cosine, and how far on toward the next."""
    x = min(max(cosine, 0.0), 1.0) * (tables.shape[1] - 1)
    node = min(int(x), tables.shape[1] - 2)
    return node, np.float32(x - node)


@nb.njit(cache=True, forceinline=True)
def _seen_at(at_angle, m, node, part):
    """The four of `Surfaces.at_angle` between two nodes."""
    a, b, c, d = at_angle[m, node, 0], at_angle[m, node, 1], at_angle[m, node, 2], at_angle[m, node, 3]
    return (
        a + part * (at_angle[m, node + 1, 0] - a),
        b + part * (at_angle[m, node + 1, 1] - b),
        c + part * (at_angle[m, node + 1, 2] - c),
        d + part * (at_angle[m, node + 1, 3] - d),
    )


@nb.njit(cache=True, forceinline=True)
def _grooved(dx, dy, dz, view, sunward, sun, slope_rad):
    """Oren–Nayar's factor of the sun's light."""
    if slope_rad == 0 or sunward <= 0:
        return 1.0
    across = -(dx * sun[0] + dy * sun[1] + dz * sun[2]) - view * sunward
    length = math.sqrt(max((1.0 - view * view) * (1.0 - sunward * sunward), 1e-12))
    return oren_nayar(view, sunward, across / length, slope_rad)


@nb.njit(cache=True, fastmath=True, forceinline=True)
def _fill_irradiance(nx, ny, nz, irradiance, around):
    """Irradiance of each diffuse component on a facet in the open."""
    if nz > 0.99999:
        for k in range(irradiance.shape[1]):
            around[k] = irradiance[OPEN_NODE, k]
        return
    i, j, fx, fy = square_cell(nx, ny, nz, 1)
    corner = i * NORMAL_NODES + j
    after = corner + NORMAL_NODES
    over, up = np.float32(fx), np.float32(fy)
    w11 = over * up
    w10, w01 = over - w11, up - w11
    w00 = np.float32(1.0) - w10 - w01 - w11
    for k in range(irradiance.shape[1]):
        low = w00 * irradiance[corner, k] + w01 * irradiance[corner + 1, k]
        around[k] = low + w10 * irradiance[after, k] + w11 * irradiance[after + 1, k]


@nb.njit(cache=True, fastmath=True, forceinline=True)
def _set_diffuse(nz, openness, scale, around, base):
    """Light from the surroundings and the sky onto a facet: ``base[1:]``."""
    base[1] = scale * (1.0 - 0.5 * (1.0 + nz) * openness)
    open_sky = np.float32(scale * openness)
    for k in range(around.shape[0]):
        base[2 + k] = open_sky * around[k]


@nb.njit(cache=True, fastmath=True, forceinline=True)
def _add_lit(base, lights, row, q, u, width, total):
    """Add a base's light; ``q`` and ``u`` are what of it is polarized, the same in every channel."""
    last = lights.shape[1] - 1
    for e in range(0, lights.shape[1], 4):  # four at a time: sums are read and written a quarter as often
        e1, e2, e3 = min(e + 1, last), min(e + 2, last), min(e + 3, last)
        a = base[e]
        b = base[e1] if e1 > e else np.float32(0.0)
        c = base[e2] if e2 > e1 else np.float32(0.0)
        d = base[e3] if e3 > e2 else np.float32(0.0)
        for x in range(width):
            near = a * lights[row, e, x] + b * lights[row, e1, x]
            light = near + c * lights[row, e2, x] + d * lights[row, e3, x]
            total[0, x] += light
            total[1, x] += q * light
            total[2, x] += u * light


@nb.njit(cache=True, fastmath=True, forceinline=True)
def _add_mirrored_light(mirrored, count, lights, row, width, total):
    """Add what mirrored coefficients bring in each channel."""
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


@nb.njit(cache=True, forceinline=True)
def _add_mirror(
    dx, dy, dz, nx, ny, nz, cosine, weight, optical, terms, fresnel, reference, axis, there, sunlight,
    openness, sky_map, radiance, irradiance, step, lit, lit_step, lit_here, base, width, total, mirrored,
):  # fmt: skip
    """Add what a smooth surface shows: something that stands there, or the sky."""
    if there >= 0:
        _mirror_base(
            dx, dy, dz, nx, ny, nz, cosine, weight, optical, terms, fresnel, reference, axis, there, sunlight,
            openness, irradiance, step, lit, lit_step, lit_here, base, width, total,
        )  # fmt: skip
    else:
        _mirror_sky(
            dx, dy, dz, nx, ny, nz, cosine, weight, optical, terms, fresnel, axis, sky_map, radiance, mirrored
        )


@nb.njit(cache=True)
def _mirror_base(
    dx, dy, dz, nx, ny, nz, cosine, weight, optical, terms, fresnel, reference, axis, there, sunlight,
    openness, irradiance, step, lit, lit_step, lit_here, base, width, total,
):  # fmt: skip
    """Add the base of what a smooth surface shows, lit by sun, sky and surroundings."""
    _, _, _, c_out, s_out = plane_of_incidence(dx, dy, dz, nx, ny, nz, axis)
    intensity, polarized = 0.0, 0.0
    for term in range(terms):
        m00, m01, _ = fresnel_term(fresnel, optical, term, cosine)
        intensity += reference[optical, term] * m00
        polarized += reference[optical, term] * m01
    q, u = rotate_qu(polarized, 0.0, c_out, s_out)
    base[0] = sunlight / math.pi
    base[1] = (1.0 - openness) / math.pi
    for k in range(irradiance.shape[1]):
        base[2 + k] = openness / math.pi * irradiance[OPEN_NODE, k]
    through_air(lit, step, there, lit_step, lit_here, width)
    for c in range(width):
        shown = 0.0
        for e in range(lit_here.shape[1]):
            shown += base[e] * lit_here[there, e, c]
        total[0, c] += weight * intensity * shown
        total[1, c] += weight * q * shown
        total[2, c] += weight * u * shown


@nb.njit(cache=True)
def _mirror_sky(
    dx, dy, dz, nx, ny, nz, cosine, weight, optical, terms, fresnel, axis, sky_map, radiance, mirrored
):
    """Add the sky that a smooth surface shows, or the surroundings if it looks down."""
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


@nb.njit(cache=True)
def _sky_ray(dx, dy, dz, axis, sky_map, share, radiance, own):
    """Coefficients of a ray that looks at the sky."""
    look_up(sky_map, dx, dy, dz, radiance)
    fx, fy, fz = carried_north(dx, dy, dz)
    c, s = axis_turn(fx, fy, fz, axis[0], axis[1], axis[2], -dx, -dy, -dz)
    _clear(own, 2, 3)
    for component in range(radiance.shape[0]):
        q, u = rotate_qu(radiance[component, 1], radiance[component, 2], c, s)
        own[2 + component, 0] = share * radiance[component, 0]
        own[2 + component, 1], own[2 + component, 2] = share * q, share * u
