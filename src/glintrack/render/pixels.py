"""The kernel of `shade`: what each pixel's rays bring, channel by channel."""

import math
from functools import lru_cache
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from ..stokes import axis_turn, rotate_qu
from .contraction import OPEN_NODE
from .hits import Hits
from .neighbours import FINE_STEPS, add_gathered, add_path, gather_around, through_air
from .normals import NORMAL_NODES, square_cell
from .pbrdf import oren_nayar
from .rough import add_glint, add_mirrored, fresnel_term, plane_of_incidence
from .sky import carried_north, look_up
from .surfaces import MIRROR_ROUGHNESS, over_cosine

Array = np.ndarray
_LATTICE = 256  # cells of the mottle before it repeats: 1 km for the finer octave


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


@lru_cache(maxsize=1)
def mottle_lattice() -> Float[Array, "cell cell"]:
    """Even noise of zero mean for the mottle; the same in every frame."""
    return np.random.default_rng(5).uniform(-1.6, 1.6, (_LATTICE, _LATTICE)).astype(np.float32)


@nb.njit(cache=True)
def _mottled(contrast, lattice, point, ray):
    """Smooth value noise about 1 of variance ``contrast``²: patches and wear, on lattices of 4 m and 16 m."""
    if contrast == 0.0:
        return 1.0
    x, y, z = float(point[ray, 0]), float(point[ray, 1]), float(point[ray, 2])
    total = 0.0
    for octave in range(2):
        scale = 0.25 if octave == 0 else 0.0625
        px, py = (x + 0.37 * z) * scale + 1000.0, (y + 0.61 * z) * scale + 1000.0 + 77.0 * octave
        i, j = int(math.floor(px)), int(math.floor(py))
        fx, fy = px - i, py - j
        fx, fy = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy)
        i0, i1, j0, j1 = i & 255, (i + 1) & 255, j & 255, (j + 1) & 255
        low = lattice[i0, j0] + fy * (lattice[i0, j1] - lattice[i0, j0])
        high = lattice[i1, j0] + fy * (lattice[i1, j1] - lattice[i1, j0])
        total += low + fx * (high - low)
    return max(1.0 + contrast * total, 0.0)


@nb.njit(cache=True, forceinline=True)
def _air_step(dz, first, spacing, airmasses):
    """Fine step of the airmass along a ray that goes down."""
    node = (-1.0 / min(dz, -1e-6) - first) / spacing
    return int(min(max(node, 0.0), airmasses - 1.0) * FINE_STEPS + 0.5)


@nb.njit(nogil=True, cache=True)
def shade_pixels(start, stop, index, rays, surfaces, light, rough, sun, lattice, out):
    """Fill ``out`` (pixel, 3, channel) for rows ``start`` to ``stop`` of ``index``."""
    # tuples are taken apart once: each reading of a field counts a reference
    (_, frame_columns, n, axis, direction, point, normal, materials, vehicle_id, sun_visible, sky_view,
     sky_behind, mirror_material, mirror_sun, mirror_sky) = rays  # fmt: skip
    (optics, weights, mottle, groove, leaf, alphas, slopes, terms, fresnel, _, reference, albedo, lit_by_sun,
     lit_by_sky) = surfaces  # fmt: skip
    start_x, step_x, lit, mirrored, groups, sky_map, irradiance, path, path_grid = light
    rough_grid, first_row, gathered, soft = rough
    _, pr_low, pr_part, pc_low, pc_part = path_grid
    look, gr_low, gr_part, gc_low, gc_part = rough_grid
    looks, airmasses, columns, skies = look.shape[:2], lit.shape[0] - 1, frame_columns * n, sky_map.shape[2]
    share, block = 1.0 / (n * n), 2 + skies
    radiance, base = np.empty((skies, 3), np.float32), np.zeros(2 + irradiance.shape[1], np.float32)
    total, mixed = np.empty((3, lit.shape[3]), np.float32), np.empty(gathered.shape[1], np.float32)
    plain, own = np.empty((mirrored.shape[2], 3), np.float32), np.empty((mirrored.shape[2], 3), np.float32)
    # what neighbours share: light through the air of one step of airmass, path, and the table around a facet
    lit_step, lit_here = np.full(lit.shape[1], -1), np.empty(lit.shape[1:], np.float32)
    mirrored_step, mirrored_here = np.full(mirrored.shape[1], -1), np.empty(mirrored.shape[1:], np.float32)
    path_at, path_here = np.full(2, -1.0), np.empty((2, 3, lit.shape[3]), np.float32)
    at, facet = np.full(5, -2.0), np.empty((4, terms.max(), gathered.shape[1]), np.float32)
    for j in range(start, stop):
        _clear(total, 3)
        _clear(plain, block)
        step, ground = 0, 0
        row, column = index[j] // frame_columns * n, index[j] % frame_columns * n
        for sub in range(n * n):
            r, c = row + sub // n, column + sub % n
            ray = r * columns + c
            m = materials[ray]
            dx, dy, dz = float(direction[ray, 0]), float(direction[ray, 1]), float(direction[ray, 2])
            if m < 0:
                _sky_ray(dx, dy, dz, axis, sky_map, share, radiance, own)
                through_air(mirrored, airmasses * FINE_STEPS, 0, mirrored_step, mirrored_here)
                _add_mirrored_light(own, block, mirrored_here, 0, total)
                continue
            step = _air_step(dz, start_x, step_x, airmasses) if ground == 0 else step
            ground += 1
            nx, ny, nz = float(normal[ray, 0]), float(normal[ray, 1]), float(normal[ray, 2])
            view = -(dx * nx + dy * ny + dz * nz)
            sunward = sun[0] * nx + sun[1] * ny + sun[2] * nz
            sunlight, openness = float(sun_visible[ray]), float(sky_view[ray])
            contrast = mottle[m] if vehicle_id[ray] < 0 else 0.0
            scale = share / math.pi * _mottled(contrast, lattice, point, ray)
            ridges = _grooved(dx, dy, dz, view, sunward, sun, groove[m])
            _add_base(
                nx, ny, nz, view, sunward, sunlight, openness, sky_behind[ray], scale, ridges, m, leaf,
                lit_by_sun, lit_by_sky, irradiance, step, lit, lit_step, lit_here, base, total,
            )  # fmt: skip
            weight, k = weights[m] * share, optics[m]
            if weight == 0.0:
                continue
            group, target = groups[k], own if groups[k] > 0 else plain  # own: terms with spectra of their own
            _clear(own, terms[k] * block if group > 0 else 0)
            glint = weight * sunlight if sunward > 0 else 0.0
            if alphas[k] >= MIRROR_ROUGHNESS:
                gather_around(
                    nx, ny, nz, k, terms[k], looks, gr_low[r], gc_low[c], soft, first_row, gathered, at, facet
                )
                even, shining = weight * over_cosine(albedo, k, view), sunlight if glint > 0 else 0.0
                add_gathered(
                    even, openness, shining, terms[k], skies, gr_part[r], gc_part[c], facet, mixed, target
                )
                glint = 0.0 if soft[k] else glint
            else:
                there = mirror_material[ray], mirror_sun[ray], mirror_sky[ray]
                _add_mirror(
                    dx, dy, dz, nx, ny, nz, view, weight, k, terms[k], fresnel, reference, axis, *there,
                    sky_map, radiance, irradiance, step, lit, lit_step, lit_here, base, total, target,
                )  # fmt: skip
            if glint > 0:
                lobe = k, glint, alphas[k], slopes[k], terms[k]
                add_glint(dx, dy, dz, nx, ny, nz, sun, *lobe, fresnel, axis, block, target)
            if group > 0:
                through_air(mirrored, step, group, mirrored_step, mirrored_here)
                _add_mirrored_light(own, terms[k] * block, mirrored_here, group, total)
        if ground > 0:
            through_air(mirrored, step, 0, mirrored_step, mirrored_here)
            _add_mirrored_light(plain, block, mirrored_here, 0, total)
            where = pr_low[row], pr_part[row], pc_low[column], pc_part[column]
            add_path(where, path, share * ground, path_at, path_here, total)
        _copy(total, out, j)


@nb.njit(cache=True, forceinline=True)
def _copy(total, out, j):
    for s in range(3):
        for channel in range(out.shape[2]):
            out[j, s, channel] = total[s, channel]


@nb.njit(cache=True, forceinline=True)
def _clear(values, rows):
    for row in range(rows):
        for column in range(values.shape[1]):
            values[row, column] = 0.0


@nb.njit(cache=True, forceinline=True)
def _add_base(
    nx, ny, nz, view, sunward, sunlight, openness, open_behind, scale, ridges, m, leaf, lit_by_sun,
    lit_by_sky, irradiance, step, lit, lit_step, lit_here, base, total,
):  # fmt: skip
    """Add what the base scatters, and what a leaf lets through from behind."""
    base[0] = 0.0
    if sunward > 0 and sunlight > 0:
        enter = over_cosine(lit_by_sun, m, view) * over_cosine(lit_by_sun, m, sunward)
        base[0] = scale * ridges * enter * sunward * sunlight
    _fill_irradiance(nx, ny, nz, openness, scale * over_cosine(lit_by_sky, m, view), irradiance, base)
    through_air(lit, step, m, lit_step, lit_here)
    _add_lit(base, lit_here, m, total)
    if leaf[m]:
        behind = m + leaf.shape[0]
        base[0] = scale * -sunward * sunlight if sunward < 0 else 0.0
        _fill_irradiance(-nx, -ny, -nz, float(open_behind), scale, irradiance, base)
        through_air(lit, step, behind, lit_step, lit_here)
        _add_lit(base, lit_here, behind, total)


@nb.njit(cache=True, forceinline=True)
def _grooved(dx, dy, dz, view, sunward, sun, slope_rad):
    """Oren–Nayar's factor of the sun's light."""
    if slope_rad == 0 or sunward <= 0:
        return 1.0
    across = -(dx * sun[0] + dy * sun[1] + dz * sun[2]) - view * sunward
    length = math.sqrt(max((1.0 - view * view) * (1.0 - sunward * sunward), 1e-12))
    return oren_nayar(view, sunward, across / length, slope_rad)


@nb.njit(cache=True, fastmath=True, forceinline=True)
def _fill_irradiance(nx, ny, nz, openness, scale, irradiance, base):
    """Light from the surroundings and the sky onto a facet: ``base[1:]``."""
    base[1] = scale * (1.0 - 0.5 * (1.0 + nz) * openness)
    scale = np.float32(scale * openness)
    if nz > 0.99999:
        for k in range(irradiance.shape[1]):
            base[2 + k] = scale * irradiance[OPEN_NODE, k]
        return
    i, j, fx, fy = square_cell(nx, ny, nz, 1)
    corner = i * NORMAL_NODES + j
    after = corner + NORMAL_NODES
    over, up = np.float32(fx), np.float32(fy)
    w11 = scale * over * up
    w10, w01 = scale * over - w11, scale * up - w11
    w00 = scale - w10 - w01 - w11
    for k in range(irradiance.shape[1]):
        low = w00 * irradiance[corner, k] + w01 * irradiance[corner + 1, k]
        base[2 + k] = low + w10 * irradiance[after, k] + w11 * irradiance[after + 1, k]


@nb.njit(cache=True, fastmath=True, forceinline=True)
def _add_lit(base, lights, row, total):
    """Add a base's light, which is not polarized."""
    for e in range(lights.shape[1]):
        weight = base[e]
        if weight == 0.0:
            continue
        for x in range(total.shape[1]):
            total[0, x] += weight * lights[row, e, x]


@nb.njit(cache=True, fastmath=True, forceinline=True)
def _add_mirrored_light(mirrored, count, lights, row, total):
    """Add what mirrored coefficients bring in each channel."""
    for e in range(count):
        i, q, u = mirrored[e, 0], mirrored[e, 1], mirrored[e, 2]
        if i == 0.0 and q == 0.0 and u == 0.0:
            continue
        for x in range(total.shape[1]):
            light = lights[row, e, x]
            total[0, x] += i * light
            total[1, x] += q * light
            total[2, x] += u * light


@nb.njit(cache=True, forceinline=True)
def _add_mirror(
    dx, dy, dz, nx, ny, nz, cosine, weight, optical, terms, fresnel, reference, axis, there, sunlight,
    openness, sky_map, radiance, irradiance, step, lit, lit_step, lit_here, base, total, mirrored,
):  # fmt: skip
    """Add what a smooth surface shows: something that stands there, or the sky."""
    if there >= 0:
        _mirror_base(
            dx, dy, dz, nx, ny, nz, cosine, weight, optical, terms, fresnel, reference, axis, there, sunlight,
            openness, irradiance, step, lit, lit_step, lit_here, base, total,
        )  # fmt: skip
    else:
        _mirror_sky(
            dx, dy, dz, nx, ny, nz, cosine, weight, optical, terms, fresnel, axis, sky_map, radiance, mirrored
        )


@nb.njit(cache=True)
def _mirror_base(
    dx, dy, dz, nx, ny, nz, cosine, weight, optical, terms, fresnel, reference, axis, there, sunlight,
    openness, irradiance, step, lit, lit_step, lit_here, base, total,
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
    through_air(lit, step, there, lit_step, lit_here)
    for c in range(total.shape[1]):
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
    _clear(own, 2)
    for component in range(radiance.shape[0]):
        q, u = rotate_qu(radiance[component, 1], radiance[component, 2], c, s)
        own[2 + component, 0] = share * radiance[component, 0]
        own[2 + component, 1], own[2 + component, 2] = share * q, share * u
