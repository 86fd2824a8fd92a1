"""numba's cache of compiled kernels: it survives damage, many writers, a full disk; compiling is timed.

numba takes a missing file for a kernel that is not compiled yet, but raises what unpickling says of a damaged
one, which a full disk or a killed process leaves behind, and what the disk says when a kernel is kept.
"""

import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from numba.core import event
from numba.core.caching import IndexDataCacheFile

from glintrack.kernels.place import tell_place

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None


class CompilationCount(event.Listener):
    """Kernels compiled so far, and the wall time in which any thread compiled.

    A kernel that another calls is counted too; its time lies within the caller's and counts once.

    Attributes
    ----------
    kernels
        Compiled so far.
    expected
        How many those will be that processes compile ahead now; 0 otherwise.
    """

    def __init__(self) -> None:
        self.kernels = self.expected = 0
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
        self._begin()

    def on_end(self, event: event.Event) -> None:
        """It is compiled, or could not be."""
        self.add()
        self._end()

    @contextmanager
    def ahead(self, kernels: int) -> Iterator[None]:
        """While processes compile so many."""
        self.expected = self.kernels + kernels
        self._begin()
        try:
            yield
        finally:
            self._end()
            self.expected = 0

    def add(self) -> None:
        """One more."""
        with self._lock:
            self.kernels += 1

    def _begin(self) -> None:
        with self._lock:
            if self._under_way == 0:
                self._since = time.perf_counter()
            self._under_way += 1

    def _end(self) -> None:
        with self._lock:
            self._under_way -= 1
            if self._under_way == 0:
                self._before += time.perf_counter() - self._since


compiled = CompilationCount()
event.register("numba:compile", compiled)


def mend_kernel_cache() -> None:
    """Let numba forget damaged files of its cache, and save one at a time; called before the first kernel is.

    Two processes that save kernels of one function at once would each lose the other's, or give two of them
    one name.
    """
    load, save = IndexDataCacheFile.load, IndexDataCacheFile.save
    if getattr(load, "is_mended", False):
        return
    tell_place()

    def load_or_forget(self: IndexDataCacheFile, key: Any) -> Any:
        try:
            return load(self, key)
        except Exception:  # whatever unpickling half a file says
            self.flush()
            return None

    def save_alone(self: IndexDataCacheFile, key: Any, data: Any) -> None:
        try:
            with alone(Path(self._cache_path)):
                save(self, key, data)
        except OSError as error:
            said = f"compiled kernels cannot be kept, and are compiled each time: {error}"
            warnings.warn(said, stacklevel=2)

    load_or_forget.is_mended = True  # pyright: ignore[reportFunctionMemberAccess]
    IndexDataCacheFile.load, IndexDataCacheFile.save = load_or_forget, save_alone


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """One process at a time in a folder; all at once where nothing can be locked or written there."""
    with ExitStack() as opened:
        if fcntl is not None:
            with suppress(OSError):
                folder.mkdir(parents=True, exist_ok=True)
                lock = opened.enter_context((folder / ".lock").open("w"))
                fcntl.flock(lock, fcntl.LOCK_EX)
        yield
