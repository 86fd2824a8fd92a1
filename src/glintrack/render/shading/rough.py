"""Reflection of sky, sun and surroundings by rough surfaces, tabulated over normal and direction of look.

Under a smooth sky the light that a rough lobe gathers changes slowly with the facet's normal and with the
direction of look. It is therefore gathered with many samples at the nodes that hits need (normals on an
unfolded octahedron, directions on a coarse grid over the frame), and interpolated. Reflection grows fast
toward grazing. The tables therefore hold the gathered light over the directional albedo.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.render.light.sky import NORMAL_NODES, SUN_RADIUS_RAD, node_normals, north_axis, square_cell
from glintrack.render.shading.hits import Hits
from glintrack.render.shading.materials import (
    MIRROR_ROUGHNESS,
    MaterialTables,
    between_cosines,
    facet_lobe,
    over_cosine,
    sample_disc,
    sample_facet,
)
from glintrack.render.shading.projection import FrameGrid
from glintrack.stokes import axis_turn, rotate_qu

SUN_HALF_VECTOR_RADIUS = 0.5 * SUN_RADIUS_RAD  # of the sun's disc in half vectors [rad]
SOFT_ROUGHNESS = 0.4  # from this α on every other normal will do, and the glint is smooth enough to tabulate
SUN, ABOVE, BELOW, SKY = range(4)  # components: glint, even light from above and below the horizon, sky 0 …
VIEW_SPACING_RAD = math.radians(4.0)  # of the directions of look
# lowest α and number of facets; narrow lobes see the brightness around the sun as a whole or not at all
_SAMPLES = ((SOFT_ROUGHNESS, 64), (0.3, 128), (0.0, 256))
_ROW = 16  # rows are padded to a multiple of the lanes of a line of cache
_MIN_VIEW = 0.05  # cosine; nodes seen from behind are gathered as if seen at grazing


class Hit(NamedTuple):
    """A sample and its surface.

    Parameters
    ----------
    dx, dy, dz, nx, ny, nz
        Direction of look, and the facet's normal toward the lens. [1]
    cos_view, cos_sun
        Cosines of the angles from the normal to the lens and to the sun. [1]
    sunlight, sky_view
        Transmittance of the sun's light, and sky view factor. [1]
    material
        Index of the material.
    """

    dx: float
    dy: float
    dz: float
    nx: float
    ny: float
    nz: float
    cos_view: float = 0.0
    cos_sun: float = 0.0
    sunlight: float = 0.0
    sky_view: float = 0.0
    material: int = 0


class PrefilteredReflection(NamedTuple):
    """Table of one frame.

    Parameters
    ----------
    grid
        Directions of look.
    first
        First row of ``gathered`` of each optical class, normal and direction of look.
    gathered
        Light over albedo in the ``detector`` frame, a row for each Fresnel term: I, Q and U of the components
        `SUN`, `ABOVE`, `BELOW`, `SKY` and on, then zeros up to a multiple of 16. Glint per unit of sun
        irradiance [sr⁻¹], the others per unit of radiance [1].
    soft
        True for a class that uses every other normal and has its glint in the table.
    """

    grid: FrameGrid
    first: Int[Array, "optics normal look"]
    gathered: Float[Array, "row value"]
    soft: Int[Array, "optics"]


def prefilter(
    hits: Hits,
    index: Int[Array, "pixel"],
    surfaces: MaterialTables,
    sky_map: Float[Array, "disc disc sky_component 3"],
    sun: Float[Array, "3"],
    grid: FrameGrid,
) -> PrefilteredReflection:
    """Gather light at every node that the elements in ``index`` need.

    Directions of look in ``grid`` are `VIEW_SPACING_RAD` apart.
    """
    looks = grid.direction.shape[0] * grid.direction.shape[1]
    soft = (surfaces.alpha >= SOFT_ROUGHNESS).astype(np.int64)
    used = np.zeros((len(surfaces.alpha), NORMAL_NODES**2, looks, 4), np.bool_)
    rough = (surfaces.weight > 0) & (surfaces.alpha >= MIRROR_ROUGHNESS)[surfaces.optics]
    over_rows(_mark, len(index), index, hits, surfaces.optics, rough, soft, grid, used)
    # the nodes of the cells that are marked, at all four looks around
    rows, columns = grid.direction.shape[:2]
    optical, cell, look, corner = np.nonzero(used)
    node = cell + np.where(soft[optical], 2, 1) * ((corner >> 1) * NORMAL_NODES + (corner & 1))
    row, column = np.divmod(look, columns)
    first_row = np.zeros(used.shape[:3], np.int32)
    for down in (row, np.minimum(row + 1, rows - 1)):
        for right in (column, np.minimum(column + 1, columns - 1)):
            first_row[optical, node, down * columns + right] = 1
    flat = first_row.reshape(-1)
    wanted = np.flatnonzero(flat)
    optics = wanted // (NORMAL_NODES**2 * looks)
    ends = np.cumsum(surfaces.terms[optics])
    firsts = np.concatenate([[0], ends])
    flat[wanted] = firsts[:-1]
    gathered = np.zeros((firsts[-1], -(-3 * (SKY + sky_map.shape[2]) // _ROW) * _ROW), np.float32)
    normals = node_normals()[wanted // looks % NORMAL_NODES**2]
    nodes = optics, normals, grid.direction.reshape(-1, 3)[wanted % looks], firsts
    frame = surfaces, sky_map, np.asarray(sun, dtype=float), np.asarray(hits.detector_axis, dtype=float)
    counts = np.array([next(n for least, n in _SAMPLES if alpha >= least) for alpha in surfaces.alpha])
    points = np.zeros((len(counts), int(counts.max(initial=0)), 2))  # from which facets are drawn
    for own, count in zip(points, counts.tolist(), strict=True):
        own[:count] = sample_disc(count)
    over_rows(_gather, len(wanted), *nodes, *frame, points, counts, soft, gathered)
    return PrefilteredReflection(grid, first_row, gathered, soft)


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _mark(start, stop, index, hits, optics, rough, soft, grid, used):
    """Mark the normals that hits need, of the four of each cell of normals and looks."""
    row_lows, column_lows, columns = grid.row_low, grid.column_low, hits.columns
    first, normals, materials = hits.first, hits.normal, hits.material
    for j in range(start, stop):
        row, column = index[j] // columns, index[j] % columns
        look = row_lows[row] * grid.direction.shape[1] + column_lows[column]
        for ray in range(first[index[j]], first[index[j] + 1]):
            material = materials[ray]
            if material < 0 or not rough[material]:
                continue
            nx, ny, nz = normals[ray, 0], normals[ray, 1], normals[ray, 2]
            optical = optics[material]
            i, k, fx, fy = square_cell(float(nx), float(ny), float(nz), 2 if soft[optical] else 1)
            cell = i * NORMAL_NODES + k
            used[optical, cell, look, 0] = True
            if fx > 0:
                used[optical, cell, look, 2] = True
            if fy > 0:
                used[optical, cell, look, 1] = True
                if fx > 0:
                    used[optical, cell, look, 3] = True


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _gather(
    start, stop, optics, normals, looks, firsts, surfaces, sky_map, sun, axis, points, counts, soft, gathered
):
    """Gather the light of nodes, as mirrored by many facets of each.

    Each facet sees the nearest cell of the disc. For many facets this equals interpolation.
    """
    skies, last, fresnel = sky_map.shape[2], sky_map.shape[0] - 1, surfaces.fresnel
    block = SKY + skies
    sums, radiance = np.empty((surfaces.terms.max() * block, 3)), sky_map[0, 0]
    for row in range(start, stop):
        optical = optics[row]
        terms, first = surfaces.terms[optical], firsts[row]
        alpha, distribution = surfaces.alpha[optical], surfaces.distribution[optical]
        nx, ny, nz = normals[row, 0], normals[row, 1], normals[row, 2]
        vx, vy, vz = -looks[row, 0], -looks[row, 1], -looks[row, 2]
        lift = _MIN_VIEW - (vx * nx + vy * ny + vz * nz)
        if lift > 0:
            vx, vy, vz = vx + lift * nx, vy + lift * ny, vz + lift * nz
            norm = 1.0 / math.sqrt(vx * vx + vy * vy + vz * vz)
            vx, vy, vz = vx * norm, vy * norm, vz * norm
        sums[:] = 0.0
        tx, ty, tz = (0.0, -nz, ny) if abs(nx) < 0.9 else (nz, 0.0, -nx)  # x̂ × n or ŷ × n
        norm = 1.0 / math.sqrt(tx * tx + ty * ty + tz * tz)
        tx, ty, tz = tx * norm, ty * norm, tz * norm
        bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
        lx, ly, lz = vx * tx + vy * ty + vz * tz, vx * bx + vy * by + vz * bz, vx * nx + vy * ny + vz * nz
        for i in range(counts[optical]):
            u, v = points[optical, i, 0], points[optical, i, 1]
            u, v, w, weight = sample_facet(distribution, lx, ly, lz, alpha, u, v)
            if weight <= 0:
                continue
            hx, hy, hz = u * tx + v * bx + w * nx, u * ty + v * by + w * ny, u * tz + v * bz + w * nz
            cosine = lx * u + ly * v + lz * w
            rx, ry, rz = 2 * cosine * hx - vx, 2 * cosine * hy - vy, 2 * cosine * hz - vz
            sx, sy, sz, c_out, s_out = plane_of_incidence(-vx, -vy, -vz, hx, hy, hz, axis)
            even, c_in, s_in = (ABOVE if rz > 0 else BELOW), 1.0, 0.0
            if rz > 0:
                scale = 1.0 / (1.0 + rz)
                cell, column = (rx * scale + 1.0) * 0.5 * last + 0.5, (ry * scale + 1.0) * 0.5 * last + 0.5
                radiance = sky_map[int(min(max(cell, 0.0), last)), int(min(max(column, 0.0), last))]
                fx, fy, fz = north_axis(rx, ry, rz)
                c_in, s_in = axis_turn(fx, fy, fz, sx, sy, sz, -rx, -ry, -rz)
            for term in range(terms):
                m00, m01, m22 = fresnel_term(fresnel, optical, term, cosine)
                to = term * block
                q, u_even = rotate_qu(m01, 0.0, c_out, s_out)
                sums[to + even, 0] += weight * m00
                sums[to + even, 1] += weight * q
                sums[to + even, 2] += weight * u_even
                if rz > 0:
                    add_mirrored(m00, m01, m22, c_in, s_in, c_out, s_out, weight, radiance, sums, to + SKY)
        albedo = 0.0
        for term in range(terms):
            albedo += surfaces.reference[optical, term] * (
                sums[term * block + ABOVE, 0] + sums[term * block + BELOW, 0]
            )
        if soft[optical]:
            even_albedo = over_cosine(surfaces.albedo, optical, vx * nx + vy * ny + vz * nz)
            # the others are divided by the albedo that the same facets give
            weight = max(albedo, 1e-12) / max(even_albedo, 1e-9)
            ray = Hit(-vx, -vy, -vz, nx, ny, nz, 0.0, 0.0, 0.0, 0.0, 0)
            add_glint(ray, sun, (optical, weight, alpha, distribution, terms), fresnel, axis, block, sums)
        for term in range(terms):
            for k in range(block):
                for x in range(3):
                    gathered[first + term, 3 * k + x] = sums[term * block + k, x] / max(albedo, 1e-12)


@nb.njit(cache=True, forceinline=True)
def fresnel_term(tables, optical, term, cosine):
    """m00, m01, m22 of one Fresnel term of a class, from the tables over `COSINES`."""
    i, part = between_cosines(cosine)
    rest = 1.0 - part
    return (
        rest * tables[optical, term, i, 0] + part * tables[optical, term, i + 1, 0],
        rest * tables[optical, term, i, 1] + part * tables[optical, term, i + 1, 1],
        rest * tables[optical, term, i, 2] + part * tables[optical, term, i + 1, 2],
    )


@nb.njit(cache=True, forceinline=True)
def plane_of_incidence(dx, dy, dz, hx, hy, hz, axis):
    """Find the s axis of a ray d onto a facet h, and the turn from there to the detector's axis."""
    sx, sy, sz = dy * hz - dz * hy, dz * hx - dx * hz, dx * hy - dy * hx
    if sx * sx + sy * sy + sz * sz < 1e-12:  # normal incidence: any transverse axis will do
        sx, sy, sz = axis[0], axis[1], axis[2]
    c_out, s_out = axis_turn(sx, sy, sz, axis[0], axis[1], axis[2], -dx, -dy, -dz)
    return sx, sy, sz, c_out, s_out


@nb.njit(cache=True, forceinline=True)
def add_mirrored(m00, m01, m22, c_in, s_in, c_out, s_out, weight, radiance, out, first):
    """Add every sky component after reflection by a facet, at ``out[first:]``."""
    for component in range(radiance.shape[0]):
        intensity = radiance[component, 0]
        q, u = rotate_qu(radiance[component, 1], radiance[component, 2], c_in, s_in)
        q_out, u_out = rotate_qu(m01 * intensity + m00 * q, m22 * u, c_out, s_out)
        out[first + component, 0] += weight * (m00 * intensity + m01 * q)
        out[first + component, 1] += weight * q_out
        out[first + component, 2] += weight * u_out


@nb.njit(cache=True, forceinline=True)
def add_glint(ray, sun, lobe, fresnel, axis, block, out):
    """Add the sun's glint off microfacets, F·D·G/(4 cos θv) per unit of irradiance, at each block's head.

    ``lobe`` has the optical class, weight, roughness, facet model, and number of Fresnel terms.
    """
    optical, weight, alpha, distribution, terms = lobe
    dx, dy, dz, nx, ny, nz = ray.dx, ray.dy, ray.dz, ray.nx, ray.ny, ray.nz
    light = sun[0] * nx + sun[1] * ny + sun[2] * nz
    if light <= 0:
        return
    hx, hy, hz = sun[0] - dx, sun[1] - dy, sun[2] - dz
    norm = 1.0 / math.sqrt(hx * hx + hy * hy + hz * hz)
    hx, hy, hz = hx * norm, hy * norm, hz * norm
    view = max(-(dx * nx + dy * ny + dz * nz), 1e-3)
    # the sun is a disc: no lobe is narrower than it
    wide = math.sqrt(alpha * alpha + SUN_HALF_VECTOR_RADIUS * SUN_HALF_VECTOR_RADIUS)
    strength = facet_lobe(distribution, nx * hx + ny * hy + nz * hz, view, light, wide) * weight * light
    if strength < 1e-9:
        return
    c_out, s_out = plane_of_incidence(dx, dy, dz, hx, hy, hz, axis)[3:]
    for term in range(terms):
        m00, m01, _ = fresnel_term(fresnel, optical, term, -(dx * hx + dy * hy + dz * hz))
        q, u = rotate_qu(m01, 0.0, c_out, s_out)
        out[term * block, 0] += strength * m00
        out[term * block, 1] += strength * q
        out[term * block, 2] += strength * u
