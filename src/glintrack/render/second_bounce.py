"""Which rays of a probe go on from where they end, and where to: light that reached it over two surfaces.

Every third ray that is blocked goes on, in a direction spread by the cosine about the normal where it ended;
of a leaf from the front and from the back in turn. The direction depends on how many of the probe's went on
before, and on its place: neighbours have others, and share what they find.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.core.arrays import Array

EVERY = 3  # of blocked rays, one goes on
_ONWARD_M = 3e-3  # off the facet, as `resolve.SHADOW_OFFSET_M`
# steps that spread points evenly over a square (Roberts, "The Unreasonable Effectiveness of Quasirandom
# Sequences", 2018): 1/x and 1/x² with x³ = x + 1
_STEPS = (0.7548776662466927, 0.5698402909980532)
_THIRD = 0.3247179572447460  # 1 − 1/x³: of a place's third coordinate


class Onward(NamedTuple):
    """Rays that go on.

    Parameters
    ----------
    of
        Number of the ray onward from each ray's end; −1 for none.
    behind
        Whether it left a leaf's other side.
    start, direction
        Where it starts [m], and its unit vector [1].
    """

    of: Int[Array, "ray"]
    behind: Bool[Array, "onward"]
    start: Float[Array, "onward 3"]
    direction: Float[Array, "onward 3"]


def rays_onward(
    first: Int[Array, "probe+1"],
    centre: Float[Array, "probe 3"],
    sets: Int[Array, "probe"],
    material: Int[Array, "ray"],
    point: Float[Array, "ray 3"],
    normal: Float[Array, "ray 3"],
    translucent: Bool[Array, "material"],
) -> Onward:
    """Rays that go on from where those of some probes end.

    Parameters
    ----------
    first, centre, sets
        First ray of each probe, and one more; where each stands [m], and which set of directions it has.
    material, point, normal
        Of where each ends; material −1 for sky.
    translucent
        Which materials let light through.
    """
    of = np.full(len(material), -1, np.int32)
    count = _number(first, sets, material, of)
    rays = Onward(of, np.empty(count, np.bool_), *(np.empty((count, 3), np.float32) for _ in range(2)))
    _aim(first, centre, sets, material, point, normal, translucent, rays)
    return rays


@nb.njit(nogil=True, cache=True)
def _number(first, sets, material, of):
    count = 0
    for p in range(len(sets)):
        blocked = sets[p]
        for ray in range(first[p], first[p + 1]):
            if material[ray] >= 0:
                if blocked % EVERY == 0:
                    of[ray] = count
                    count += 1
                blocked += 1
    return count


@nb.njit(nogil=True, cache=True)
def _aim(first, centre, sets, material, point, normal, translucent, rays):
    for p in range(len(sets)):
        x, y, z = float(centre[p, 0]), float(centre[p, 1]), float(centre[p, 2])
        along = x * _STEPS[0] + y * _STEPS[1] + z * _THIRD
        across = x * _STEPS[1] + y * _THIRD + z * _STEPS[0]
        before = 0
        for ray in range(first[p], first[p + 1]):
            onward = rays.of[ray]
            if onward < 0:
                continue
            before += 1
            u, v = (along + before * _STEPS[0]) % 1.0, (across + before * _STEPS[1]) % 1.0
            behind = translucent[material[ray]] and (before + sets[p]) % 2 == 1
            side = -1.0 if behind else 1.0
            nx, ny, nz = side * normal[ray, 0], side * normal[ray, 1], side * normal[ray, 2]
            up, out, turn = math.sqrt(1.0 - u), math.sqrt(u), 2 * math.pi * v
            s, t = out * math.cos(turn), out * math.sin(turn)
            # an upright frame about the normal (Duff et al., J. Computer Graphics Techniques 6, 2017)
            sign = 1.0 if nz >= 0 else -1.0
            a = -1.0 / (sign + nz)
            b = nx * ny * a
            rays.behind[onward] = behind
            rays.direction[onward, 0] = s * (1 + sign * nx * nx * a) + t * b + up * nx
            rays.direction[onward, 1] = s * sign * b + t * (sign + ny * ny * a) + up * ny
            rays.direction[onward, 2] = -s * sign * nx - t * ny + up * nz
            for c in range(3):
                rays.start[onward, c] = point[ray, c] + side * _ONWARD_M * normal[ray, c]
