"""Let the threads of a process share what each of them frees, and the system have it back."""

import ctypes
import os
import sys
from collections.abc import Callable
from functools import lru_cache

_M_ARENA_MAX = -8  # of glibc's malloc.h
_HEAPS = 2
KEPT_BYTES = 2_200_000_000  # of a process: up to that, what is freed waits for the next that fits


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


def return_freed(above_bytes: int = KEPT_BYTES) -> None:
    """Give back to the system what was freed and lies between what is in use.

    glibc keeps it for the next that fits. What goes back is cleared anew when it is asked for again, a tenth
    of a frame's time, so that this is for processes that hold much.

    Parameters
    ----------
    above_bytes
        Of the machine's memory: a process that holds less keeps what it has.
    """
    if _resident_bytes() < above_bytes:
        return
    if (malloc_trim := _of_glibc("malloc_trim")) is not None:
        malloc_trim(0)


def _resident_bytes() -> int:
    """Memory that the process holds; 0 where the system does not tell."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


@lru_cache
def _of_glibc(name: str) -> Callable[..., int] | None:
    """A function of the C library, None where it has none of that name."""
    return getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None
