"""Large arrays whose memory goes on to the next that asks once nobody holds them.

Fresh memory must be cleared by the system, two megabytes at a time, and what a frame needs, the next one
needs again.
"""

import math
from collections import deque
from typing import Any

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array

LEAST_BYTES, MOST_BYTES = 1 << 22, 1 << 27  # of an array: smaller and larger ones are the system's
_ROOM = 1.3  # over what is asked for: frames differ, and what is not written takes no memory
_OUTGROWN = 0.75  # of what is asked for: who asks had that piece before
# pieces that wait for somebody, the oldest goes if too many do; any thread takes and gives back in one step
_idle: deque[Array] = deque(maxlen=2)


class _Loan:
    """A piece of memory as NumPy takes it in; each array of it holds the loan, and its end gives it back."""

    def __init__(self, memory: Array, shape: tuple[int, ...]):
        self._memory, self._home = memory, _idle
        place: dict[str, Any] = {"data": (memory.ctypes.data, False), "version": 3}
        self.__array_interface__ = place | {"shape": shape, "typestr": np.dtype(np.float32).str}

    def __del__(self):
        """Nobody holds it."""
        self._home.append(self._memory)


def lent(*shape: int) -> Float[Array, "..."]:
    """An array of this shape, not cleared: it holds what an earlier one held, or anything if it is small."""
    size = 4 * math.prod(shape)
    if not LEAST_BYTES <= size <= MOST_BYTES:
        return np.empty(shape, np.float32)
    memory = _piece_of(size)
    return np.asarray(_Loan(np.zeros(int(_ROOM * size), np.uint8) if memory is None else memory, shape))


def _piece_of(size: int) -> Array | None:
    """A piece that waits, large enough and not twice as large; what is outgrown goes."""
    for _ in range(len(_idle)):
        try:
            memory = _idle.popleft()
        except IndexError:  # another thread was first
            return None
        if size <= memory.nbytes <= 2 * size:
            return memory
        if not _OUTGROWN * size < memory.nbytes < size:
            _idle.append(memory)
    return None
