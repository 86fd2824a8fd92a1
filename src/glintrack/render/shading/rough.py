"""Reflection of sky, sun and surroundings by rough surfaces, tabulated over normal and direction of look.

Under a smooth sky the light that a rough lobe gathers changes slowly with the facet's normal and with the
direction of look. It is therefore gathered with many samples at nodes (normals on an unfolded octahedron,
directions on a coarse grid over the frame), only where a hit needs them, and interpolated. What changes
fast, the growth of reflection toward grazing, is divided out before and multiplied back: a table holds the
light gathered over the directional albedo.
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
    facet_lobe,
    over_cosine,
    sample_square,
    sampled_facet,
)
from glintrack.render.shading.projection import FrameGrid
from glintrack.stokes import axis_turn, rotate_qu

SUN_HALF_VECTOR_RADIUS = 0.5 * SUN_RADIUS_RAD  # as the half vector sees the disc [rad]
SOFT_ROUGHNESS = 0.4  # from this α on every other normal will do, and the glint is smooth enough to tabulate
SUN, ABOVE, BELOW, SKY = range(4)  # components: glint, even light from above and below the horizon, sky 0 …
VIEW_SPACING_RAD = math.radians(4.0)  # of the directions of look
# α from where so many facets will do; narrow lobes see the brightness around the sun as a whole or not at all
_SAMPLES = ((SOFT_ROUGHNESS, 64), (0.3, 128), (0.0, 256))
_ROW = 16  # values of a row are filled up to a multiple of so many, the lanes of a line of cache
_LEAST_VIEW = 0.05  # cosine; nodes seen from behind are gathered as if seen at grazing


class Lobe(NamedTuple):
    """One rough interface: its optical class, weight, roughness, facet model, and number of Fresnel terms."""

    optical: int
    weight: float
    alpha: float
    distribution: int
    terms: int


class Ray(NamedTuple):
    """Direction of look, and the normal of the facet that it meets. [1]"""

    dx: float
    dy: float
    dz: float
    nx: float
    ny: float
    nz: float


class Nodes(NamedTuple):
    """Nodes to be gathered: optical class, normal, direction of look, and first row in the table."""

    optics: Int[Array, "node"]
    normals: Float[Array, "node 3"]
    looks: Float[Array, "node 3"]
    firsts: Int[Array, "node"]


class PrefilteredReflection(NamedTuple):
    """Table of one frame.

    Parameters
    ----------
    grid
        Directions of look.
    first
        Row of ``gathered`` where each optical class, normal and direction of look begins.
    gathered
        Light over albedo in the ``detector`` frame, a row for each Fresnel term: I, Q and U of the components
        `SUN`, `ABOVE`, `BELOW`, `SKY` and on, then zeros up to a multiple of 16. Glint per unit of sun
        irradiance [sr⁻¹], the others per unit of radiance [1].
    soft
        Whether a class reads every other normal and has its glint in the table.
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
    """Gather light at every node that the pixels in ``index`` need.

    Parameters
    ----------
    hits, index
        The frame, and which of its elements will be shaded.
    surfaces
        From `unpack_surfaces`.
    sky_map
        As in `Sky`.
    sun
        Unit vector toward the sun. [1]
    grid
        Directions of look, `VIEW_SPACING_RAD` apart.
    """
    looks = grid.direction.shape[0] * grid.direction.shape[1]
    soft = (surfaces.alpha >= SOFT_ROUGHNESS).astype(np.int64)
    used = np.zeros((len(surfaces.alpha), NORMAL_NODES**2, looks, 4), np.bool_)
    over_rows(
        _mark,
        len(index),
        index,
        hits.columns,
        np.ascontiguousarray(hits.first),
        hits.normal,
        hits.material,
        surfaces.optics,
        (surfaces.weight > 0) & (surfaces.alpha >= MIRROR_ROUGHNESS)[surfaces.optics],
        soft,
        grid,
        used,
    )
    first_row = np.zeros(used.shape[:3], np.int32)
    _spread(used, soft, grid.direction.shape[:2], first_row)
    flat = first_row.reshape(-1)
    wanted = np.flatnonzero(flat)
    optics = wanted // (NORMAL_NODES**2 * looks)
    ends = np.cumsum(surfaces.terms[optics])
    firsts = np.concatenate([[0], ends])
    flat[wanted] = firsts[:-1]
    gathered = np.zeros((firsts[-1], -(-3 * (SKY + sky_map.shape[2]) // _ROW) * _ROW), np.float32)
    normals = node_normals()[wanted // looks % NORMAL_NODES**2]
    nodes = Nodes(optics, normals, grid.direction.reshape(-1, 3)[wanted % looks], firsts)
    over_rows(
        _gather,
        len(wanted),
        nodes,
        surfaces,
        sky_map,
        np.asarray(sun, dtype=float),
        np.asarray(hits.detector_axis, dtype=float),
        *_facet_points(surfaces.alpha),
        soft,
        gathered,
    )
    return PrefilteredReflection(grid, first_row, gathered, soft)


def _facet_points(
    alphas: Float[Array, "optics"],
) -> tuple[Float[Array, "optics facet 2"], Int[Array, "optics"]]:
    """Evenly spread points of the unit square from which the facets of each class are drawn, and how many."""
    counts = np.array([next(count for least, count in _SAMPLES if alpha >= least) for alpha in alphas])
    points = np.zeros((len(counts), int(counts.max(initial=0)), 2))
    for row, count in zip(points, counts.tolist(), strict=True):
        row[:count] = sample_square(count)
    return points, counts


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _mark(start, stop, index, columns, first, normals, materials, optics, rough, soft, grid, used):
    """Mark, for each cell of normals and looks that hits lie in, which of its four normals they need."""
    row_lows, column_lows = grid.row_low, grid.column_low
    looks_across = grid.direction.shape[1]
    before, before_look = -1, -1
    bx, by, bz = np.float32(2.0), np.float32(2.0), np.float32(2.0)
    row, row_start = 0, 0
    for j in range(start, stop):
        column = index[j] - row_start
        if column < 0 or column >= columns:
            row = index[j] // columns
            row_start = row * columns
            column = index[j] - row_start
        look = row_lows[row] * looks_across + column_lows[column]
        for ray in range(first[index[j]], first[index[j] + 1]):
            material = materials[ray]
            if material < 0 or not rough[material]:
                continue
            nx, ny, nz = normals[ray, 0], normals[ray, 1], normals[ray, 2]
            if material == before and look == before_look and nx == bx and ny == by and nz == bz:
                continue  # a neighbour on the same facet
            before, before_look, bx, by, bz = material, look, nx, ny, nz
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


@nb.njit(nogil=True, cache=True)
def _spread(used, soft, looks, first_row):
    """Mark the nodes that `_mark`'s cells ask for, at all four looks around."""
    for optical in range(used.shape[0]):
        stride = 2 if soft[optical] else 1
        for cell in range(used.shape[1]):
            for look in range(used.shape[2]):
                if not used[optical, cell, look, 0]:
                    continue
                row, column = look // looks[1], look % looks[1]
                for corner in range(4):
                    if used[optical, cell, look, corner]:
                        node = cell + stride * ((corner >> 1) * NORMAL_NODES + (corner & 1))
                        for r in range(row, min(row + 2, looks[0])):
                            for c in range(column, min(column + 2, looks[1])):
                                first_row[optical, node, r * looks[1] + c] = 1


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _gather(start, stop, nodes, surfaces, sky_map, sun, axis, points, counts, soft, gathered):
    skies, fresnel = sky_map.shape[2], surfaces.fresnel
    block = SKY + skies
    sums, radiance = np.empty((surfaces.terms.max() * block, 3)), np.empty((skies, 3), np.float32)
    for row in range(start, stop):
        optical = nodes.optics[row]
        terms, first = surfaces.terms[optical], nodes.firsts[row]
        alpha, distribution = surfaces.alpha[optical], surfaces.distribution[optical]
        nx, ny, nz = nodes.normals[row, 0], nodes.normals[row, 1], nodes.normals[row, 2]
        vx, vy, vz = -nodes.looks[row, 0], -nodes.looks[row, 1], -nodes.looks[row, 2]
        lift = _LEAST_VIEW - (vx * nx + vy * ny + vz * nz)
        if lift > 0:
            vx, vy, vz = vx + lift * nx, vy + lift * ny, vz + lift * nz
            norm = 1.0 / math.sqrt(vx * vx + vy * vy + vz * vz)
            vx, vy, vz = vx * norm, vy * norm, vz * norm
        sums[:] = 0.0
        ray, drawn = Ray(-vx, -vy, -vz, nx, ny, nz), points[optical, : counts[optical]]
        _gather_facets(ray, optical, drawn, surfaces, sky_map, axis, radiance, sums)
        albedo = 0.0
        for term in range(terms):
            even = sums[term * block + ABOVE, 0] + sums[term * block + BELOW, 0]
            albedo += surfaces.reference[optical, term] * even
        if soft[optical]:
            even_albedo = over_cosine(surfaces.albedo, optical, vx * nx + vy * ny + vz * nz)
            # the others are divided by the albedo that the same facets give
            weight = max(albedo, 1e-12) / max(even_albedo, 1e-9)
            add_glint(ray, sun, Lobe(optical, weight, alpha, distribution, terms), fresnel, axis, block, sums)
        for term in range(terms):
            for k in range(block):
                for x in range(3):
                    gathered[first + term, 3 * k + x] = sums[term * block + k, x] / max(albedo, 1e-12)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _gather_facets(ray, optical, points, surfaces, sky_map, axis, radiance, sums):
    """Add even light from above and below the horizon and the sky, as many facets of a node mirror them.

    Each facet sees the nearest cell of the disc: of many facets that is as good as between cells.
    """
    nx, ny, nz, vx, vy, vz = ray.nx, ray.ny, ray.nz, -ray.dx, -ray.dy, -ray.dz
    alpha, distribution, fresnel = surfaces.alpha[optical], surfaces.distribution[optical], surfaces.fresnel
    block, last = SKY + radiance.shape[0], sky_map.shape[0] - 1
    tx, ty, tz = (0.0, -nz, ny) if abs(nx) < 0.9 else (nz, 0.0, -nx)  # x̂ × n or ŷ × n
    norm = 1.0 / math.sqrt(tx * tx + ty * ty + tz * tz)
    tx, ty, tz = tx * norm, ty * norm, tz * norm
    bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
    lx, ly, lz = vx * tx + vy * ty + vz * tz, vx * bx + vy * by + vz * bz, vx * nx + vy * ny + vz * nz
    for i in range(len(points)):
        u, v, w, weight = sampled_facet(distribution, lx, ly, lz, alpha, points[i, 0], points[i, 1])
        if weight <= 0:
            continue
        hx, hy, hz = u * tx + v * bx + w * nx, u * ty + v * by + w * ny, u * tz + v * bz + w * nz
        cosine = lx * u + ly * v + lz * w
        rx, ry, rz = 2 * cosine * hx - vx, 2 * cosine * hy - vy, 2 * cosine * hz - vz
        sx, sy, sz, c_out, s_out = plane_of_incidence(ray.dx, ray.dy, ray.dz, hx, hy, hz, axis)
        even, c_in, s_in = (ABOVE if rz > 0 else BELOW), 1.0, 0.0
        if rz > 0:
            scale = 1.0 / (1.0 + rz)
            row, column = (rx * scale + 1.0) * 0.5 * last + 0.5, (ry * scale + 1.0) * 0.5 * last + 0.5
            radiance[:] = sky_map[int(min(max(row, 0.0), last)), int(min(max(column, 0.0), last))]
            fx, fy, fz = north_axis(rx, ry, rz)
            c_in, s_in = axis_turn(fx, fy, fz, sx, sy, sz, -rx, -ry, -rz)
        for term in range(surfaces.terms[optical]):
            m00, m01, m22 = fresnel_term(fresnel, optical, term, cosine)
            first = term * block
            q, u_even = rotate_qu(m01, 0.0, c_out, s_out)
            sums[first + even, 0] += weight * m00
            sums[first + even, 1] += weight * q
            sums[first + even, 2] += weight * u_even
            if rz > 0:
                add_mirrored(m00, m01, m22, c_in, s_in, c_out, s_out, weight, radiance, sums, first + SKY)


@nb.njit(cache=True, forceinline=True)
def fresnel_term(tables, optical, term, cosine):
    """m00, m01, m22 of one Fresnel term of a class, from the tables over `COSINES`."""
    x = min(max(cosine, 0.0), 1.0) * (tables.shape[2] - 1)
    i = min(int(x), tables.shape[2] - 2)
    part = x - i
    rest = 1.0 - part
    return (
        rest * tables[optical, term, i, 0] + part * tables[optical, term, i + 1, 0],
        rest * tables[optical, term, i, 1] + part * tables[optical, term, i + 1, 1],
        rest * tables[optical, term, i, 2] + part * tables[optical, term, i + 1, 2],
    )


@nb.njit(cache=True, forceinline=True)
def plane_of_incidence(dx, dy, dz, hx, hy, hz, axis):
    """Its s axis for a ray d onto a facet h, and the turn from there to the detector's axis."""
    sx, sy, sz = dy * hz - dz * hy, dz * hx - dx * hz, dx * hy - dy * hx
    if sx * sx + sy * sy + sz * sz < 1e-12:  # normal incidence: any transverse axis will do
        sx, sy, sz = axis[0], axis[1], axis[2]
    c_out, s_out = axis_turn(sx, sy, sz, axis[0], axis[1], axis[2], -dx, -dy, -dz)
    return sx, sy, sz, c_out, s_out


@nb.njit(cache=True, forceinline=True)
def add_mirrored(m00, m01, m22, c_in, s_in, c_out, s_out, weight, radiance, out, first):
    """Add every sky component as one facet reflects it, at ``out[first:]``."""
    for component in range(radiance.shape[0]):
        intensity = radiance[component, 0]
        q, u = rotate_qu(radiance[component, 1], radiance[component, 2], c_in, s_in)
        q_out, u_out = rotate_qu(m01 * intensity + m00 * q, m22 * u, c_out, s_out)
        out[first + component, 0] += weight * (m00 * intensity + m01 * q)
        out[first + component, 1] += weight * q_out
        out[first + component, 2] += weight * u_out


@nb.njit(cache=True, forceinline=True)
def add_glint(ray, sun, rough, fresnel, axis, block, out):
    """Add the sun's glint off microfacets, F·D·G/(4 cos θv) per unit of irradiance, at each block's head."""
    dx, dy, dz, nx, ny, nz = ray.dx, ray.dy, ray.dz, ray.nx, ray.ny, ray.nz
    light = sun[0] * nx + sun[1] * ny + sun[2] * nz
    if light <= 0:
        return
    hx, hy, hz = sun[0] - dx, sun[1] - dy, sun[2] - dz
    norm = 1.0 / math.sqrt(hx * hx + hy * hy + hz * hz)
    hx, hy, hz = hx * norm, hy * norm, hz * norm
    view = max(-(dx * nx + dy * ny + dz * nz), 1e-3)
    # the sun is a disc: no lobe is narrower than it
    wide = math.sqrt(rough.alpha * rough.alpha + SUN_HALF_VECTOR_RADIUS * SUN_HALF_VECTOR_RADIUS)
    lobe = (
        facet_lobe(rough.distribution, nx * hx + ny * hy + nz * hz, view, light, wide) * rough.weight * light
    )
    if lobe < 1e-9:
        return
    c_out, s_out = plane_of_incidence(dx, dy, dz, hx, hy, hz, axis)[3:]
    for term in range(rough.terms):
        m00, m01, _ = fresnel_term(fresnel, rough.optical, term, -(dx * hx + dy * hy + dz * hz))
        q, u = rotate_qu(m01, 0.0, c_out, s_out)
        out[term * block, 0] += lobe * m00
        out[term * block, 1] += lobe * q
        out[term * block, 2] += lobe * u
