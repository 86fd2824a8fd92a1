"""Light that the facets of one rough node gather: loops over all its facets that a compiler runs in lanes.

What a facet needs is kept in one array, a row of `MOST` for each quantity, at distances that the compiler
knows: it can then tell that rows do not overlap. All is in single precision, which twice as many lanes hold.
"""

import math

import numba as nb
import numpy as np

from glintrack.render.shading.pbrdf import GGX, masking

MOST = 256  # facets of a node
SHAPE_FIELDS = 5  # a facet's point of the disc (a, b), slope, cosine and sine of its turn
_DISC_A, _DISC_B, _SLOPE, _COS, _SIN = (MOST * k for k in range(SHAPE_FIELDS))
FACET_FIELDS = 10
# weight of a facet that mirrors the sky, and of one that does not; cosines of incidence and of the light's
# angle; turns of the frame on the way in and out; place on the sky's disc
_ABOVE, _BELOW, _INCIDENCE, _IN_C, _IN_S, _OUT_C, _OUT_S, _X, _Y, _LIGHT = (
    MOST * k for k in range(FACET_FIELDS)
)
_ZERO, _HALF, _ONE, _TWO = (np.float32(x) for x in (0.0, 0.5, 1.0, 2.0))
_STEEPEST, _NORMAL_INCIDENCE = np.float32(1e-6), np.float32(1e-12)


@nb.njit(cache=True, forceinline=True)
def draw_facets(normal, view, axis, alpha, distribution, last, shapes, count, facets):
    """Fill ``facets`` for a facet normal and a direction toward the lens, by `pbrdf.sampled_facet`'s method.

    Parameters
    ----------
    normal, view, axis
        Three numbers each; the axis is the detector's. [1]
    alpha, distribution
        Roughness, and index into `DISTRIBUTIONS`.
    last
        Cells along the sky's disc, less one.
    shapes, count
        Of the facets to be drawn, `SHAPE_FIELDS` rows of `MOST`, and how many they are.
    """
    if distribution == GGX:  # a choice made out here leaves a loop without branches
        _draw(normal, view, axis, alpha, True, last, shapes, count, facets)
        return
    _draw(normal, view, axis, alpha, False, last, shapes, count, facets)
    to_lens = view[0] * normal[0] + view[1] * normal[1] + view[2] * normal[2]
    seen = masking(distribution, to_lens, alpha) / to_lens
    for i in range(count):
        weight = np.float32(seen * masking(distribution, float(facets[_LIGHT + i]), alpha))
        facets[_ABOVE + i] *= weight
        facets[_BELOW + i] *= weight


@nb.njit(cache=True, fastmath=True, error_model="numpy", forceinline=True)
def _draw(normal, view, axis, alpha, ggx, last, shapes, count, facets):
    """`draw_facets`; without ``ggx``, facets by area, and masking left out."""
    nx, ny, nz = np.float32(normal[0]), np.float32(normal[1]), np.float32(normal[2])
    vx, vy, vz = np.float32(view[0]), np.float32(view[1]), np.float32(view[2])
    ax, ay, az = np.float32(axis[0]), np.float32(axis[1]), np.float32(axis[2])
    rough, edge = np.float32(alpha), np.float32(last)
    tx, ty, tz = (_ZERO, -nz, ny) if abs(nx) < 0.9 else (nz, _ZERO, -nx)  # x̂ × n or ŷ × n
    norm = _ONE / math.sqrt(tx * tx + ty * ty + tz * tz)
    tx, ty, tz = tx * norm, ty * norm, tz * norm
    bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
    lx, ly, lz = vx * tx + vy * ty + vz * tz, vx * bx + vy * by + vz * bz, vx * nx + vy * ny + vz * nz
    # facets as a view stretched by the roughness sees them (see `pbrdf.visible_normal`)
    gx, gy, gz = rough * lx, rough * ly, lz
    norm = _ONE / math.sqrt(gx * gx + gy * gy + gz * gz)
    gx, gy, gz = gx * norm, gy * norm, gz * norm
    across = math.sqrt(gx * gx + gy * gy)
    t1x, t1y = (-gy / across, gx / across) if across > _STEEPEST else (_ONE, _ZERO)
    t2x, t2y, t2z = -gz * t1y, gz * t1x, gx * t1y - gy * t1x
    tall = _HALF * (_ONE + gz)
    # the axis and its cross product with the view give the turn from the plane of incidence to the detector
    px, py, pz = vy * az - vz * ay, vz * ax - vx * az, vx * ay - vy * ax
    view_axis = vx * ax + vy * ay + vz * az
    for i in range(count):
        if ggx:
            a, b = shapes[_DISC_A + i], shapes[_DISC_B + i]
            b = (_ONE - tall) * math.sqrt(max(_ONE - a * a, _ZERO)) + tall * b
            c = math.sqrt(max(_ONE - a * a - b * b, _ZERO))
            u = rough * (a * t1x + b * t2x + c * gx)
            v = rough * (a * t1y + b * t2y + c * gy)
            w = max(b * t2z + c * gz, _STEEPEST)
            norm = _ONE / math.sqrt(u * u + v * v + w * w)
        else:
            tangent = rough * shapes[_SLOPE + i]
            u, v, w = tangent * shapes[_COS + i], tangent * shapes[_SIN + i], _ONE
            norm = _ONE / math.sqrt(_ONE + tangent * tangent)
        u, v, w = u * norm, v * norm, w * norm
        cosine = lx * u + ly * v + lz * w
        light = _TWO * cosine * w - lz
        # Smith's masking of GGX without a division by the cosine
        tilted = light * light + rough * rough * (_ONE - light * light)
        weight = _TWO * light / (light + math.sqrt(max(tilted, _ZERO)))
        if not ggx:
            weight = cosine / w
        if light <= _ZERO or cosine <= _ZERO:
            weight = _ZERO
        hx, hy, hz = u * tx + v * bx + w * nx, u * ty + v * by + w * ny, u * tz + v * bz + w * nz
        rx, ry, rz = _TWO * cosine * hx - vx, _TWO * cosine * hy - vy, _TWO * cosine * hz - vz
        facets[_INCIDENCE + i] = min(max(cosine, _ZERO), _ONE)
        facets[_ABOVE + i] = weight if rz > _ZERO else _ZERO
        facets[_BELOW + i] = _ZERO if rz > _ZERO else weight
        c = hx * px + hy * py + hz * pz
        s = hx * ax + hy * ay + hz * az - cosine * view_axis
        norm = _ONE / (c * c + s * s + _NORMAL_INCIDENCE)
        facets[_OUT_C + i] = (c * c - s * s + _NORMAL_INCIDENCE) * norm
        facets[_OUT_S + i] = _TWO * c * s * norm
        # the s axis on north and east, carried from the zenith (see `sky.carried_north`)
        sx, sy, sz = hy * vz - hz * vy, hz * vx - hx * vz, hx * vy - hy * vx
        scale = _ONE / (_ONE + abs(rz))
        c = sy - ry * (scale * (sx * rx + sy * ry) + sz)
        s = sx - rx * (scale * (sx * rx + sy * ry) + sz)
        norm = _ONE / (c * c + s * s + _NORMAL_INCIDENCE)
        facets[_IN_C + i] = (c * c - s * s + _NORMAL_INCIDENCE) * norm
        facets[_IN_S + i] = _TWO * c * s * norm
        facets[_X + i] = min(max((rx * scale + _ONE) * _HALF * edge, _ZERO), edge)
        facets[_Y + i] = min(max((ry * scale + _ONE) * _HALF * edge, _ZERO), edge)
        facets[_LIGHT + i] = light


@nb.njit(cache=True, fastmath=True, error_model="numpy", forceinline=True)
def add_even(facets, count, fresnel, first, cosines):
    """I, Q and U of an even unit light above the horizon, then of one below, that all facets mirror.

    ``fresnel[first:]`` holds m00, m01 and m22 of a Fresnel term at so many evenly spread cosines.
    """
    above_i, above_q, above_u = _ZERO, _ZERO, _ZERO
    below_i, below_q, below_u = _ZERO, _ZERO, _ZERO
    last = np.float32(cosines - 1)
    for i in range(count):
        x = facets[_INCIDENCE + i] * last
        node = min(int(x), cosines - 2)
        part, at = x - np.float32(node), first + 3 * node
        m00 = fresnel[at] + part * (fresnel[at + 3] - fresnel[at])
        m01 = fresnel[at + 1] + part * (fresnel[at + 4] - fresnel[at + 1])
        above, below = facets[_ABOVE + i], facets[_BELOW + i]
        q, u = m01 * facets[_OUT_C + i], -m01 * facets[_OUT_S + i]
        above_i, above_q, above_u = above_i + above * m00, above_q + above * q, above_u + above * u
        below_i, below_q, below_u = below_i + below * m00, below_q + below * q, below_u + below * u
    return above_i, above_q, above_u, below_i, below_q, below_u


@nb.njit(cache=True, fastmath=True, error_model="numpy", forceinline=True)
def _sent(sky, at, m00, m01, m22, weight, c_in, s_in, c_out, s_out):
    """I, Q and U that one facet mirrors of the light at a place in the sky."""
    light = sky[at]
    q, u = c_in * sky[at + 1] + s_in * sky[at + 2], c_in * sky[at + 2] - s_in * sky[at + 1]
    i = weight * (m00 * light + m01 * q)
    q, u = weight * (m01 * light + m00 * q), weight * m22 * u
    return i, c_out * q + s_out * u, c_out * u - s_out * q


@nb.njit(cache=True, fastmath=True, error_model="numpy", forceinline=True)
def add_sky(facets, count, fresnel, first, cosines, sky, cells, skies, one, other):
    """I, Q and U of two components of the sky that all facets mirror; ``sky`` is `Sky.sky_map` in one row.

    Each facet sees the nearest cell of the disc: of many facets that is as good as between cells.
    """
    sum_i, sum_q, sum_u = _ZERO, _ZERO, _ZERO
    more_i, more_q, more_u = _ZERO, _ZERO, _ZERO
    last = np.float32(cosines - 1)
    for i in range(count):
        x = facets[_INCIDENCE + i] * last
        node = min(int(x), cosines - 2)
        part, at = x - np.float32(node), first + 3 * node
        m00 = fresnel[at] + part * (fresnel[at + 3] - fresnel[at])
        m01 = fresnel[at + 1] + part * (fresnel[at + 4] - fresnel[at + 1])
        m22 = fresnel[at + 2] + part * (fresnel[at + 5] - fresnel[at + 2])
        cell = 3 * skies * (int(facets[_X + i] + _HALF) * cells + int(facets[_Y + i] + _HALF))
        weight, c_in, s_in = facets[_ABOVE + i], facets[_IN_C + i], facets[_IN_S + i]
        c_out, s_out = facets[_OUT_C + i], facets[_OUT_S + i]
        sent = _sent(sky, cell + 3 * one, m00, m01, m22, weight, c_in, s_in, c_out, s_out)
        sum_i, sum_q, sum_u = sum_i + sent[0], sum_q + sent[1], sum_u + sent[2]
        sent = _sent(sky, cell + 3 * other, m00, m01, m22, weight, c_in, s_in, c_out, s_out)
        more_i, more_q, more_u = more_i + sent[0], more_q + sent[1], more_u + sent[2]
    return sum_i, sum_q, sum_u, more_i, more_q, more_u
