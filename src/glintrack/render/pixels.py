"""The kernel of `shade`: what each pixel's rays bring, channel by channel."""

import math

import numba as nb
import numpy as np

from ..stokes import axis_turn, rotate_qu
from .pbrdf import fresnel, ggx_density, smith_masking, visible_normal
from .sky import carried_north, look_up
from .trace import MIRROR_ROUGHNESS

SUN_HALF_VECTOR_RADIUS = 0.5 * 4.65e-3  # the sun's mean angular radius, 959.6″, seen by the half vector [rad]
SURROUNDINGS_ALBEDO = 0.15  # mean reflectance of what faces down and mirrors see: an urban mean
BLOCKED_LIGHT = 0.5  # part of the light that reaches an average point of what blocks a mirror's view
# four points of the unit disc for the visible normals: equal areas in radius, a spiral in angle
_ROUGH_SAMPLES = np.array(
    [
        [math.sqrt((i + 0.5) / 4) * math.cos(turn), math.sqrt((i + 0.5) / 4) * math.sin(turn)]
        for i, turn in enumerate((0.25 * math.pi, 1.25 * math.pi, 0.75 * math.pi, 1.75 * math.pi))
    ]
)


@nb.njit(cache=True)
def _noise(x, y, z):
    """Smooth value noise of unit variance, about: patches and wear, on lattices of 4 m and 16 m."""
    total = 0.0
    for octave in range(2):
        scale = 0.25 if octave == 0 else 0.0625
        px, py = (x + 0.37 * z) * scale + 1000.0, (y + 0.61 * z) * scale + 1000.0
        i, j = int(math.floor(px)), int(math.floor(py))
        fx, fy = px - i, py - j
        fx, fy = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy)
        for di in range(2):
            for dj in range(2):
                h = ((i + di) * 73856093) ^ ((j + dj) * 19349663) ^ (octave * 83492791)
                h = ((h ^ (h >> 13)) * 1274126177) & 0x7FFFFFFF
                h = (h ^ (h >> 16)) & 0xFFFF
                weight = (fx if di else 1 - fx) * (fy if dj else 1 - fy)
                total += weight * (h / 65535.0 - 0.5)
    return 3.2 * total  # two octaves of uniform noise, smoothed, have a standard deviation near 0.31


@nb.njit(cache=True)
def _add_mirrored(dx, dy, dz, hx, hy, hz, weight, n, k, clear, sun_up, axis, sky_map, radiance, coefficient):
    """Add what one facet with normal h reflects toward −d: sky if clear and above, else surroundings."""
    cosine = -(dx * hx + dy * hy + dz * hz)
    m00, m01, m22 = fresnel(cosine, n, k)
    sx, sy, sz = dy * hz - dz * hy, dz * hx - dx * hz, dx * hy - dy * hx  # s axis of the plane of incidence
    if sx * sx + sy * sy + sz * sz < 1e-12:  # normal incidence: any transverse axis will do
        sx, sy, sz = axis[0], axis[1], axis[2]
    c_out, s_out = axis_turn(sx, sy, sz, axis[0], axis[1], axis[2], -dx, -dy, -dz)
    rx, ry, rz = dx + 2 * cosine * hx, dy + 2 * cosine * hy, dz + 2 * cosine * hz
    if not clear or rz <= 0:
        part = weight * SURROUNDINGS_ALBEDO / math.pi * (1.0 if rz <= 0 else BLOCKED_LIGHT)
        q, u = rotate_qu(m01, 0.0, c_out, s_out)
        for e in range(2):
            light = part * (sun_up if e == 0 else 1.0)
            coefficient[e, 0] += light * m00
            coefficient[e, 1] += light * q
            coefficient[e, 2] += light * u
        return
    look_up(sky_map, rx, ry, rz, radiance)
    fx, fy, fz = carried_north(rx, ry, rz)
    c_in, s_in = axis_turn(fx, fy, fz, sx, sy, sz, -rx, -ry, -rz)
    for component in range(radiance.shape[0]):
        intensity = radiance[component, 0]
        q, u = rotate_qu(radiance[component, 1], radiance[component, 2], c_in, s_in)
        q_reflected, u_reflected = m01 * intensity + m00 * q, m22 * u
        q_out, u_out = rotate_qu(q_reflected, u_reflected, c_out, s_out)
        coefficient[2 + component, 0] += weight * (m00 * intensity + m01 * q)
        coefficient[2 + component, 1] += weight * q_out
        coefficient[2 + component, 2] += weight * u_out


@nb.njit(cache=True)
def _add_glint(dx, dy, dz, nx, ny, nz, sun, alpha, weight, n, k, axis, coefficient):
    """Add the sun's glint off GGX microfacets: F·D·G/(4 cos θv) per unit of sun irradiance."""
    hx, hy, hz = sun[0] - dx, sun[1] - dy, sun[2] - dz
    norm = 1.0 / math.sqrt(hx * hx + hy * hy + hz * hz)
    hx, hy, hz = hx * norm, hy * norm, hz * norm
    view = -(dx * nx + dy * ny + dz * nz)
    light = sun[0] * nx + sun[1] * ny + sun[2] * nz
    # the sun is a disc: no lobe is narrower than it
    alpha_sun = math.sqrt(alpha * alpha + SUN_HALF_VECTOR_RADIUS * SUN_HALF_VECTOR_RADIUS)
    lobe = ggx_density(nx * hx + ny * hy + nz * hz, alpha_sun)
    lobe *= smith_masking(view, alpha_sun) * smith_masking(light, alpha_sun) / (4.0 * max(view, 1e-3))
    m00, m01, _ = fresnel(-(dx * hx + dy * hy + dz * hz), n, k)
    sx, sy, sz = dy * hz - dz * hy, dz * hx - dx * hz, dx * hy - dy * hx
    c_out, s_out = axis_turn(sx, sy, sz, axis[0], axis[1], axis[2], -dx, -dy, -dz)
    q, u = rotate_qu(m01, 0.0, c_out, s_out)
    coefficient[0, 0] += weight * lobe * m00
    coefficient[0, 1] += weight * lobe * q
    coefficient[0, 2] += weight * lobe * u


@nb.njit(cache=True)
def _add_rough_sky(
    dx, dy, dz, nx, ny, nz, alpha, weight, n, k, sun_up, axis, sky_map, samples, radiance, coefficient
):
    """Add the sky reflected by rough facets: a few visible normals, each weighed by the masking of light."""
    tx, ty, tz = (0.0, -nz, ny) if abs(nx) < 0.9 else (nz, 0.0, -nx)  # x̂ × n or ŷ × n
    norm = 1.0 / math.sqrt(tx * tx + ty * ty + tz * tz)
    tx, ty, tz = tx * norm, ty * norm, tz * norm
    bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
    vx, vy = -(dx * tx + dy * ty + dz * tz), -(dx * bx + dy * by + dz * bz)
    vz = max(-(dx * nx + dy * ny + dz * nz), 1e-3)
    for i in range(samples.shape[0]):
        a, b, c = visible_normal(vx, vy, vz, alpha, samples[i, 0], samples[i, 1])
        hx, hy, hz = a * tx + b * bx + c * nx, a * ty + b * by + c * ny, a * tz + b * bz + c * nz
        cosine = -(dx * hx + dy * hy + dz * hz)
        out = vz * -1.0 + 2 * cosine * c  # cosine of the reflected ray with the mean normal
        masking = smith_masking(out, alpha)
        if cosine > 0 and masking > 0:
            part = weight * masking / samples.shape[0]
            _add_mirrored(
                dx, dy, dz, hx, hy, hz, part, n, k, True, sun_up, axis, sky_map, radiance, coefficient
            )


@nb.njit(nogil=True, cache=True)
def shade_pixels(
    start,
    stop,
    index,
    columns,
    oversampling,
    directions,
    points,
    normals,
    materials,
    vehicle_ids,
    sun_visible,
    mirror_material,
    axis,
    sun,
    surface,
    sky_map,
    path_map,
    by_material,
    common,
    path,
    node_start,
    node_step,
    out,
):
    """Fill ``out`` (pixel, channel, 3) for rows ``start`` to ``stop`` of ``index``."""
    sky_components = sky_map.shape[2]
    path_components = path_map.shape[2]
    channels = out.shape[1]
    share = 1.0 / (oversampling * oversampling)
    radiance = np.empty((sky_components, 3))
    path_radiance = np.empty((path_components, 3))
    coefficient = np.empty((2 + sky_components, 3))
    for j in range(start, stop):
        for c in range(channels):
            out[j, c, 0], out[j, c, 1], out[j, c, 2] = 0.0, 0.0, 0.0
        row, column = index[j] // columns, index[j] % columns
        for sub in range(oversampling * oversampling):
            ray = (row * oversampling + sub // oversampling) * columns * oversampling
            ray += column * oversampling + sub % oversampling
            dx, dy, dz = float(directions[ray, 0]), float(directions[ray, 1]), float(directions[ray, 2])
            coefficient[:] = 0.0
            if materials[ray] < 0:
                _sky_pixel(dx, dy, dz, axis, sky_map, radiance, coefficient)
                for c in range(channels):
                    for e in range(2 + sky_components):
                        for s in range(3):
                            out[j, c, s] += share * coefficient[e, s] * common[-1, e, c]
                continue
            diffuse_sun, diffuse_sky = _surface(
                ray,
                dx,
                dy,
                dz,
                points,
                normals,
                surface[materials[ray]],
                vehicle_ids[ray] < 0,
                sun_visible[ray],
                mirror_material[ray] < 0,
                axis,
                sun,
                sky_map,
                radiance,
                coefficient,
            )
            polar = math.acos(min(max(-dz, 0.0), 1.0))
            _path_stokes(dx, dy, dz, axis, path_map, path_radiance)
            node = min(max((polar - node_start) / node_step, 0.0), common.shape[0] - 2.000001)
            low = int(node)
            high_part = node - low
            for c in range(channels):
                for side in range(2):
                    weight = share * (high_part if side else 1 - high_part)
                    lit = by_material[low + side, materials[ray]]
                    shared = common[low + side]
                    out[j, c, 0] += weight * (diffuse_sun * lit[0, c] + diffuse_sky * lit[1, c])
                    for e in range(2 + sky_components):
                        light = weight * shared[e, c]
                        out[j, c, 0] += light * coefficient[e, 0]
                        out[j, c, 1] += light * coefficient[e, 1]
                        out[j, c, 2] += light * coefficient[e, 2]
                for component in range(path_components):
                    light = share * path[component, c]
                    out[j, c, 0] += light * path_radiance[component, 0]
                    out[j, c, 1] += light * path_radiance[component, 1]
                    out[j, c, 2] += light * path_radiance[component, 2]


@nb.njit(cache=True)
def _surface(
    ray,
    dx,
    dy,
    dz,
    points,
    normals,
    surface,
    still,
    sunlit,
    clear,
    axis,
    sun,
    sky_map,
    radiance,
    coefficient,
):
    """Fill the mirrored coefficients of one hit and return the two diffuse ones."""
    n, k, alpha, weight, mottle = surface[0], surface[1], surface[2], surface[3], surface[4]
    nx, ny, nz = float(normals[ray, 0]), float(normals[ray, 1]), float(normals[ray, 2])
    view = -(dx * nx + dy * ny + dz * nz)
    light = sun[0] * nx + sun[1] * ny + sun[2] * nz
    sun_up = max(sun[2], 0.0)
    upper = 0.5 * (1.0 + nz)  # part of the hemisphere over the facet that is sky over open ground
    from_below = (1.0 - upper) * SURROUNDINGS_ALBEDO
    direct = max(light, 0.0) * sunlit
    leave, enter = 1.0, 1.0
    if weight > 0:
        r_view, _, _ = fresnel(view, n, k)
        r_light, _, _ = fresnel(max(light, 0.0), n, k)
        r_normal, _, _ = fresnel(1.0, n, k)
        kept = 1.0 - weight * r_normal  # the base's spectrum was measured near the normal
        leave, enter = (1 - weight * r_view) / kept, (1 - weight * r_light) / kept
        if alpha < MIRROR_ROUGHNESS:
            _add_mirrored(
                dx, dy, dz, nx, ny, nz, weight, n, k, clear, sun_up, axis, sky_map, radiance, coefficient
            )
        else:
            _add_rough_sky(
                dx,
                dy,
                dz,
                nx,
                ny,
                nz,
                alpha,
                weight,
                n,
                k,
                sun_up,
                axis,
                sky_map,
                _ROUGH_SAMPLES,
                radiance,
                coefficient,
            )
        if sunlit > 0:
            _add_glint(dx, dy, dz, nx, ny, nz, sun, alpha, weight * sunlit, n, k, axis, coefficient)
    base = leave / math.pi
    if mottle > 0 and still:
        x, y, z = float(points[ray, 0]), float(points[ray, 1]), float(points[ray, 2])
        base *= max(1.0 + mottle * _noise(x, y, z), 0.0)
    return base * (enter * direct + from_below * sun_up), base * (upper + from_below)


@nb.njit(cache=True)
def _path_stokes(dx, dy, dz, axis, path_map, path_radiance):
    """Path radiance components toward the lens, in the detector's frame."""
    look_up(path_map, dx, dy, dz, path_radiance)
    fx, fy, fz = carried_north(dx, dy, min(dz, -1e-9))
    c, s = axis_turn(fx, fy, fz, axis[0], axis[1], axis[2], -dx, -dy, -dz)
    for component in range(path_radiance.shape[0]):
        q, u = rotate_qu(path_radiance[component, 1], path_radiance[component, 2], c, s)
        path_radiance[component, 1], path_radiance[component, 2] = q, u


@nb.njit(cache=True)
def _sky_pixel(dx, dy, dz, axis, sky_map, radiance, coefficient):
    """A ray that looks at the sky: its components, in the detector's frame."""
    look_up(sky_map, dx, dy, dz, radiance)
    fx, fy, fz = carried_north(dx, dy, dz)
    c, s = axis_turn(fx, fy, fz, axis[0], axis[1], axis[2], -dx, -dy, -dz)
    for component in range(radiance.shape[0]):
        q, u = rotate_qu(radiance[component, 1], radiance[component, 2], c, s)
        coefficient[2 + component, 0] = radiance[component, 0]
        coefficient[2 + component, 1], coefficient[2 + component, 2] = q, u
