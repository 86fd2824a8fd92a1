"""Angles of many rays at once, and the mottle where they end: loops that a compiler runs in lanes.

As in `facets`, one array holds a row of `MOST` for each quantity, all in single precision.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array

MOST = 256  # rays at a time
INCIDENCE_FIELDS = 15
DX, DY, DZ, NX, NY, NZ, _PX, _PY, _PZ, _CONTRAST, VIEW, SUNWARD, TURN_C, TURN_S, MOTTLE = (
    MOST * k for k in range(INCIDENCE_FIELDS)
)
_LATTICE = 256  # cells of the mottle before it repeats: 1 km for the finer octave
_APART = 77  # cells between the octaves
_ZERO, _ONE, _TWO, _THREE, _FINE, _COARSE = (np.float32(x) for x in (0, 1, 2, 3, 0.25, 0.0625))
_LEAN_X, _LEAN_Y = (
    np.float32(0.37),
    np.float32(0.61),
)  # of the lattice's planes, so that walls are mottled too
_NORMAL_INCIDENCE = np.float32(1e-12)


class Hit(NamedTuple):
    """One ray and the surface that it meets.

    Parameters
    ----------
    dx, dy, dz, nx, ny, nz
        Direction of look, and the facet's normal toward the lens. [1]
    cos_view, cos_sun
        Cosines of the angles from the normal to the lens and to the sun. [1]
    sunlight, sky_view
        Part of the sun's light that arrives, and sky view factor. [1]
    material, ray
        Which material, which ray.
    """

    dx: float
    dy: float
    dz: float
    nx: float
    ny: float
    nz: float
    cos_view: float
    cos_sun: float
    sunlight: float
    sky_view: float
    material: int
    ray: int


@lru_cache(maxsize=1)
def mottle_lattice() -> Float[Array, "cell cell"]:
    """Even noise of zero mean for the mottle; the same in every frame."""
    return np.random.default_rng(5).uniform(-1.6, 1.6, (_LATTICE, _LATTICE)).astype(np.float32)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def meet_rays(j, stop, ray, index, rays, contrasts, sun, lattice, met):
    """Fill ``met`` for the next `MOST` samples at most, from ``ray`` of element ``index[j]`` on.

    Returns
    -------
    How many; and the place in ``index`` and the sample to go on from.
    """
    look, point, normal, axis, first = rays.look, rays.point, rays.normal, rays.axis, rays.first
    k = 0
    while j < stop:
        element = index[j]
        end = first[element + 1]
        while ray < end and k < MOST:
            met[DX + k], met[DY + k], met[DZ + k] = look[element, 0], look[element, 1], look[element, 2]
            met[NX + k], met[NY + k], met[NZ + k] = normal[ray, 0], normal[ray, 1], normal[ray, 2]
            met[_PX + k], met[_PY + k], met[_PZ + k] = point[ray, 0], point[ray, 1], point[ray, 2]
            still = rays.material[ray] >= 0 and rays.vehicle_id[ray] < 0
            met[_CONTRAST + k] = contrasts[rays.material[ray]] if still else 0.0
            ray, k = ray + 1, k + 1
        if ray < end:
            break
        j += 1
        if j < stop:
            ray = first[index[j]]
    _turn(k, np.float32(sun[0]), np.float32(sun[1]), np.float32(sun[2]),
          np.float32(axis[0]), np.float32(axis[1]), np.float32(axis[2]), met)  # fmt: skip
    _mottle(k, lattice, met)
    return k, j, ray


@nb.njit(cache=True, fastmath=True, error_model="numpy", forceinline=True)
def _turn(count, sx, sy, sz, ax, ay, az, met):
    """Cosines toward lens and sun, and the turn from the plane of look and normal to the detector's axis."""
    for k in range(count):
        vx, vy, vz = -met[DX + k], -met[DY + k], -met[DZ + k]
        nx, ny, nz = met[NX + k], met[NY + k], met[NZ + k]
        view = vx * nx + vy * ny + vz * nz
        met[VIEW + k] = view
        met[SUNWARD + k] = sx * nx + sy * ny + sz * nz
        # of the s axis n × v on the detector's, and across it (see `stokes.axis_turn`)
        c = nx * (vy * az - vz * ay) + ny * (vz * ax - vx * az) + nz * (vx * ay - vy * ax)
        s = nx * ax + ny * ay + nz * az - view * (vx * ax + vy * ay + vz * az)
        norm = _ONE / (c * c + s * s + _NORMAL_INCIDENCE)
        met[TURN_C + k] = (c * c - s * s + _NORMAL_INCIDENCE) * norm
        met[TURN_S + k] = _TWO * c * s * norm


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _mottle(count, lattice, met):
    """Smooth value noise about 1 of variance contrast²: patches and wear, on lattices of 4 m and 16 m."""
    for k in range(count):
        contrast = met[_CONTRAST + k]
        met[MOTTLE + k] = _ONE
        if contrast != _ZERO:
            x, y = met[_PX + k] + _LEAN_X * met[_PZ + k], met[_PY + k] + _LEAN_Y * met[_PZ + k]
            noise = _octave(lattice, x * _FINE, y * _FINE, 0)
            noise += _octave(lattice, x * _COARSE, y * _COARSE, _APART)
            met[MOTTLE + k] = max(_ONE + contrast * noise, _ZERO)


@nb.njit(cache=True, fastmath=True, forceinline=True)
def _octave(lattice, px, py, apart):
    i, j = math.floor(px), math.floor(py)
    fx, fy = px - np.float32(i), py - np.float32(j)
    fx, fy = fx * fx * (_THREE - _TWO * fx), fy * fy * (_THREE - _TWO * fy)
    i, j = int(i) + 1000, int(j) + 1000 + apart
    last = _LATTICE - 1  # a power of two: the remainder is a mask
    i0, i1, j0, j1 = i & last, (i + 1) & last, j & last, (j + 1) & last
    low = lattice[i0, j0] + fy * (lattice[i0, j1] - lattice[i0, j0])
    high = lattice[i1, j0] + fy * (lattice[i1, j1] - lattice[i1, j0])
    return low + fx * (high - low)
