"""What rough surfaces reflect of sky, sun and surroundings, tabulated over normal and direction of look.

Under a smooth sky the light that a rough lobe gathers changes slowly with the facet's normal and with the
direction of look. It is therefore gathered with many samples at nodes (normals on an unfolded octahedron,
directions on a coarse grid over the frame), only where a hit needs them, and interpolated. What changes fast,
the growth of reflection toward grazing, is divided out before and multiplied back: a table holds the light
gathered over the directional albedo.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from ..borrowed import borrowed
from ..stokes import axis_turn, rotate_qu
from ..threads import over_rows
from .contraction import LANES
from .frame_grid import FrameGrid, frame_grid
from .hits import Hits
from .normals import NORMAL_NODES, node_normals, square_cell
from .pbrdf import facet_lobe, shaped_facet
from .sky import carried_north, look_up
from .surfaces import MIRROR_ROUGHNESS, Surfaces, over_cosine, sample_square

Array = np.ndarray

SUN_HALF_VECTOR_RADIUS = 0.5 * 4.65e-3  # the sun's mean angular radius, 959.6″, seen by the half vector [rad]
SOFT_ROUGHNESS = 0.4  # from this α on every other normal will do, and the glint is smooth enough to tabulate
SUN, ABOVE, BELOW, SKY = range(4)  # components: glint, even light from above and below the horizon, sky 0 …
_VIEW_SPACING_RAD = math.radians(4.0)
# α from where so many facets will do; narrow lobes see the brightness around the sun as a whole or not at all
_SAMPLES = ((SOFT_ROUGHNESS, 32), (0.3, 96), (0.0, 256))
_LEAST_VIEW = 0.05  # cosine; nodes seen from behind are gathered as if seen at grazing


class Rough(NamedTuple):
    """Table of one frame.

    Parameters
    ----------
    grid
        Directions of look.
    first
        Row of ``gathered`` where each optical class, normal and direction of look begins.
    gathered
        Light over albedo in the ``detector`` frame, a row for each Fresnel term: I, Q and U of the components
        `SUN`, `ABOVE`, `BELOW`, `SKY` and on, then zeros up to a multiple of `LANES`. Glint per unit of sun
        irradiance [sr⁻¹], the others per unit of radiance [1].
    soft
        Whether a class reads every other normal and has its glint in the table.
    """

    grid: FrameGrid
    first: Int[Array, "optics normal look"]
    gathered: Float[Array, "row value"]
    soft: Int[Array, "optics"]


def gather(
    hits: Hits,
    index: Int[Array, "pixel"],
    surfaces: Surfaces,
    sky_map: Float[Array, "disc disc sky_component 3"],
    sun: Float[Array, "3"],
) -> Rough:
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
    """
    grid = frame_grid(hits, _VIEW_SPACING_RAD)
    looks = grid.direction.shape[0] * grid.direction.shape[1]
    soft = (surfaces.alpha >= SOFT_ROUGHNESS).astype(np.int64)
    first_row = np.zeros((len(surfaces.alpha), NORMAL_NODES**2, looks), np.int32)
    over_rows(
        _mark,
        len(index),
        index,
        hits.columns,
        hits.oversampling,
        hits.normal,
        hits.material,
        surfaces.optics,
        surfaces.weight,
        surfaces.alpha,
        soft,
        grid,
        first_row,
    )
    flat = first_row.reshape(-1)
    wanted = np.flatnonzero(flat)
    optics = wanted // (NORMAL_NODES**2 * looks)
    ends = np.cumsum(surfaces.terms[optics])
    firsts = np.concatenate([[0], ends])
    flat[wanted] = firsts[:-1]
    gathered = np.zeros((firsts[-1], -(-3 * (SKY + sky_map.shape[2]) // LANES) * LANES), np.float32)
    over_rows(
        _gather,
        len(wanted),
        optics,
        node_normals()[wanted // looks % NORMAL_NODES**2],
        grid.direction.reshape(-1, 3)[wanted % looks],
        surfaces,
        sky_map,
        np.asarray(sun, dtype=float),
        np.asarray(hits.detector_axis, dtype=float),
        tuple(_facet_samples(count) for _, count in _SAMPLES),
        np.array([next(k for k, (least, _) in enumerate(_SAMPLES) if a >= least) for a in surfaces.alpha]),
        soft,
        firsts,
        gathered,
    )
    return Rough(grid, first_row, gathered, soft)


def _facet_samples(count: int) -> Float[Array, "sample 4"]:
    """What `shaped_facet` takes, for evenly spread samples."""
    u, v = sample_square(count).T
    turn = 2 * np.pi * v
    return np.stack([np.sqrt(u), np.sqrt(-np.log1p(-u)), np.cos(turn), np.sin(turn)], axis=1)


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _mark(
    start,
    stop,
    index,
    columns,
    oversampling,
    normals,
    materials,
    optics,
    weight,
    alpha,
    soft,
    grid,
    first_row,
):
    index, normals, materials = borrowed(index), borrowed(normals), borrowed(materials)
    optics, first_row = borrowed(optics), borrowed(first_row)
    direction, row_lows, _, column_lows, _ = borrowed(grid)
    looks_across = direction.shape[1]
    last_row, last_column = direction.shape[0] - 1, looks_across - 1
    before, before_look = -1, -1
    bx, by, bz = np.float32(2.0), np.float32(2.0), np.float32(2.0)
    for j in range(start, stop):
        row = index[j] // columns
        column = (index[j] - row * columns) * oversampling
        row *= oversampling
        for r in range(row, row + oversampling):
            for c in range(column, column + oversampling):
                ray = r * columns * oversampling + c
                material = materials[ray]
                if material < 0:
                    continue
                look = row_lows[r] * looks_across + column_lows[c]
                nx, ny, nz = normals[ray, 0], normals[ray, 1], normals[ray, 2]
                if material == before and look == before_look and nx == bx and ny == by and nz == bz:
                    continue  # a neighbour on the same facet
                before, before_look, bx, by, bz = material, look, nx, ny, nz
                optical = optics[material]
                if weight[material] == 0.0 or alpha[optical] < MIRROR_ROUGHNESS:
                    continue
                stride = 2 if soft[optical] else 1
                i, k, fx, fy = square_cell(float(nx), float(ny), float(nz), stride)
                for di in range(2 if fx > 0 else 1):
                    for dk in range(2 if fy > 0 else 1):
                        node = (i + di * stride) * NORMAL_NODES + k + dk * stride
                        for dr in range(2):
                            for dc in range(2):
                                look = min(row_lows[r] + dr, last_row) * looks_across
                                first_row[optical, node, look + min(column_lows[c] + dc, last_column)] = 1


@nb.njit(nogil=True, cache=True)
def _gather(
    start, stop, optics, normals, looks, surfaces, sky_map, sun, axis, sets, kinds, soft, firsts,
    gathered,
):  # fmt: skip
    radiance = np.empty((sky_map.shape[2], 3), np.float32)
    out = np.empty((surfaces.terms.max() * (SKY + sky_map.shape[2]), 3), np.float32)
    _gather_rows(
        start, stop, optics, normals, looks, surfaces, sky_map, sun, axis, sets, kinds, soft, firsts,
        radiance, out, gathered,
    )  # fmt: skip


@nb.njit(cache=True, error_model="numpy")
def _gather_rows(
    start, stop, optics, normals, looks, surfaces, sky_map, sun, axis, sets, kinds, soft, firsts, radiance,
    out, gathered,
):  # fmt: skip
    sky_map, sun, axis, radiance, out = borrowed((sky_map, sun, axis, radiance, out))
    _, _, _, _, _, alphas, models, counts, fresnel, _, reference, albedo, _ = borrowed(surfaces)
    few, middling, many = borrowed(sets)
    block = SKY + sky_map.shape[2]
    for row in range(start, stop):
        optical = optics[row]
        alpha, slopes, terms = alphas[optical], models[optical], counts[optical]
        out[: terms * block] = 0.0
        nx, ny, nz = normals[row, 0], normals[row, 1], normals[row, 2]
        vx, vy, vz = -looks[row, 0], -looks[row, 1], -looks[row, 2]
        lift = _LEAST_VIEW - (vx * nx + vy * ny + vz * nz)
        if lift > 0:
            vx, vy, vz = vx + lift * nx, vy + lift * ny, vz + lift * nz
            norm = 1.0 / math.sqrt(vx * vx + vy * vy + vz * vz)
            vx, vy, vz = vx * norm, vy * norm, vz * norm
        samples = few if kinds[optical] == 0 else middling if kinds[optical] == 1 else many
        total = _gather_sky(
            nx, ny, nz, vx, vy, vz, optical, alpha, slopes, terms, fresnel, reference, sky_map, axis, samples,
            radiance, out,
        )  # fmt: skip
        scale = 1.0 / max(total, 1e-12)  # by the albedo that the same samples give
        for component in range(terms * block):
            for s in range(3):
                out[component, s] *= scale
        if soft[optical]:
            weight = 1.0 / max(over_cosine(albedo, optical, vx * nx + vy * ny + vz * nz), 1e-9)
            add_glint(
                -vx, -vy, -vz, nx, ny, nz, sun, optical, weight, alpha, slopes, terms, fresnel, axis, block,
                out,
            )  # fmt: skip
        for term in range(terms):
            for component in range(block):
                for s in range(3):
                    gathered[firsts[row] + term, 3 * component + s] = out[term * block + component, s]


@nb.njit(cache=True, forceinline=True)
def _gather_sky(
    nx, ny, nz, vx, vy, vz, optical, alpha, slopes, terms, fresnel, reference, sky_map, axis, samples,
    radiance, out,
):  # fmt: skip
    """Add up the components of one node over the samples; returns the sum of the albedo."""
    block = SKY + sky_map.shape[2]
    tx, ty, tz = (0.0, -nz, ny) if abs(nx) < 0.9 else (nz, 0.0, -nx)  # x̂ × n or ŷ × n
    norm = 1.0 / math.sqrt(tx * tx + ty * ty + tz * tz)
    tx, ty, tz = tx * norm, ty * norm, tz * norm
    bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
    lx, ly, lz = vx * tx + vy * ty + vz * tz, vx * bx + vy * by + vz * bz, vx * nx + vy * ny + vz * nz
    albedo = 0.0
    for i in range(samples.shape[0]):
        a, b, c, weight = shaped_facet(
            slopes, lx, ly, lz, alpha, samples[i, 0], samples[i, 1], samples[i, 2], samples[i, 3]
        )
        if weight <= 0.0:
            continue
        hx, hy, hz = a * tx + b * bx + c * nx, a * ty + b * by + c * ny, a * tz + b * bz + c * nz
        cosine = vx * hx + vy * hy + vz * hz
        sx, sy, sz, c_out, s_out = plane_of_incidence(-vx, -vy, -vz, hx, hy, hz, axis)
        rx, ry, rz = 2 * cosine * hx - vx, 2 * cosine * hy - vy, 2 * cosine * hz - vz
        above = rz > 0
        c_in, s_in = 1.0, 0.0
        if above:
            look_up(sky_map, rx, ry, rz, radiance)
            fx, fy, fz = carried_north(rx, ry, rz)
            c_in, s_in = axis_turn(fx, fy, fz, sx, sy, sz, -rx, -ry, -rz)
        for term in range(terms):
            m00, m01, m22 = fresnel_term(fresnel, optical, term, cosine)
            albedo += weight * reference[optical, term] * m00
            even = term * block + (ABOVE if above else BELOW)
            q, u = rotate_qu(m01, 0.0, c_out, s_out)
            out[even, 0] += weight * m00
            out[even, 1] += weight * q
            out[even, 2] += weight * u
            if above:
                first = term * block + SKY
                add_mirrored(m00, m01, m22, c_in, s_in, c_out, s_out, weight, radiance, out, first)
    return albedo


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
def add_glint(dx, dy, dz, nx, ny, nz, sun, optical, weight, alpha, slopes, terms, fresnel, axis, block, out):
    """Add the sun's glint off microfacets, F·D·G/(4 cos θv) per unit of irradiance, at each block's head."""
    light = sun[0] * nx + sun[1] * ny + sun[2] * nz
    if light <= 0:
        return
    hx, hy, hz = sun[0] - dx, sun[1] - dy, sun[2] - dz
    norm = 1.0 / math.sqrt(hx * hx + hy * hy + hz * hz)
    hx, hy, hz = hx * norm, hy * norm, hz * norm
    view = max(-(dx * nx + dy * ny + dz * nz), 1e-3)
    # the sun is a disc: no lobe is narrower than it
    wide = math.sqrt(alpha * alpha + SUN_HALF_VECTOR_RADIUS * SUN_HALF_VECTOR_RADIUS)
    lobe = facet_lobe(slopes, nx * hx + ny * hy + nz * hz, view, light, wide) * weight * light
    if lobe < 1e-9:
        return
    _, _, _, c_out, s_out = plane_of_incidence(dx, dy, dz, hx, hy, hz, axis)
    for term in range(terms):
        m00, m01, _ = fresnel_term(fresnel, optical, term, -(dx * hx + dy * hy + dz * hz))
        q, u = rotate_qu(m01, 0.0, c_out, s_out)
        out[term * block, 0] += lobe * m00
        out[term * block, 1] += lobe * q
        out[term * block, 2] += lobe * u
