"""Irradiance at probes, by diffuse component, and how surfaces read it; for the kernel in `pixels`.

    E_e(place) = h Σ_b v_b G_e,b(n) + g Σ_j u_j B_e,j

with v the open part of each patch of the sky, G the patch's irradiance on a facet of the probe's normal, u
the light that surfaces send (`bounce`), B what of it belongs to a component; both between the probes around
the place. h is `Hits.sky_here`, and g how much more surfaces it then sees than the probes do, (1 − s)/(1 −
s/h), s the part of the place's hemisphere that is sky, held to ½ … 2.

What is smaller than the lattice hides the sun from a facet, and the bright sky about the sun with it, while
the probes around see both. A facet in the shade whose probes see the part v of the cap about the sun loses
0.85 v² of the cap's light and 0.55 v³ of that of the ring about it: chosen by rays from shaded points of
roads, lawns and roofs of the default city under two suns (path tracing), with h = 1.
With h the same rays give 0.82 and 0.49, by which shaded roads are 0.14 % brighter: too little to change it.
"""

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.render.hits import Hits, samples_of
from glintrack.render.probe_lookup import SPACE

_FEW = 0.05  # of a frame's elements: for fewer only the probes that they need are lit
CAP_LOST, RING_LOST = 0.85, 0.55
MOST_MORE = 2.0  # surfaces that a place sees over what the probes around it see
_PROBES = 64  # lit together
_LANES = 16  # a multiple of so many components are summed
LEAST_WEIGHT = 1e-3  # of a probe around a surface: so that one that is alone lights it


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
    one, least = np.float32(1.0), np.float32(LEAST_WEIGHT)
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
