"""Run compiled kernels and other work in threads, and count what is compiled.

Kernels are numba functions that release the interpreter's lock (``nogil=True``) and work on rows ``start`` to
``stop``. This takes half the compilation time of numba's own parallel loops (docs/decisions/0004).
"""

import itertools
import os
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from typing import TypeVar

import numba as nb
from numba.core import event

T = TypeVar("T")
R = TypeVar("R")

_SLICES_PER_THREAD = 8  # rows differ in cost: small slices keep the cores evenly busy
_alone: ContextVar[bool] = ContextVar("alone", default=False)  # within `one_thread`


class CompilationClock(event.Listener):
    """Number of kernels that this process compiled, and the wall time it took.

    A kernel that another one calls is counted too; its time is part of the caller's. ``on_kernel`` is called
    with the number after each one, in the thread that compiled it.
    """

    def __init__(self) -> None:
        self.kernels = 0
        self.on_kernel: Callable[[int], None] = lambda count: None
        self._lock, self._depth, self._since, self._before = threading.Lock(), 0, 0.0, 0.0

    @property
    def seconds(self) -> float:
        """Wall time spent so far. [s]"""
        with self._lock:
            return self._before + (time.perf_counter() - self._since if self._depth else 0.0)

    def on_start(self, event: event.Event) -> None:
        """Note that the cache does not hold a kernel."""
        with self._lock:
            if self._depth == 0:
                self._since = time.perf_counter()
            self._depth += 1

    def on_end(self, event: event.Event) -> None:
        """Note that a kernel is compiled, or could not be."""
        with self._lock:
            self.kernels += 1
            self._depth -= 1
            if self._depth == 0:
                self._before += time.perf_counter() - self._since
        self.on_kernel(self.kernels)


compilation = CompilationClock()
event.register("numba:compile", compilation)


def over_rows(
    kernel: Callable[..., None], rows: int, *arguments, least: int = 1, most: int | None = None
) -> None:
    """Call ``kernel(start, stop, *arguments)`` for slices that cover ``range(rows)``.

    Parameters
    ----------
    kernel
        Writes into arrays among its arguments, each row in its own place.
    rows
        Number of rows.
    least
        Smallest number of rows of a slice; every slice but the last starts at a multiple of it.
    most
        Largest number of rows of a slice, unless that is less than ``least``.
    """
    if _alone.get():  # tested first: numba's own count takes as long as a small kernel
        if rows > 0:
            kernel(0, rows, *arguments)
        return
    threads = nb.get_num_threads()
    share = -(-rows // (threads * _SLICES_PER_THREAD))
    size = share if most is None else min(share, most)
    size = max(-(-size // least) * least, least)
    slices = [(start, min(start + size, rows)) for start in range(0, rows, size)]
    waiting = iter(slices)

    def work() -> None:
        for one in waiting:  # a list's iterator gives each slice to one thread
            kernel(*one, *arguments)

    others = [_helpers(threads).submit(work) for _ in range(min(threads, len(slices)) - 1)]
    try:
        work()
    finally:  # helpers that have not begun find no work left
        begun = [other for other in others if not other.cancel()]
        wait(begun)
    for other in begun:
        other.result()


@lru_cache
def _helpers(threads: int) -> ThreadPoolExecutor:
    """Threads that help the caller of `over_rows`; starting them takes as long as a kernel."""
    return ThreadPoolExecutor(threads, "rows")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_helpers.cache_clear)  # a fork has none of its parent's threads


def map_threads(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """Call a function for each item in several threads; for work that mostly releases Python's lock."""
    listed, threads = list(items), 1 if _alone.get() else nb.get_num_threads()
    if min(threads, len(listed)) < 2:
        return [function(one) for one in listed]
    with _pool(threads, "map") as pool:
        return list(pool.map(function, listed))


def _pool(threads: int, name: str) -> ThreadPoolExecutor:
    """Threads with the caller's number of numba threads, which each thread has for itself."""
    return ThreadPoolExecutor(threads, name, nb.set_num_threads, (nb.get_num_threads(),))


class BackgroundTask:
    """Run one function at a time in a background thread; at once if numba is set to one thread."""

    def __init__(self) -> None:
        self._future: Future[None] | None = None

    def begin(self, work: Callable[[], None]) -> None:
        """Wait for the previous function, raise its error if it had one, and start this one."""
        self.wait()
        if nb.get_num_threads() < 2 or _alone.get():
            work()
            return
        pool = _pool(1, "background")
        self._future = pool.submit(work)
        pool.shutdown(wait=False)  # its thread ends with the work

    def wait(self) -> None:
        """Wait for the function to end; its error is raised here."""
        future, self._future = self._future, None
        if future is not None:
            future.result()


@contextmanager
def one_thread() -> Iterator[None]:
    """Restrict `over_rows` to the calling thread and one slice, within work that is already parallel."""
    before = _alone.set(True)
    try:
        yield
    finally:
        _alone.reset(before)


def prefetch(make: Callable[[T], R], items: Iterable[T]) -> Generator[R, None, None]:
    """Call ``make`` for each item in order; the next result is made in a thread while this one is used.

    If numba is set to one thread, each result is made when it is requested. Close the iterator if it may be
    left early: it waits for the result in progress and drops it.
    """
    if nb.get_num_threads() < 2 or _alone.get():
        yield from map(make, items)
        return
    with _pool(1, "prefetch") as pool:
        waiting = iter(items)
        coming = [pool.submit(make, item) for item in itertools.islice(waiting, 1)]
        while coming:
            made = coming.pop().result()
            coming += [pool.submit(make, item) for item in itertools.islice(waiting, 1)]
            yield made
