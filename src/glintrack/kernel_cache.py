"""numba's cache of compiled kernels: damaged files are compiled anew, and what compiling took is counted.

numba takes a missing file for a kernel that is not compiled yet, but raises what unpickling says of a damaged
one, which a full disk or a killed process leaves behind.
"""

import threading
import time
from typing import Any

from numba.core import event
from numba.core.caching import IndexDataCacheFile


class CompilationCount(event.Listener):
    """Kernels compiled so far, and the wall time in which any thread compiled.

    A kernel that another calls is counted too; its time lies within the caller's and counts once.
    """

    def __init__(self) -> None:
        self.kernels = 0
        self._lock, self._under_way, self._since, self._before = threading.Lock(), 0, 0.0, 0.0

    @property
    def under_way(self) -> bool:
        """Whether a kernel is being compiled now."""
        return self._under_way > 0

    @property
    def seconds(self) -> float:
        """Wall time spent so far. [s]"""
        with self._lock:
            return self._before + (time.perf_counter() - self._since if self._under_way else 0.0)

    def on_start(self, event: event.Event) -> None:
        """A kernel that the cache does not hold."""
        with self._lock:
            if self._under_way == 0:
                self._since = time.perf_counter()
            self._under_way += 1

    def on_end(self, event: event.Event) -> None:
        """It is compiled, or could not be."""
        with self._lock:
            self._under_way -= 1
            self.kernels += 1
            if self._under_way == 0:
                self._before += time.perf_counter() - self._since


compiled = CompilationCount()
event.register("numba:compile", compiled)


def rebuild_damaged_kernels() -> None:
    """Let numba forget damaged files of its cache; called before the first kernel is."""
    load = IndexDataCacheFile.load
    if getattr(load, "forgets_damaged", False):
        return

    def load_or_forget(self: IndexDataCacheFile, key: Any) -> Any:
        try:
            return load(self, key)
        except Exception:  # whatever unpickling half a file says
            self.flush()
            return None

    load_or_forget.forgets_damaged = True  # pyright: ignore[reportFunctionMemberAccess]
    IndexDataCacheFile.load = load_or_forget
