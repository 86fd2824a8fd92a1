"""numba's cache of compiled kernels: it survives damage, many writers, a full disk; compiling is timed.

numba takes a missing file for a kernel that is not compiled yet, but raises what unpickling says of a damaged
one, which a full disk or a killed process leaves behind, and what the disk says when a kernel is kept. And it
takes up a kernel that was compiled from a part, in another file, that has changed since (`kernels.sources`).
Before it takes up any it loads all that compiling would need, a tenth of a second; a kept kernel needs its
runtime alone.
"""

import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numba.core import event
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.runtime.nrt import rtsys
from numba.core.sigutils import normalize_signature

from glintrack.core.kernels.lock import alone
from glintrack.core.kernels.place import tell_place
from glintrack.core.kernels.processes import helpers
from glintrack.core.kernels.sources import stamp
from glintrack.core.kernels.types import to_plain


class _Stamp(tuple):
    """numba's own stamp of a kernel's file, and that of all its files: kept with what is compiled."""


class CompilationCount(event.Listener):
    """Kernels that this process compiled so far, and the wall time in which a thread did or waited.

    A kernel that another calls is counted too; its time lies within the caller's and counts once.

    Attributes
    ----------
    kernels
        Compiled so far.
    """

    def __init__(self) -> None:
        self.kernels = 0
        self._lock, self._under_way, self._since, self._before = threading.Lock(), 0, 0.0, 0.0

    @property
    def under_way(self) -> bool:
        """Whether a kernel is being compiled or waited for now."""
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
    def waiting(self) -> Iterator[None]:
        """While a kernel is waited for that another process compiles."""
        self._begin()
        try:
            yield
        finally:
            self._end()

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
    """Let numba forget damaged files of its cache and old kernels, and save one at a time.

    Called before the first kernel is. Two processes that save kernels of one function at once would each lose
    the other's, or give two of them one name.
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

    def by_sources(plain: Callable[..., Any]) -> Callable[..., Any]:
        def load_or_save(self: FunctionCache, *arguments: Any) -> Any:
            index_of(self)
            return plain(self, *arguments)

        return load_or_save

    def load_alone(self: FunctionCache, sig: Any, target_context: Any) -> Any:
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)

    FunctionCache.load_overload = load_alone
    FunctionCache._load_overload = by_sources(FunctionCache._load_overload)
    FunctionCache._save_overload = by_sources(FunctionCache._save_overload)
    load_or_forget.is_mended = True  # pyright: ignore[reportFunctionMemberAccess]
    IndexDataCacheFile.load, IndexDataCacheFile.save = load_or_forget, save_alone


def index_of(kernel: FunctionCache) -> IndexDataCacheFile:
    """What is kept of a kernel, if no file that it was compiled from has changed."""
    file = kernel._cache_file
    if not isinstance(file._source_stamp, _Stamp):
        file._source_stamp = _Stamp((file._source_stamp, stamp(kernel._py_func)))
    return file


def wait_for_helpers() -> None:
    """Let numba wait for kernels that processes compile (`kernels.processes`) and that are not kept yet."""
    load = FunctionCache.load_overload
    if getattr(load, "waits", False):
        return

    def load_when_kept(self: FunctionCache, sig: Any, target_context: Any) -> Any:
        found = load(self, sig, target_context)
        if found is not None or not _is_coming(self._py_func, sig):
            return found
        return load(self, sig, target_context)

    load_when_kept.waits = True  # pyright: ignore[reportFunctionMemberAccess]
    FunctionCache.load_overload = load_when_kept


def _is_coming(function: Any, signature: Any) -> bool:
    """Whether processes were to compile a kernel; returns once they have."""
    under_way = helpers()
    if under_way is None or not under_way.under_way:  # nor in a process that was forked meanwhile
        return False
    try:
        arguments = [to_plain(kind) for kind in normalize_signature(signature)[0]]
    except ValueError:  # types that no kernel of the table has
        return False
    told = under_way.ready(f"{function.__module__}:{function.__qualname__}", arguments)
    if told is None:
        return False
    with compiled.waiting():
        while not told.wait(1.0) and under_way.under_way:
            pass
    return True
