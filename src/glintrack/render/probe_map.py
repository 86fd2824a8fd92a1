"""Places of probes: a sparse lattice of any extent, addressed by hash, on the surfaces that ask for it.

A facet asks the four lattice points around it, carried along the axis its normal is nearest to onto its own
plane: a probe then stands on the surface, not in the air beside it. Trees and hedges ask the one nearest in
space. The key of a probe holds its kind, the node of its normal (`normals`) and the place in steps of the
lattice, the key of a cell is mixed from those of its four probes: what is found does not depend on who asked
first. Beyond the scene's window, where only the margin's houses and trees rise, steps are twice as long.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.render.shading.normals import NORMAL_NODES, node_normals, on_square

FACET, FAR_FACET, VOLUME, FAR_VOLUME = range(4)  # kinds: on a facet, in a crown; each beyond the window
STEPS_M = np.array([2.0, 4.0, 2.0, 4.0])  # of the lattice, by kind
RISE_M = np.array([0.5, 0.5, 1.0, 2.0])  # steps of the third coordinate
LIFT_M = 0.3  # off the facet: over kerbs, and over the rounding of the third coordinate
LEVEL = NORMAL_NODES**2 // 2  # node of level ground
_MIXED_BY, _MARK = np.uint64(0x9E3779B97F4A7C15), np.uint64(1 << 63)  # keys of cells are negative
_NEARLY_LEVEL = 0.97  # upward component of normals that are taken as level: roads, lawns
_HALF, _BITS = 1 << 15, 16  # lattice coordinates −32768 to 32767: 130 km
_CLASS_BITS = 11
EMPTY = -1
_SHIFT = np.array([0.31, 0.43, 0.13])  # of a step: walls on whole metres lie between lattice points


class ProbeMap(NamedTuple):
    """Open addressing: ``keys`` [1] and the number of each; capacity a power of two."""

    keys: Int[Array, "slot"]
    numbers: Int[Array, "slot"]


class Places(NamedTuple):
    """Where probes are: centre [m], node of the normal faced, kind, and which set of directions."""

    centre: Float[Array, "probe 3"]
    facing: Int[Array, "probe"]
    kind: Int[Array, "probe"]
    set: Int[Array, "probe"]


def empty_map(capacity: int) -> ProbeMap:
    """A map without probes."""
    return ProbeMap(np.full(capacity, EMPTY, np.int64), np.full(capacity, EMPTY, np.int32))


_MAIN_AXIS = np.argmax(np.abs(node_normals()) * [1.0, 1.0, 1.0001], axis=1)


@nb.njit(cache=True)
def slot_of(keys, key):
    """Slot that holds the key, or the free one where it would go."""
    last = keys.size - 1
    slot = _first_slot(keys, key)
    while keys[slot] != key and keys[slot] != EMPTY:
        slot = (slot + 1) & last
    return slot


@nb.njit(cache=True, forceinline=True)
def _first_slot(keys, key):
    mixed = np.uint64(key) * _MIXED_BY
    return np.int64(mixed >> np.uint64(40)) & (keys.size - 1)


@nb.njit(cache=True)
def nearest_node(nx, ny, nz):
    """The node of `node_normals` next to a unit vector; that of level ground for what is nearly level."""
    if nz > _NEARLY_LEVEL:
        return LEVEL
    x, y = on_square(nx, ny, nz, NORMAL_NODES)
    return int(x + 0.5) * NORMAL_NODES + int(y + 0.5)


@nb.njit(cache=True)
def _key(kind, facing, a, b, c):
    key = np.int64((kind << _CLASS_BITS) | facing)
    for place in (a, b, c):
        bounded = min(max(np.int64(place) + _HALF, 0), 2 * _HALF - 1)
        key = (key << _BITS) | bounded
    return key


@nb.njit(cache=True)
def volume_key(px, py, pz, kind, scale):
    """Key of the probe in a crown that is nearest to a point."""
    step, rise = STEPS_M[kind] * scale, RISE_M[kind] * scale
    a, b = math.floor(px / step - _SHIFT[0] + 0.5), math.floor(py / step - _SHIFT[1] + 0.5)
    return _key(kind, 0, a, b, math.floor(pz / rise - _SHIFT[2] + 0.5))


@nb.njit(cache=True)
def facet_cell(px, py, pz, nx, ny, nz, kind, scale):
    """Key of the cell around a point of a facet, by all its four probes, and its place there (0 to 1)."""
    facing, u, v, w, nu, nv, nw = _carried(px, py, pz, nx, ny, nz)
    step = STEPS_M[kind] * scale
    x, y = u / step - _SHIFT[0], v / step - _SHIFT[1]
    i, j = math.floor(x), math.floor(y)
    key = np.uint64(0)
    for corner in range(4):
        one = _corner(kind, facing, i + (corner & 1), j + (corner >> 1), u, v, w, nu, nv, nw, scale)
        key = (key ^ np.uint64(one)) * _MIXED_BY
        key ^= key >> np.uint64(29)
    return np.int64(key | _MARK), x - i, y - j


@nb.njit(cache=True)
def facet_corners(px, py, pz, nx, ny, nz, kind, scale, keys):
    """Keys of the four probes around a point of a facet."""
    facing, u, v, w, nu, nv, nw = _carried(px, py, pz, nx, ny, nz)
    step = STEPS_M[kind] * scale
    i, j = math.floor(u / step - _SHIFT[0]), math.floor(v / step - _SHIFT[1])
    for corner in range(4):
        a, b = i + (corner & 1), j + (corner >> 1)
        keys[corner] = _corner(kind, facing, a, b, u, v, w, nu, nv, nw, scale)


@nb.njit(cache=True, forceinline=True)
def _carried(px, py, pz, nx, ny, nz):
    """Node of a normal, and place and normal with the axis last that it is nearest to."""
    facing = nearest_node(nx, ny, nz)
    along = _MAIN_AXIS[facing]
    if along == 2:
        return facing, px, py, pz, nx, ny, nz
    if along == 0:
        return facing, py, pz, px, ny, nz, nx
    return facing, pz, px, py, nz, nx, ny


@nb.njit(cache=True, forceinline=True)
def _corner(kind, facing, a, b, u, v, w, nu, nv, nw, scale):
    """Key of a lattice point on a facet's plane."""
    step = STEPS_M[kind] * scale
    height = w - (nu * ((a + _SHIFT[0]) * step - u) + nv * ((b + _SHIFT[1]) * step - v)) / nw
    return _key(kind, facing, a, b, math.floor(height / (RISE_M[kind] * scale) - _SHIFT[2] + 0.5))


def kind_of(keys: Int[Array, "probe"]) -> Int[Array, "probe"]:
    """Kinds of the probes of some keys."""
    return keys >> (3 * _BITS + _CLASS_BITS)


def places_of(keys: Int[Array, "probe"], scale: float) -> Places:
    """Where the probes of some keys are, lifted off their facets."""
    mask = (1 << _BITS) - 1
    place = np.stack([((keys >> (_BITS * k)) & mask) - _HALF for k in (2, 1, 0)], axis=1)
    facing = (keys >> (3 * _BITS)) & ((1 << _CLASS_BITS) - 1)
    kind = kind_of(keys)
    on_facet = kind <= FAR_FACET
    size = scale * np.stack([STEPS_M[kind], STEPS_M[kind], RISE_M[kind]], axis=1)
    centre = (place + _SHIFT) * size
    along = np.where(on_facet, _MAIN_AXIS[facing], 2)
    for axis, order in ((0, (2, 0, 1)), (1, (1, 2, 0))):  # (u, v, w) is (y, z, x) or (z, x, y)
        centre[along == axis] = centre[along == axis][:, order]
    centre += max(LIFT_M, 0.6 * scale * 0.5) * np.where(on_facet[:, None], node_normals()[facing], 0.0)
    parity = (place[:, 0] & 1) | (place[:, 1] & 1) << 1
    return Places(centre.astype(np.float32), facing, kind, parity)
