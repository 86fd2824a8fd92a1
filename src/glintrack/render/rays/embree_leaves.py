"""Embree's filter functions for leaf cards: compiled once, called by Embree for every card a ray meets.

Layouts follow Embree 4.4's ``RTCFilterFunctionNArguments``, ``RTCRayN`` and ``RTCHitN``: each field holds n
lanes. A geometry's user pointer is the gaps of its faces; its number is that of its first face in the mesh.
"""

from functools import lru_cache

import numba as nb
import numpy as np
from numba import types
from numba.core import cgutils
from numba.core.ccallback import CFunc
from numba.extending import intrinsic
from numba.np.numpy_support import carray

from glintrack.render.rays.foliage import LEAST_LIGHT, is_hole

_RAY_ID, _HIT_U, _HIT_V, _HIT_FACE, _HIT_GEOMETRY = 10, 3, 4, 5, 6  # fields, in words of n lanes
LIGHT_WORD = 16  # of the query's context, after what Embree keeps there: light left of ray id 0
CONTEXT_WORDS = LIGHT_WORD + 16
_ANY_LENGTH = 1 << 30  # of a buffer whose length the callback does not know


@intrinsic
def _pointer(typing_context, address):
    """An address as a pointer that `carray` takes."""
    del typing_context, address

    def code(context, builder, signature, arguments):
        del context, signature
        return builder.inttoptr(arguments[0], cgutils.voidptr_t)

    return types.voidptr(types.uint64), code


@nb.njit(cache=True)
def _floats(address, length):
    return carray(_pointer(address), length, np.float32)  # pyright: ignore


@nb.njit(cache=True)
def _unsigned(address, length):
    return carray(_pointer(address), length, np.uint32)  # pyright: ignore


@nb.njit(cache=True)
def _signed(address, length):
    return carray(_pointer(address), length, np.int32)  # pyright: ignore


def _pass_holes(arguments):
    """Let rays of look go on through the holes of cards."""
    words = carray(arguments, 6, np.uint64)
    lanes = np.int64(words[5] & np.uint64(0xFFFFFFFF))
    valid = _signed(words[0], lanes)
    gaps = _floats(words[1], _ANY_LENGTH)
    hit = _floats(words[4], 9 * lanes)
    numbers = _unsigned(words[4], 9 * lanes)
    for i in range(lanes):
        if valid[i] != 0:
            k = np.int64(numbers[_HIT_FACE * lanes + i])
            face = k + np.int64(numbers[_HIT_GEOMETRY * lanes + i])
            if is_hole(face, hit[_HIT_U * lanes + i], hit[_HIT_V * lanes + i], gaps[k]):
                valid[i] = 0


def _weaken_light(arguments):
    """Take a card's share of the light and let the rest go on, unless next to nothing is left."""
    words = carray(arguments, 6, np.uint64)
    lanes = np.int64(words[5] & np.uint64(0xFFFFFFFF))
    valid = _signed(words[0], lanes)
    gaps = _floats(words[1], _ANY_LENGTH)
    light = _floats(words[2], CONTEXT_WORDS)
    ray = _unsigned(words[3], 12 * lanes)
    numbers = _unsigned(words[4], 9 * lanes)
    for i in range(lanes):
        if valid[i] != 0:
            k = LIGHT_WORD + np.int64(ray[_RAY_ID * lanes + i])
            light[k] *= gaps[np.int64(numbers[_HIT_FACE * lanes + i])]
            if light[k] >= LEAST_LIGHT:
                valid[i] = 0


@lru_cache(maxsize=1)
def leaf_filters() -> tuple[CFunc, CFunc]:
    """Compiled filters for a geometry's intersect and occluded queries; they live as long as the process."""
    compile_filter = nb.cfunc(types.void(types.voidptr), cache=True)
    return compile_filter(_pass_holes), compile_filter(_weaken_light)
