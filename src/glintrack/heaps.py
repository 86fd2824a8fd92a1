"""Let the threads of a process share what each of them frees."""

import ctypes
import os
import sys

_M_ARENA_MAX = -8  # of glibc's malloc.h
_HEAPS = 2


def share_heaps() -> bool:
    """Hold glibc to two heaps for all threads; to be called before there are any.

    By default each thread has one of its own and keeps what was freed in it: a tenth of a flight's memory.

    Returns
    -------
    Whether it is so; not under another C library, nor where ``MALLOC_ARENA_MAX`` says something else.
    """
    if sys.platform != "linux" or "MALLOC_ARENA_MAX" in os.environ:
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    return mallopt is not None and mallopt(_M_ARENA_MAX, _HEAPS) == 1
