"""Large arrays whose memory goes on to the next that asks once nobody holds them.

Fresh memory must be cleared by the system, two megabytes at a time, and what a frame needs, the next one
needs again.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from glintrack.arrays import Array

MOST_BYTES = 1 << 27  # of an array: larger ones are the system's
_IDLE: list[Array] = []  # taken and given back by any thread: a list's methods hold Python's lock
_KEPT = 4  # pieces that wait for somebody
_ROOM = 1.1  # over what is asked for: frames differ in what they hold


class _Loan:
    """A piece of memory as NumPy takes it in; each array of it holds the loan, and its end gives it back."""

    def __init__(self, memory: Array, shape: tuple[int, ...]):
        self._memory, self._idle = memory, _IDLE
        place: dict[str, Any] = {"data": (memory.ctypes.data, False), "version": 3}
        self.__array_interface__ = place | {"shape": shape, "typestr": np.dtype(np.float32).str}

    def __del__(self):
        """Nobody holds it."""
        if len(self._idle) < _KEPT:
            self._idle.append(self._memory)


def lent(*shape: int) -> Float[Array, "..."]:
    """An array of this shape, not cleared: it holds zeros, or what an earlier one held."""
    size = 4 * math.prod(shape)
    if size > MOST_BYTES:
        return np.empty(shape, np.float32)
    memory = _idle_of(size)
    return np.asarray(_Loan(np.zeros(int(_ROOM * size), np.uint8) if memory is None else memory, shape))


def _idle_of(size: int) -> Array | None:
    """A piece that is large enough and not twice as large, if one waits; the smallest goes if too many do."""
    for _ in range(len(_IDLE)):
        try:
            memory = _IDLE.pop(0)
        except IndexError:  # another thread was first
            return None
        if size <= memory.nbytes <= 2 * size + 4096:
            return memory
        _IDLE.append(memory)
    if len(_IDLE) == _KEPT:
        _IDLE.pop(0)
    return None
