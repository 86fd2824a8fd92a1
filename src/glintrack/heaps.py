"""Let the threads of a process share what each of them frees, and the system have it back."""

import ctypes
import os
import sys
from collections.abc import Callable
from functools import lru_cache

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
    mallopt = _of_glibc("mallopt")
    return mallopt is not None and mallopt(_M_ARENA_MAX, _HEAPS) == 1


def return_freed() -> None:
    """Give back to the system what was freed and lies between what is in use.

    glibc keeps it for the next that fits; where large arrays of many sizes come and go, little does.
    """
    if (malloc_trim := _of_glibc("malloc_trim")) is not None:
        malloc_trim(0)


@lru_cache
def _of_glibc(name: str) -> Callable[..., int] | None:
    """A function of the C library, None where it has none of that name."""
    return getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None
