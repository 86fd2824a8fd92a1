"""Light of a diffuse base under its interface, what a leaf lets through, and irradiance at probes.

f = ρ/π · T(θv) T(θl)/T̄ under the sun, times Oren–Nayar's factor; ρ/π · T(θv) times the irradiance of sky
and surroundings; both polarized by refraction on the way out (see `materials`).

Irradiance at probes, by diffuse component, and how surfaces read it; for the kernel in `pixels`.

    E_e(place) = h Σ_b v_b G_e,b(n) + g Σ_j u_j B_e,j

with v the open part of each patch of the sky, G the patch's irradiance on a facet of the probe's normal, u
the light that surfaces send (`gather`), B what of it belongs to a component; both between the probes around
the place. h is `Hits.sky_here`, and g how much more surfaces it then sees than the probes do, (1 − s)/(1 −
s/h), s the part of the place's hemisphere that is sky, held to ½ … 2.

What is smaller than the lattice hides the sun from a facet, and the bright sky about the sun with it, while
the probes around see both. A facet in the shade whose probes see the part v of the cap about the sun loses
0.85 v² of the cap's light and 0.55 v³ of that of the ring about it: chosen by rays from shaded points of
roads, lawns and roofs of the default city under two suns (path tracing), with h = 1.
With h the same rays give 0.82 and 0.49, by which shaded roads are 0.14 % brighter: too little to change it.

What a rough surface mirrors at its place, beside the open sky and the frame's mean surroundings.

    W_b(n) = ∫_b D(n·h) F(v·h) G(n·l) L(l) dω / ∫ D F G L dω,   h = (l + v)/|l + v|

is the share of patch b of the sky in the light that a facet of normal n mirrors toward the lens. Probes
know which part of each patch is open: the sky counts Σ_b v_b W_b at a place, not its whole view of the sky.
The shares are those of one lobe, of α = 0.45 as nearly all rough materials have, for the frame's mean
direction of look. Surroundings count by the irradiance that the probes get off surfaces over what the
frame's mean surfaces would send from as much of the hemisphere.

Both are two more components of what probes are lit by (`diffuse`), after the diffuse ones.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.render.light.lattice import OPEN, SPACE, node_of_normal
from glintrack.render.light.sky import (
    LEVEL_NODE,
    NORMAL_NODES,
    PATCHES,
    Sky,
    hemisphere_directions,
    look_up_all,
    node_normals,
    patch_of,
    square_cell,
)
from glintrack.render.shading.hits import Hits, samples_of
from glintrack.render.shading.materials import oren_nayar

PLACE_COMPONENTS = 2  # the sky mirrored, and light off surfaces
_ALPHA, _REFLECTANCE = 0.45, 0.04  # of the lobe; at normal incidence, of glass and bitumen
_DIRECTIONS, _LOOKS = 512, 1024
MOST_LOCAL = 4.0  # light off surfaces at a place, over that of the frame's mean surfaces


def mirrored_patches(
    sky: Sky, look: Float[Array, "look 3"], weights: Float[Array, "wavelength"]
) -> Float[Array, "normal patch"]:
    """Share of each patch in what facets mirror; of the nodes of `node_normals`, each row sums to 1.

    Parameters
    ----------
    sky
        Its radiance by direction.
    look
        Directions of look, of which the mean counts. [1]
    weights
        What of each wavelength is looked at. [1]
    """
    light = hemisphere_directions(_DIRECTIONS)
    radiance = look_up_all(sky.sky_map, light)[0][..., 0] @ (sky.sky_spectrum @ weights)
    view = -np.asarray(look[:: max(len(look) // _LOOKS, 1)], float).mean(axis=0)
    view /= max(float(np.linalg.norm(view)), 1e-9)
    half = light + view
    half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
    normals, steep = node_normals().astype(np.float32), np.float32(_ALPHA**2)
    toward, lit = (np.maximum(normals @ x.T.astype(np.float32), 0) for x in (half, light))
    facets = (steep / (1 + (steep - 1) * toward**2)) ** 2  # GGX, without its constant
    masked = 2 * lit / (lit + np.sqrt(steep + (1 - steep) * lit**2))
    fresnel = _REFLECTANCE + (1 - _REFLECTANCE) * (1 - np.clip(half @ view, 0, 1)) ** 5
    patches = np.eye(PATCHES)[patch_of(light, sky.sun_direction)] * (fresnel * radiance)[:, None]
    shares = (facets * masked) @ patches.astype(np.float32)
    total = shares.sum(axis=1, keepdims=True)
    return np.divide(shares, total, out=np.full_like(shares, 1 / PATCHES), where=total > 0)


@nb.njit(cache=True, fastmath=True, forceinline=True)
def mirrored_here(around, left, sky_part, followed):
    """Part of the sky that a place mirrors, and the light of its surroundings over the frame's mean. [1]

    Parameters
    ----------
    around
        Its last two are those of the place.
    left
        What vehicles that move leave. [1]
    sky_part
        Of the facet's hemisphere. [1]
    followed
        Whether light off surfaces is known.
    """
    last = around.shape[0] - 1
    sky = min(max(left * around[last - 1], 0.0), 1.0)
    if not followed:
        return sky, 1.0
    return sky, min(max(around[last], 0.0) / max(1.0 - sky_part, 0.05), MOST_LOCAL)


_FEW = 0.05  # of a frame's elements: for fewer only the probes that they need are lit
CAP_LOST, RING_LOST = 0.85, 0.55
MOST_MORE = 2.0  # surfaces that a place sees over what the probes around it see
_PROBES = 64  # lit together
_LANES = 16  # a multiple of so many components are summed
MIN_PROBE_WEIGHT = 1e-3  # of a probe around a surface: so that one that is alone lights it


def light_probes(
    hits: Hits,
    by_patch: Float[Array, "normal patch diffuse_component"],
    by_bounce: Float[Array, "bounce diffuse_component"],
    index: Int[Array, "pixel"],
) -> Float[Array, "probe light_and_2"]:
    """Irradiance of the probes that some need, from the sky and off surfaces; how open the cap is; 1 if lit.

    The first two are by component.
    """
    known = hits.probe_facing, hits.probe_patches, hits.probe_bounced, hits.probe_view
    width = 2 * by_patch.shape[2] + 2
    by_patch = np.pad(by_patch, ((0, 0), (0, -by_patch.shape[1] % 4), (0, -by_patch.shape[2] % _LANES)))
    out = np.empty((len(hits.probe_view), width), np.float32)
    if len(index) < _FEW * hits.rows * hits.columns:
        rows = _rows_of(hits, index)  # no other rows are read
        some = np.empty((len(rows), width), np.float32)
        over_rows(_light, len(rows), *(x[rows] for x in known), by_patch, by_bounce, some, least=1024)
        out[rows] = some
        return out
    over_rows(_light, len(out), *known, by_patch, by_bounce, out, least=1024)
    return out


def _rows_of(hits: Hits, index: Array) -> Int[Array, "row"]:
    """Probes of the cells that the samples of some elements look up, from either side."""
    some = samples_of(hits, index)
    codes = np.unique(np.concatenate([hits.light_cell[some], hits.mirror_cell[some]]))
    space = SPACE - codes[codes <= SPACE]
    return np.unique(hits.probe_cells[np.concatenate([codes[codes >= 0], space, space ^ 7])])


@nb.njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _light(start, stop, facing, patches, bounced, view, by_patch, by_bounce, out):
    """Light probes ``start`` to ``stop``: sums in lanes, of probes off surfaces, of the sky's components."""
    components = by_bounce.shape[1]
    part, off = np.empty(_PROBES, np.float32), np.empty((components, _PROBES), np.float32)
    sky = np.empty(by_patch.shape[2], np.float32)
    for first in range(start, stop, _PROBES):
        count = min(_PROBES, stop - first)
        for e in range(components):
            for k in range(_PROBES):
                off[e, k] = 0.0
        for j in range(bounced.shape[1]):
            for k in range(count):
                part[k] = np.float32(bounced[first + k, j])
            for e in range(components):
                for k in range(_PROBES):
                    off[e, k] += part[k] * by_bounce[j, e]
        for k in range(count):
            p = first + k
            _add_sky(patches[p], by_patch[facing[p]], sky)
            for e in range(components):
                out[p, e], out[p, components + e] = sky[e], off[e, k]
            out[p, 2 * components] = np.float32(patches[p, 0]) / np.float32(255.0)
            out[p, 2 * components + 1] = 1.0 if view[p] >= 0 else 0.0


@nb.njit(cache=True, fastmath=True, error_model="numpy", forceinline=True)
def _add_sky(parts, by_patch, sky):
    """Irradiance by component from the open parts of the patches, four at a time."""
    for e in range(sky.size):
        sky[e] = 0.0
    for b in range(0, by_patch.shape[0], 4):
        last = parts.size - 1
        p0, p1 = np.float32(parts[b]), np.float32(parts[min(b + 1, last)])
        p2, p3 = np.float32(parts[min(b + 2, last)]), np.float32(parts[min(b + 3, last)])
        for e in range(sky.size):
            one = p0 * by_patch[b, e] + p1 * by_patch[b + 1, e]
            sky[e] += one + (p2 * by_patch[b + 2, e] + p3 * by_patch[b + 3, e])


@nb.njit(cache=True, fastmath=True, forceinline=True)
def _weights(where, behind, cells, lit):
    """Rows of a cell's four probes and how much each counts; from behind those of the other side."""
    code, fx, fy = where
    if code <= SPACE:
        cell = SPACE - code
        if behind:
            cell ^= 7
    else:
        cell = code
    last = lit.shape[1] - 1
    a, b, c, d = cells[cell, 0], cells[cell, 1], cells[cell, 2], cells[cell, 3]
    over, up = np.float32(fx / 255.0), np.float32(fy / 255.0)
    one, least = np.float32(1.0), np.float32(MIN_PROBE_WEIGHT)
    w00 = max((one - over) * (one - up), least) * lit[a, last]
    w10, w01 = max(over * (one - up), least) * lit[b, last], max((one - over) * up, least) * lit[c, last]
    w11 = max(over * up, least) * lit[d, last]
    total = w00 + w10 + w01 + w11
    if total == 0:
        w00, w10, w01, w11, total = one, one, one, one, np.float32(4.0)
    scale = one / total
    if behind and code > SPACE:
        scale = np.float32(0.0)
    return (a, b, c, d), (w00 * scale, w10 * scale, w01 * scale, w11 * scale)


@nb.njit(cache=True, fastmath=True, forceinline=True)
def read_cell(where, behind, here, off, cells, lit, around):
    """Fill ``around`` from a cell's four probes and return how open the cap about the sun is to them.

    Light of the sky counts ``here`` times, that of surfaces ``off[0]`` times from the first probe and
    ``off[1]`` times from the others. Of a facet seen from behind nothing comes.
    """
    (a, b, c, d), (w00, w10, w01, w11) = _weights(where, behind, cells, lit)
    sky, half, last = np.float32(here), around.shape[0], lit.shape[1] - 1
    first, other = np.float32(off[0]), np.float32(off[1])
    v00, v10, v01, v11 = first * w00, other * w10, other * w01, other * w11
    for e in range(half):
        f = e + half
        by_sky = w00 * lit[a, e] + w10 * lit[b, e] + w01 * lit[c, e] + w11 * lit[d, e]
        by_surfaces = v00 * lit[a, f] + v10 * lit[b, f] + v01 * lit[c, f] + v11 * lit[d, f]
        around[e] = sky * by_sky + by_surfaces
    return w00 * lit[a, last - 1] + w10 * lit[b, last - 1] + w01 * lit[c, last - 1] + w11 * lit[d, last - 1]


@nb.njit(cache=True, fastmath=True, forceinline=True)
def add_sky_of_body(where, node, rays, light, around):
    """Add the sky that a vehicle's facet gets, by its own normal.

    v_b is a mean over the cell's probes, each by what it faces of the patch.
    """
    cells, facing, patches = rays.probe_cells, rays.probe_facing, rays.probe_patches
    (a, b, c, d), (w00, w10, w01, w11) = _weights(where, False, cells, light.probes)
    of_patch = light.of_patch
    fa, fb, fc, fd = of_patch[facing[a]], of_patch[facing[b]], of_patch[facing[c]], of_patch[facing[d]]
    for patch in range(patches.shape[1]):
        one, two = w00 * fa[patch], w10 * fb[patch]
        three, four = w01 * fc[patch], w11 * fd[patch]
        all_four = one + two + three + four
        if all_four > 0:
            above = one * patches[a, patch] + two * patches[b, patch]
            part = (above + three * patches[c, patch] + four * patches[d, patch]) / all_four
            for e in range(around.shape[0]):
                around[e] += part * light.by_patch[node, patch, e]


@nb.njit(cache=True, fastmath=True, forceinline=True)
def off_surfaces(here, sky_part):
    """How much more surfaces a place sees than the probes around it, if it sees ``here`` times their sky."""
    among = 1.0 - sky_part / max(here, 1e-3)
    return min(max((1.0 - sky_part) / max(among, 1e-3), 1.0 / MOST_MORE), MOST_MORE)


@nb.njit(cache=True, fastmath=True, forceinline=True)
def off_tilted(nz, view):
    """How much of the light that the sides of a vehicle get off surfaces its tilted facet takes.

    Of level ground it sees ½ (1 − n_z), where sides seen by the squares of the normal's components say
    ½ (1 − n_z²). What stands above the horizon makes up for it, so that even surroundings stay even: it is
    1 − V of the upper half of what sides see.
    """
    up, stands = max(nz, 0.0), 1.0 - view
    return (1.0 + stands * (1.0 + 2.0 * up)) / ((1.0 + up) * (1.0 + stands))


@nb.njit(cache=True, fastmath=True, forceinline=True)
def take_near_sun(cap, hidden, node, near_sun, around):
    """Take out of ``around`` the sky about the sun that something small hides with it from a facet."""
    by_cap = np.float32(hidden * CAP_LOST * cap * cap)
    by_ring = np.float32(hidden * RING_LOST * cap * cap * cap)
    for e in range(around.shape[0]):
        around[e] -= by_cap * near_sun[node, 0, e] + by_ring * near_sun[node, 1, e]


_IN_CELL = 3.0  # in place of a normal's first component: `around` is that of a cell and a place in it
FINE_STEPS = 128  # between nodes of the airmass: the nearest is good to 2e-4 of the transmittance


@nb.njit(cache=True, fastmath=True, forceinline=True)
def through_air(lights, step, row, kept_step, kept, width):
    """Make ``kept[row]`` the lights of a row through the air of a fine step of airmass."""
    if kept_step[row] == step:
        return
    kept_step[row] = step
    low = step // FINE_STEPS
    part = np.float32((step - low * FINE_STEPS) / FINE_STEPS)
    high = min(low + 1, lights.shape[0] - 1)
    for e in range(lights.shape[2]):
        for x in range(width):
            under, over = lights[low, row, e, x], lights[high, row, e, x]
            kept[row, e, x] = under + part * (over - under)


class Base(NamedTuple):
    """How a diffuse base is seen.

    Parameters
    ----------
    scale
        Share of the element over π, times the mottle. [1]
    enter, even
        What its interface and grooves leave of the sun's light and of the sky's (`at_angle`). [1]
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
    """The four of `MaterialTables.at_angle` between two nodes."""
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
            around[k] = irradiance[LEVEL_NODE, k]
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
            node = node_of_normal(hit.nx, hit.ny, hit.nz)
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
