"""Light of a diffuse base under its interface, and what a leaf lets through: part of the kernel in `pixels`.

f = ρ/π · T(θv) T(θl)/T̄ under the sun, times Oren–Nayar's factor; ρ/π · T(θv) times the irradiance of sky and
surroundings; both polarized by refraction on the way out (see `surfaces`).
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np

from glintrack.render.probe_map import nearest_node
from glintrack.render.shading.mirrored_place import mirrored_here
from glintrack.render.shading.neighbours import through_air
from glintrack.render.shading.normals import NORMAL_NODES, square_cell
from glintrack.render.shading.pbrdf import oren_nayar
from glintrack.render.shading.probe_light import (
    SPACE,
    add_sky_of_body,
    off_surfaces,
    off_tilted,
    read_cell,
    take_near_sun,
)
from glintrack.render.shading.projection import OPEN_NODE

_IN_CELL = 3.0  # in place of a normal's first component: `around` is that of a cell and a place in it
OPEN = -1  # cell of a surface that sees the whole sky, as in `probes`


class Base(NamedTuple):
    """How a diffuse base is seen.

    Parameters
    ----------
    scale
        Share of the element over π, times the mottle. [1]
    enter, even
        What its interface and grooves leave of the sun's light and of the sky's, `Surfaces.at_angle`. [1]
    q, u
        Polarized part of what leaves. [1]
    left
        What vehicles that move leave of the light from sky and surroundings. [1]
    here
        See `Hits.sky_here`.
    cell, part_x, part_y
        See `Hits.light_cell`.
    """

    scale: float
    enter: float
    even: float
    q: float
    u: float
    left: float
    here: float
    cell: int
    part_x: int
    part_y: int


@nb.njit(cache=True, forceinline=True)
def add_base(hit, seen, rays, step, width, surfaces, light, scratch):
    """Add what the base scatters, and what a leaf lets through from behind.

    Returns what of the sky the place mirrors, and the light of its surroundings (`mirrored_here`).
    """
    base, at_angle = scratch.base, surfaces.at_angle
    lit_step, lit_here, m = scratch.lit_step, scratch.lit_here, hit.material
    base[0] = 0.0
    if hit.cos_sun > 0 and hit.sunlight > 0:
        leave = seen_at(at_angle, m, *between_cosines(hit.cos_sun, at_angle))[0]
        base[0] = seen.scale * seen.enter * leave * hit.cos_sun * hit.sunlight
    leaf = surfaces.leaf[m]
    on_body = seen.cell <= SPACE and not leaf
    place = _set_diffuse(hit, seen, seen.scale * seen.even, False, on_body, rays, light, scratch)
    through_air(light.lit, step, m, lit_step, lit_here, width)
    _add_lit(base, lit_here, m, seen.q, seen.u, width, scratch.total)
    if leaf:
        behind = m + surfaces.leaf.shape[0]
        base[0] = seen.scale * -hit.cos_sun * hit.sunlight if hit.cos_sun < 0 else 0.0
        _set_diffuse(hit, seen, seen.scale, True, False, rays, light, scratch)
        through_air(light.lit, step, behind, lit_step, lit_here, width)
        _add_lit(base, lit_here, behind, seen.q, seen.u, width, scratch.total)
    return place


@nb.njit(cache=True, forceinline=True)
def between_cosines(cosine, tables):
    """Node of the tables over `COSINES` before a cosine, and how far on toward the next."""
    x = min(max(cosine, 0.0), 1.0) * (tables.shape[1] - 1)
    node = min(int(x), tables.shape[1] - 2)
    return node, np.float32(x - node)


@nb.njit(cache=True, forceinline=True)
def seen_at(at_angle, m, node, part):
    """The four of `Surfaces.at_angle` between two nodes."""
    a, b, c, d = at_angle[m, node, 0], at_angle[m, node, 1], at_angle[m, node, 2], at_angle[m, node, 3]
    return (
        a + part * (at_angle[m, node + 1, 0] - a),
        b + part * (at_angle[m, node + 1, 1] - b),
        c + part * (at_angle[m, node + 1, 2] - c),
        d + part * (at_angle[m, node + 1, 3] - d),
    )


@nb.njit(cache=True, forceinline=True)
def grooved(hit, sun, slope_rad):
    """Oren–Nayar's factor of the sun's light."""
    view, sunward = hit.cos_view, hit.cos_sun
    if slope_rad == 0 or sunward <= 0:
        return 1.0
    across = -(hit.dx * sun[0] + hit.dy * sun[1] + hit.dz * sun[2]) - view * sunward
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
def _set_diffuse(hit, seen, scale, behind, on_body, rays, light, scratch):
    """Light from surroundings and sky onto a facet, or onto its other side: ``base[1:]``; and its place's."""
    base, faced, around = scratch.base, scratch.faced, scratch.around
    nz, view = -hit.nz if behind else hit.nz, 1.0 if behind else hit.sky_view
    sky_part = 0.5 * (1.0 + nz) * view
    if seen.cell != OPEN:
        shaded = seen.cell >= 0 and hit.cos_sun > 0 and seen.left == 1.0 and not behind
        hidden = 1.0 - hit.sunlight if shaded else 0.0
        place, here = seen.part_x * 512 + seen.part_y * 2 + behind + 0.9 * hidden, seen.here
        if faced[0] != _IN_CELL or faced[1] != seen.cell or faced[2] != place or faced[3] != here:
            off = off_surfaces(here, sky_part / max(seen.left, 1e-3))
            where = seen.cell, seen.part_x, seen.part_y
            by_sky = 0.0 if on_body else here
            beside = off * off_tilted(hit.nz, view) if on_body else off
            cap = read_cell(where, behind, by_sky, (off, beside), rays.probe_cells, light.probes, around)
            node = nearest_node(hit.nx, hit.ny, hit.nz)
            if on_body:
                add_sky_of_body(where, node, rays, light, around)
            elif hidden > 0:
                take_near_sun(cap, hidden * here, node, light.near_sun, around)
            faced[0], faced[1], faced[2], faced[3] = _IN_CELL, float(seen.cell), place, here
        strength = np.float32(scale * seen.left)
        base[1] = 0.0 if light.followed else scale * (1.0 - sky_part)
        place = mirrored_here(around, seen.left, sky_part, light.followed)
    else:
        nx, ny = (-hit.nx, -hit.ny) if behind else (hit.nx, hit.ny)
        if nx != faced[0] or ny != faced[1] or nz != faced[2]:
            _fill_irradiance(nx, ny, nz, light.irradiance, around)
            faced[0], faced[1], faced[2] = nx, ny, nz
        strength = np.float32(scale * view)
        base[1] = scale * (1.0 - sky_part)
        place = view, 1.0
    for k in range(base.shape[0] - 2):
        base[2 + k] = strength * around[k]
    return place


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
