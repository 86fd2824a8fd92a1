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
from .normals import NORMAL_NODES, square_cell
from .pbrdf import oren_nayar
from .rough import ABOVE, BELOW, SKY, SUN, add_glint, add_mirrored, fresnel_term, plane_of_incidence
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
def _noise(lattice, point, ray):
    """Smooth value noise of unit variance, about: patches and wear, on lattices of 4 m and 16 m."""
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
    return total


@nb.njit(nogil=True, cache=True)
def shade_pixels(start, stop, index, rays, surfaces, light, rough, sun, lattice, out):
    """Fill ``out`` (pixel, 3, channel) for rows ``start`` to ``stop`` of ``index``."""
    # tuples are taken apart once: each reading of a field counts a reference
    (_, frame_columns, n, axis, direction, point, normal, materials, vehicle_id, sun_visible, sky_view,
     mirror_material, mirror_sun, mirror_sky) = rays  # fmt: skip
    (optics, weights, mottle, groove, leaf, alphas, slopes, terms, fresnel, _, reference, albedo, lit_by_sun,
     lit_by_sky) = surfaces  # fmt: skip
    start_x, step_x, lit, mirrored, groups, sky_map, irradiance, path, path_grid = light
    rough_grid, first_row, gathered, soft = rough
    _, pr_low, pr_part, pc_low, pc_part = path_grid
    look, gr_low, gr_part, gc_low, gc_part = rough_grid
    looks, airmasses, columns, skies = look.shape[:2], lit.shape[0] - 1, frame_columns * n, sky_map.shape[2]
    share, block = 1.0 / (n * n), 2 + skies
    radiance, base = np.empty((skies, 3), np.float32), np.empty(lit.shape[2], np.float32)
    plain, own = np.empty((mirrored.shape[2], 3), np.float32), np.empty((mirrored.shape[2], 3), np.float32)
    total = np.empty((3, out.shape[2]), np.float32)
    for j in range(start, stop):
        total[:] = 0.0
        plain[:] = 0.0
        node, part, ground = 0, 0.0, 0
        row, column = index[j] // frame_columns * n, index[j] % frame_columns * n
        for sub in range(n * n):
            r, c = row + sub // n, column + sub % n
            ray = r * columns + c
            m = materials[ray]
            dx, dy, dz = float(direction[ray, 0]), float(direction[ray, 1]), float(direction[ray, 2])
            if m < 0:
                _sky_ray(dx, dy, dz, axis, sky_map, share, radiance, own)
                _add_mirrored_light(own, block, mirrored, airmasses, airmasses, 0, 0.0, total)
                continue
            if ground == 0:
                x = min(max((-1.0 / min(dz, -1e-6) - start_x) / step_x, 0.0), airmasses - 1.000001)
                node, part = int(x), x - int(x)
            ground += 1
            nx, ny, nz = float(normal[ray, 0]), float(normal[ray, 1]), float(normal[ray, 2])
            view = -(dx * nx + dy * ny + dz * nz)
            sunward = sun[0] * nx + sun[1] * ny + sun[2] * nz
            sunlight, openness = float(sun_visible[ray]), float(sky_view[ray])
            scale = share / math.pi
            if mottle[m] > 0 and vehicle_id[ray] < 0:
                scale *= max(1.0 + mottle[m] * _noise(lattice, point, ray), 0.0)
            ridged = groove[m] > 0 and sunward > 0
            ridges = _grooved(dx, dy, dz, view, sunward, sun, groove[m]) if ridged else 1.0
            _add_base(
                nx, ny, nz, view, sunward, sunlight, openness, scale, ridges, m, leaf, lit_by_sun, lit_by_sky,
                irradiance, lit, node, part, base, total,
            )  # fmt: skip
            weight, k = weights[m] * share, optics[m]
            if weight == 0.0:
                continue
            group, alpha, glint = groups[k], alphas[k], sunward > 0 and sunlight > 0
            target = own if group > 0 else plain
            own[:] = 0.0
            if alpha >= MIRROR_ROUGHNESS:
                even = weight * over_cosine(albedo, k, view)
                _add_gathered(
                    nx, ny, nz, k, even, openness, sunlight if glint and soft[k] else 0.0, terms[k], skies,
                    looks, gr_low[r], gr_part[r], gc_low[c], gc_part[c], soft, first_row, gathered, target,
                )  # fmt: skip
                glint = glint and not soft[k]
            elif mirror_material[ray] >= 0:
                _mirror_base(
                    dx, dy, dz, nx, ny, nz, view, weight, k, terms[k], fresnel, reference, axis,
                    mirror_material[ray], mirror_sun[ray], mirror_sky[ray], irradiance, lit, node, part, base,
                    total,
                )  # fmt: skip
            else:
                _mirror_sky(
                    dx, dy, dz, nx, ny, nz, view, weight, k, terms[k], fresnel, axis, sky_map, radiance,
                    target,
                )  # fmt: skip
            if glint:
                add_glint(
                    dx, dy, dz, nx, ny, nz, sun, k, weight * sunlight, alpha, slopes[k], terms[k], fresnel,
                    axis, block, target,
                )  # fmt: skip
            if group > 0:
                _add_mirrored_light(own, terms[k] * block, mirrored, node, node + 1, group, part, total)
        if ground > 0:
            _add_mirrored_light(plain, block, mirrored, node, node + 1, 0, part, total)
            _add_path(pr_low[row], pr_part[row], pc_low[column], pc_part[column], path, share * ground, total)
        out[j] = total


@nb.njit(cache=True, forceinline=True)
def _add_base(
    nx, ny, nz, view, sunward, sunlight, openness, scale, ridges, m, leaf, lit_by_sun, lit_by_sky, irradiance,
    lit, node, part, base, total,
):  # fmt: skip
    """Add what the base scatters, and what a leaf lets through from behind."""
    base[0] = 0.0
    if sunward > 0 and sunlight > 0:
        enter = over_cosine(lit_by_sun, m, view) * over_cosine(lit_by_sun, m, sunward)
        base[0] = scale * ridges * enter * sunward * sunlight
    _fill_irradiance(nx, ny, nz, openness, scale * over_cosine(lit_by_sky, m, view), irradiance, base)
    _add_lit(base, lit, node, m, part, total)
    if leaf[m]:
        base[0] = scale * -sunward * sunlight if sunward < 0 else 0.0
        _fill_irradiance(-nx, -ny, -nz, openness, scale, irradiance, base)
        _add_lit(base, lit, node, m + leaf.shape[0], part, total)


@nb.njit(cache=True, forceinline=True)
def _grooved(dx, dy, dz, view, sunward, sun, slope_rad):
    """Oren–Nayar's factor of the sun's light."""
    across = -(dx * sun[0] + dy * sun[1] + dz * sun[2]) - view * sunward
    length = math.sqrt(max((1.0 - view * view) * (1.0 - sunward * sunward), 1e-12))
    return oren_nayar(view, sunward, across / length, slope_rad)


@nb.njit(cache=True, forceinline=True)
def _fill_irradiance(nx, ny, nz, openness, scale, irradiance, base):
    """Light from the surroundings and the sky onto a facet: ``base[1:]``."""
    base[1] = scale * (1.0 - 0.5 * (1.0 + nz) * openness)
    scale *= openness
    if nz > 0.99999:
        for k in range(irradiance.shape[1]):
            base[2 + k] = scale * irradiance[OPEN_NODE, k]
        return
    i, j, fx, fy = square_cell(nx, ny, nz, 1)
    corner = i * NORMAL_NODES + j
    for k in range(irradiance.shape[1]):
        low = (1.0 - fy) * irradiance[corner, k] + fy * irradiance[corner + 1, k]
        after = corner + NORMAL_NODES
        high = (1.0 - fy) * irradiance[after, k] + fy * irradiance[after + 1, k]
        base[2 + k] = scale * (low + fx * (high - low))


@nb.njit(cache=True, fastmath=True, forceinline=True)
def _add_lit(base, lit, node, row, part, total):
    """Add a base's light, which is not polarized."""
    for e in range(base.shape[0]):
        weight = base[e]
        if weight == 0.0:
            continue
        over = np.float32(weight * part)
        under = np.float32(weight) - over
        for c in range(total.shape[1]):
            total[0, c] += under * lit[node, row, e, c] + over * lit[node + 1, row, e, c]


@nb.njit(cache=True, fastmath=True, forceinline=True)
def _add_mirrored_light(mirrored, count, lights, low, high, group, part, total):
    """Add what mirrored coefficients bring in each channel."""
    f = np.float32(part)
    for e in range(count):
        i, q, u = mirrored[e, 0], mirrored[e, 1], mirrored[e, 2]
        if i == 0.0 and q == 0.0 and u == 0.0:
            continue
        for c in range(total.shape[1]):
            light = lights[low, group, e, c] + f * (lights[high, group, e, c] - lights[low, group, e, c])
            total[0, c] += i * light
            total[1, c] += q * light
            total[2, c] += u * light


@nb.njit(cache=True)
def _mirror_base(
    dx, dy, dz, nx, ny, nz, cosine, weight, optical, terms, fresnel, reference, axis, there, sunlight,
    openness, irradiance, lit, node, part, base, total,
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
    for c in range(total.shape[1]):
        shown = 0.0
        for e in range(base.shape[0]):
            shown += base[e] * ((1.0 - part) * lit[node, there, e, c] + part * lit[node + 1, there, e, c])
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


@nb.njit(cache=True, fastmath=True, forceinline=True)
def _add_gathered(
    nx, ny, nz, optical, weight, openness, sunlight, terms, skies, looks, row_low, row_part, column_low,
    column_part, soft, first_row, gathered, mirrored,
):  # fmt: skip
    """Interpolate the table of rough reflection between normals and directions of look."""
    row_high, column_high = min(row_low + 1, looks[0] - 1), min(column_low + 1, looks[1] - 1)
    stride = 2 if soft[optical] else 1
    i, k, fx, fy = square_cell(nx, ny, nz, stride)
    for corner in range(16):
        w = (fx if corner & 1 else 1.0 - fx) * (fy if corner & 2 else 1.0 - fy)
        if w == 0.0:
            continue
        w *= (row_part if corner & 4 else 1.0 - row_part) * (column_part if corner & 8 else 1.0 - column_part)
        w = np.float32(w * weight)
        normal = (i + (stride if corner & 1 else 0)) * NORMAL_NODES + k + (stride if corner & 2 else 0)
        look = (row_high if corner & 4 else row_low) * looks[1] + (column_high if corner & 8 else column_low)
        row = first_row[optical, normal, look]
        sky, even = w * np.float32(openness), w * np.float32(1.0 - openness)
        glint = w * np.float32(sunlight)
        for term in range(terms):
            first, to = row + term * (SKY + skies), term * (2 + skies)
            for s in range(3):
                mirrored[to, s] += glint * gathered[first + SUN, s]
                mirrored[to + 1, s] += even * gathered[first + ABOVE, s] + w * gathered[first + BELOW, s]
            for e in range(skies):
                for s in range(3):
                    mirrored[to + 2 + e, s] += sky * gathered[first + SKY + e, s]


@nb.njit(cache=True, forceinline=True)
def _add_path(row_low, row_part, column_low, column_part, path, weight, total):
    """Add the light of the air between, interpolated over the frame."""
    row_high, column_high = min(row_low + 1, path.shape[0] - 1), min(column_low + 1, path.shape[1] - 1)
    under, over = np.float32(weight * (1.0 - row_part)), np.float32(weight * row_part)
    right = np.float32(column_part)
    left = np.float32(1.0) - right
    for s in range(3):
        for c in range(total.shape[1]):
            low = left * path[row_low, column_low, s, c] + right * path[row_low, column_high, s, c]
            high = left * path[row_high, column_low, s, c] + right * path[row_high, column_high, s, c]
            total[s, c] += under * low + over * high


@nb.njit(cache=True)
def _sky_ray(dx, dy, dz, axis, sky_map, share, radiance, own):
    """Coefficients of a ray that looks at the sky."""
    look_up(sky_map, dx, dy, dz, radiance)
    fx, fy, fz = carried_north(dx, dy, dz)
    c, s = axis_turn(fx, fy, fz, axis[0], axis[1], axis[2], -dx, -dy, -dz)
    own[:] = 0.0
    for component in range(radiance.shape[0]):
        q, u = rotate_qu(radiance[component, 1], radiance[component, 2], c, s)
        own[2 + component, 0] = share * radiance[component, 0]
        own[2 + component, 1], own[2 + component, 2] = share * q, share * u
