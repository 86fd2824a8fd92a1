"""Light of a diffuse base under its interface, transmission of leaves, and irradiance at probes.

f = ρ/π · T(θv) T(θl)/T̄ under the sun, times Oren–Nayar's factor; ρ/π · T(θv) times the irradiance of sky
and surroundings; both polarized by refraction on the way out (see `materials`).

Irradiance at probes, by diffuse component, as interpolated by the kernel in `pixels`:

    E_e(place) = h Σ_b v_b G_e,b(n) + g Σ_j u_j B_e,j

with v the open part of each patch of the sky, G the patch's irradiance on a facet of the probe's normal, u
the light from surfaces (`gather`), B its share in a component; both interpolated between the probes around
the place. h is `Hits.sky_here`, and g the ratio of surfaces in view of the place and of the probes, (1 − s)/
(1 − s/h), s the part of sky in the place's hemisphere, limited to ½ … 2.

Objects smaller than the lattice hide the sun from a facet, and the bright sky about the sun, while the probes
around see both. A facet in the shade with probes that see the part v of the cap about the sun loses 0.85 v²
of the cap's light and 0.55 v³ of that of the ring about it. The numbers are fitted to rays from shaded points
of roads, lawns and roofs of the default city under two suns (path tracing), with h = 1.

The share of patch b of the sky in the light that a rough facet of normal n mirrors toward the lens is

    W_b(n) = ∫_b D(n·h) F(v·h) G(n·l) L(l) dω / ∫ D F G L dω,   h = (l + v)/|l + v|

Probes have the open part of each patch: the sky at a place counts Σ_b v_b W_b, not its whole sky view. The
shares are those of one lobe, of α = 0.45 as of nearly all rough materials, for the frame's mean direction of
look. Surroundings count by the irradiance of the probes from surfaces over that from the frame's mean
surfaces in the same part of the hemisphere. Both are two more components at the probes, after the diffuse
ones.
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
from glintrack.render.shading.materials import between_cosines, oren_nayar

_ALPHA, _REFLECTANCE = 0.45, 0.04  # of the lobe; at normal incidence, of glass and bitumen
_DIRECTIONS, _LOOKS = 512, 1024
MAX_LOCAL = 4.0  # light off surfaces at a place, over that of the frame's mean surfaces


def mirror_patch_shares(
    sky: Sky, look: Float[Array, "look 3"], weights: Float[Array, "wavelength"]
) -> Float[Array, "normal patch"]:
    """Share of each patch in the mirrored light, for the nodes of `node_normals`; each row sums to 1.

    Parameters
    ----------
    sky
        The sky's radiance by direction.
    look
        Directions of look; their mean is used. [1]
    weights
        Weight of each wavelength. [1]
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
def mirror_place(around, left, sky_part, followed):
    """Part of the sky that a place mirrors, and the light of its surroundings over the frame's mean. [1]

    The last two values ``around`` are those of the place, ``left`` is `Hits.sky_left` from 0 to 1, and
    ``sky_part`` the part of sky in the facet's hemisphere. Light off surfaces may be ``followed``.
    """
    last = around.shape[0] - 1
    sky = min(max(left * around[last - 1], 0.0), 1.0)
    if not followed:
        return sky, 1.0
    return sky, min(max(around[last], 0.0) / max(1.0 - sky_part, 0.05), MAX_LOCAL)


_FEW = 0.05  # of a frame's elements: for fewer only their own probes are lit
CAP_LOST, RING_LOST = 0.85, 0.55
MAX_GAIN = 2.0  # of surfaces in view of a place over those of the probes around it
MIN_PROBE_WEIGHT = 1e-3  # of a probe around a surface, so that a single one lights it


def light_probes(
    hits: Hits,
    by_patch: Float[Array, "normal patch diffuse_component"],
    by_bounce: Float[Array, "bounce diffuse_component"],
    index: Int[Array, "pixel"],
) -> Float[Array, "probe light_and_2"]:
    """Irradiance of some elements' probes by component, from the sky, then off surfaces; and two flags.

    The flags are the open part of the cap about the sun, and 1 for probes that light reaches, else 0.
    """
    known = hits.probe_facing, hits.probe_patches, hits.probe_bounced, hits.probe_view
    out = np.empty((len(hits.probe_view), 2 * by_patch.shape[2] + 2), np.float32)
    rows = np.arange(len(out))
    if len(index) < _FEW * hits.rows * hits.columns:  # no other rows are used
        some = samples_of(hits, index)
        codes = np.unique(np.concatenate([hits.light_cell[some], hits.mirror_cell[some]]))
        space = SPACE - codes[codes <= SPACE]  # cells of either side
        rows = np.unique(hits.probe_cells[np.concatenate([codes[codes >= 0], space, space ^ 7])])
    by_component = np.ascontiguousarray(by_patch.swapaxes(1, 2)), np.ascontiguousarray(by_bounce.T)
    over_rows(_light, len(rows), rows, *known, *by_component, out, least=1024)
    return out


@nb.njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _light(start, stop, rows, facing, patches, bounced, view, by_patch, by_bounce, out):
    """Light some probes."""
    components = by_bounce.shape[0]
    for p in rows[start:stop]:
        node = facing[p]
        for e in range(components):
            sky = off = np.float32(0.0)
            for b in range(patches.shape[1]):
                sky += np.float32(patches[p, b]) * by_patch[node, e, b]
            for j in range(bounced.shape[1]):
                off += np.float32(bounced[p, j]) * by_bounce[e, j]
            out[p, e], out[p, components + e] = sky, off
        out[p, 2 * components] = np.float32(patches[p, 0]) / np.float32(255.0)
        out[p, 2 * components + 1] = 1.0 if view[p] >= 0 else 0.0


@nb.njit(cache=True, fastmath=True, forceinline=True)
def _weights(place, behind, cells, lit):
    """Rows and weights of a cell's four probes; from behind those of the other side."""
    code, fx, fy = place.cell, place.part_x, place.part_y
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
def blend_cell(place, behind, here, off, cells, lit, around):
    """Fill ``around`` from a cell's four probes and return the open part of the cap about the sun.

    Light of the sky counts ``here`` times, that of surfaces ``off[0]`` times from the first probe and
    ``off[1]`` times from the others. Facets seen from behind get no light.
    """
    (a, b, c, d), (w00, w10, w01, w11) = _weights(place, behind, cells, lit)
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
def add_sky_of_body(place, node, probes, around):
    """Add the sky of a vehicle's facet, by its own normal.

    v_b is a mean over the cell's probes, weighted with the light of the patch on each.
    """
    facing, patches, of_patch = probes.facing, probes.patches, probes.of_patch
    (a, b, c, d), (w00, w10, w01, w11) = _weights(place, False, probes.cells, probes.lit)
    fa, fb, fc, fd = of_patch[facing[a]], of_patch[facing[b]], of_patch[facing[c]], of_patch[facing[d]]
    for patch in range(patches.shape[1]):
        one, two = w00 * fa[patch], w10 * fb[patch]
        three, four = w01 * fc[patch], w11 * fd[patch]
        all_four = one + two + three + four
        if all_four > 0:
            above = one * patches[a, patch] + two * patches[b, patch]
            part = (above + three * patches[c, patch] + four * patches[d, patch]) / all_four
            for e in range(around.shape[0]):
                around[e] += part * probes.by_patch[node, patch, e]


@nb.njit(cache=True, fastmath=True, forceinline=True)
def surface_gain(here, sky_part):
    """Ratio of surfaces in view of a place and of the probes around it, with ``here`` times their sky."""
    among = 1.0 - sky_part / max(here, 1e-3)
    return min(max((1.0 - sky_part) / max(among, 1e-3), 1.0 / MAX_GAIN), MAX_GAIN)


@nb.njit(cache=True, fastmath=True, forceinline=True)
def tilt_gain(nz, view):
    """Ratio of the light off surfaces on a vehicle's tilted facet and on its sides.

    The facet's view of level ground is ½ (1 − n_z), while weights of sides by the squares of the normal's
    components give ½ (1 − n_z²). Surfaces above the horizon, 1 − V of the upper half of the sides' view,
    compensate it, so that even surroundings stay even.
    """
    up, hidden = max(nz, 0.0), 1.0 - view
    return (1.0 + hidden * (1.0 + 2.0 * up)) / ((1.0 + up) * (1.0 + hidden))


FINE_STEPS = 128  # between nodes of the airmass: the nearest is good to 2e-4 of the transmittance


@nb.njit(cache=True, fastmath=True, forceinline=True)
def fill_air_row(lights, step, row, known_step, here, width):
    """Fill ``here[row]`` with the lights of a row through the air of a fine step of airmass."""
    low = step // FINE_STEPS
    part = np.float32((step - low * FINE_STEPS) / FINE_STEPS)
    high = min(low + 1, lights.shape[0] - 1)
    for e in range(0 if known_step[row] == step else lights.shape[2]):
        for x in range(width):
            under, over = lights[low, row, e, x], lights[high, row, e, x]
            here[row, e, x] = under + part * (over - under)
    known_step[row] = step


class Bases(NamedTuple):
    """Light of diffuse bases through the air, and working arrays of `pixels`.

    Parameters
    ----------
    lit
        See `projection.Light`.
    step, here
        ``lit`` through the air of one fine step of airmass, and that step, by row.
    base
        Light on a base: sun, surroundings, and each diffuse component.
    around
        Irradiance of each diffuse component on a facet.
    """

    lit: Float[Array, "airmass material light channel"]
    step: Int[Array, "row"]
    here: Float[Array, "row light channel"]
    base: Float[Array, "light"]
    around: Float[Array, "diffuse_component"]


class Place(NamedTuple):
    """Place between probes: `Hits.light_cell`, `light_part`, `sky_here`, and `sky_left` as a share of 1."""

    cell: int
    part_x: int
    part_y: int
    here: float
    left: float


class Probes(NamedTuple):
    """Probes of a frame (`Hits`) and their light (`projection.Light`)."""

    cells: Int[Array, "cell 4"]
    facing: Int[Array, "probe"]
    patches: Int[Array, "probe patch"]
    lit: Float[Array, "probe light_and_2"]
    of_patch: Float[Array, "normal patch"]
    by_patch: Float[Array, "normal patch diffuse_component"]
    near_sun: Float[Array, "normal cap_and_ring diffuse_component"]
    irradiance: Float[Array, "normal diffuse_component"]
    followed: bool


@nb.njit(cache=True, forceinline=True)
def interpolate_angles(at_angle, m, cosine):
    """Interpolate the four values of `MaterialTables.at_angle`."""
    node, part = between_cosines(cosine)
    part = np.float32(part)
    a, b, c, d = at_angle[m, node, 0], at_angle[m, node, 1], at_angle[m, node, 2], at_angle[m, node, 3]
    return (
        a + part * (at_angle[m, node + 1, 0] - a),
        b + part * (at_angle[m, node + 1, 1] - b),
        c + part * (at_angle[m, node + 1, 2] - c),
        d + part * (at_angle[m, node + 1, 3] - d),
    )


@nb.njit(cache=True, forceinline=True)
def groove_factor(hit, sun, slope_rad):
    """Oren–Nayar's factor for the sun's light. [1]"""
    view, sunward = hit.cos_view, hit.cos_sun
    if slope_rad == 0 or sunward <= 0:
        return 1.0
    across = -(hit.dx * sun[0] + hit.dy * sun[1] + hit.dz * sun[2]) - view * sunward
    length = math.sqrt(max((1.0 - view * view) * (1.0 - sunward * sunward), 1e-12))
    return oren_nayar(view, sunward, across / length, slope_rad)


@nb.njit(cache=True, fastmath=True, forceinline=True)
def fill_irradiance(hit, behind, irradiance, around):
    """Irradiance of each diffuse component on a facet in the open, or on its other side."""
    nx, ny, nz = (-hit.nx, -hit.ny, -hit.nz) if behind else (hit.nx, hit.ny, hit.nz)
    if nz > 0.99999:
        for k in range(irradiance.shape[1]):
            around[k] = irradiance[LEVEL_NODE, k]
    else:
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
def fill_around(hit, place, behind, on_body, cells, lit, around):
    """Fill ``around``, without the sky if ``on_body``, and return the open part of the cap about the sun."""
    nz, view = -hit.nz if behind else hit.nz, 1.0 if behind else hit.sky_view
    off = surface_gain(place.here, 0.5 * (1.0 + nz) * view / max(place.left, 1e-3))
    others, by_sky = (off * tilt_gain(hit.nz, view), 0.0) if on_body else (off, float(place.here))
    return blend_cell(place, behind, by_sky, (off, others), cells, lit, around)


@nb.njit(cache=True, fastmath=True, forceinline=True)
def take_near_sun(hit, cap, here, near_sun, around):
    """Subtract the light near the sun that objects smaller than the lattice hide from a facet."""
    node, hidden = node_of_normal(hit.nx, hit.ny, hit.nz), 1.0 - hit.sunlight
    by_cap = np.float32(hidden * here * CAP_LOST * cap * cap)
    by_ring = np.float32(hidden * here * RING_LOST * cap * cap * cap)
    for e in range(around.shape[0]):
        around[e] -= by_cap * near_sun[node, 0, e] + by_ring * near_sun[node, 1, e]


@nb.njit(cache=True, fastmath=True, forceinline=True)
def set_diffuse(hit, place, scale, behind, followed, base, around):
    """Set ``base[1:]``, light of surroundings and sky on a facet or its other side; return `mirror_place`."""
    nz, view = -hit.nz if behind else hit.nz, 1.0 if behind else hit.sky_view
    sky_part, off, strength, mirrored = 0.5 * (1.0 + nz) * view, 1.0, np.float32(scale * view), (view, 1.0)
    if place.cell != OPEN:
        strength = np.float32(scale * place.left)
        off = 0.0 if followed else 1.0
        mirrored = mirror_place(around, place.left, sky_part, followed)
    base[1] = off * scale * (1.0 - sky_part)
    for k in range(base.shape[0] - 2):
        base[2 + k] = strength * around[k]
    return mirrored


@nb.njit(cache=True, fastmath=True, forceinline=True)
def add_base_light(base, lights, row, share, q, u, width, total):
    """Add a share of a base's light; ``q`` and ``u`` are its polarized parts, the same in every channel."""
    last = lights.shape[1] - 1
    for e in range(0, lights.shape[1], 4):  # four at a time: sums are read and written a quarter as often
        e1, e2, e3 = min(e + 1, last), min(e + 2, last), min(e + 3, last)
        a = share * base[e]
        b = share * base[e1] if e1 > e else np.float32(0.0)
        c = share * base[e2] if e2 > e1 else np.float32(0.0)
        d = share * base[e3] if e3 > e2 else np.float32(0.0)
        for x in range(width):
            near = a * lights[row, e, x] + b * lights[row, e1, x]
            light = near + c * lights[row, e2, x] + d * lights[row, e3, x]
            total[0, x] += light
            total[1, x] += q * light
            total[2, x] += u * light
