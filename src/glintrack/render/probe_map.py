"""Places of probes: a sparse lattice of any extent, addressed by hash, on the surfaces that ask for it.

A surface asks the four lattice points around it, carried along the axis its normal is nearest to onto its
own plane: a probe then stands on the surface, not in the air beside it. Leaf cards and what moves ask at
their own height. The key of a probe holds its kind, the facet's direction (289 classes) and the place in
steps of the lattice, so that what is found there does not depend on who asked first.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.arrays import Array

# kinds: on a surface that stands, the same where what is seen changes fast, before what moves, in a crown
FACET, FINE, MOVING, LEAF = range(4)
STEPS_M = np.array([2.0, 0.7, 4.0, 2.0])  # of the lattice, by kind
RISE_M = np.array([0.25, 0.25, 1.0, 1.0])  # steps of the third coordinate
CLASSES = 17  # of normals along each side of the unfolded octahedron; odd: level ground has its own
_HALF, _BITS = 1 << 16, 17  # lattice coordinates −65536 to 65535: 130 km
_EMPTY = -1
_SHIFT = np.array([0.31, 0.43, 0.13])  # of a step: walls on whole metres lie between lattice points


class ProbeMap(NamedTuple):
    """Open addressing: ``keys`` [1] and the row of each probe; capacity a power of two."""

    keys: Int[Array, "slot"]
    rows: Int[Array, "slot"]


class Places(NamedTuple):
    """Where probes are: centre [m], direction faced (zero for leaves) and kind of each."""

    centre: Float[Array, "probe 3"]
    facing: Float[Array, "probe 3"]
    kind: Int[Array, "probe"]


def empty_map(capacity: int) -> ProbeMap:
    """A map without probes."""
    return ProbeMap(np.full(capacity, _EMPTY, np.int64), np.full(capacity, _EMPTY, np.int32))


def class_normals() -> Float[Array, "class 3"]:
    """Unit vector at the middle of each class."""
    middle = (np.arange(CLASSES) + 0.5) / CLASSES * 2 - 1
    a, b = (side.ravel() for side in np.meshgrid(middle, middle, indexing="ij"))
    up = 1 - np.abs(a) - np.abs(b)
    east = np.where(up < 0, np.copysign(1 - np.abs(b), a), a)
    north = np.where(up < 0, np.copysign(1 - np.abs(a), b), b)
    normals = np.stack([east, north, up], axis=1)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _main_axes() -> Int[Array, "class"]:
    """The axis that each class is nearest to: along it the lattice is carried onto a facet."""
    return np.argmax(np.abs(class_normals()) * [1.0, 1.0, 1.0001], axis=1)


_MAIN_AXIS = _main_axes()


@nb.njit(cache=True)
def slot_of(keys, key):
    """Slot that holds the key, or the free one where it would go."""
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    last = keys.size - 1
    slot = np.int64(mixed >> np.uint64(40)) & last
    while keys[slot] != key and keys[slot] != _EMPTY:
        slot = (slot + 1) & last
    return slot


@nb.njit(cache=True)
def normal_class(nx, ny, nz):
    """Class of a direction on the unfolded octahedron."""
    scale = 1.0 / max(abs(nx) + abs(ny) + abs(nz), 1e-12)
    a, b = nx * scale, ny * scale
    if nz < 0:
        a, b = math.copysign(1 - abs(b), a), math.copysign(1 - abs(a), b)
    last = CLASSES - 1
    return min(int((a + 1) * 0.5 * CLASSES), last) * CLASSES + min(int((b + 1) * 0.5 * CLASSES), last)


@nb.njit(cache=True)
def axis_class(nx, ny, nz):
    """Class of the axis a direction is nearest to."""
    ax, ay, az = abs(nx), abs(ny), abs(nz)
    if az >= ax and az >= ay:
        return normal_class(0.0, 0.0, math.copysign(1.0, nz))
    if ax >= ay:
        return normal_class(math.copysign(1.0, nx), 0.0, 0.0)
    return normal_class(0.0, math.copysign(1.0, ny), 0.0)


@nb.njit(cache=True)
def corner_keys(px, py, pz, nx, ny, nz, kind, scale, keys, parts):
    """Keys of the four probes around a point of a facet, and its place among them in ``parts``."""
    step, rise = STEPS_M[kind] * scale, RISE_M[kind] * scale
    along = 2
    if kind <= FINE:
        facing = normal_class(nx, ny, nz)
        along = _MAIN_AXIS[facing]
    elif kind == MOVING:
        facing = axis_class(nx, ny, nz)
    else:
        facing = normal_class(0.0, 0.0, 1.0)
    if along == 2:
        u, v, w, nu, nv, nw = px, py, pz, nx, ny, nz
    elif along == 0:
        u, v, w, nu, nv, nw = py, pz, px, ny, nz, nx
    else:
        u, v, w, nu, nv, nw = pz, px, py, nz, nx, ny
    x, y = u / step - _SHIFT[0], v / step - _SHIFT[1]
    i, j = math.floor(x), math.floor(y)
    parts[0], parts[1] = x - i, y - j
    for corner in range(4):
        a, b = i + (corner & 1), j + (corner >> 1)
        height = w
        if kind <= FINE:
            height -= (nu * ((a + _SHIFT[0]) * step - u) + nv * ((b + _SHIFT[1]) * step - v)) / nw
        c = math.floor(height / rise - _SHIFT[2] + 0.5)
        key = np.int64(kind * 512 + facing)
        for place in (a, b, c):
            bounded = min(max(np.int64(place) + _HALF, 0), 2 * _HALF - 1)
            key = (key << _BITS) | bounded
        keys[corner] = key


def places_of(keys: Int[Array, "probe"], scale: float, lift_m: float) -> Places:
    """Where the probes of some keys are, lifted off their facets."""
    mask = (1 << _BITS) - 1
    steps = [((keys >> (_BITS * k)) & mask) - _HALF for k in (2, 1, 0)]
    kind, facing = keys >> (3 * _BITS + 9), (keys >> (3 * _BITS)) & 511
    normal = class_normals()[facing]
    step, rise = STEPS_M[kind] * scale, RISE_M[kind] * scale
    u, v = (steps[0] + _SHIFT[0]) * step, (steps[1] + _SHIFT[1]) * step
    w = (steps[2] + _SHIFT[2]) * rise
    along = np.where(kind <= FINE, _MAIN_AXIS[facing], 2)
    centre = np.stack([u, v, w], axis=1)
    for axis, order in ((0, (2, 0, 1)), (1, (1, 2, 0))):  # (u, v, w) is (y, z, x) or (z, x, y)
        mine = along == axis
        centre[mine] = centre[mine][:, order]
    centre += lift_m * np.where((kind <= FINE)[:, None], normal, 0.0)
    normal = np.where((kind == LEAF)[:, None], 0.0, normal)
    return Places(centre.astype(np.float32), normal.astype(np.float32), kind)
