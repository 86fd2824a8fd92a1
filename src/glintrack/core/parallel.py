"""Run a compiled kernel over slices of its rows on all cores.

Kernels are numba functions that release the interpreter's lock (``nogil=True``) and work on rows ``start`` to
``stop``. This takes half the compilation time of numba's own parallel loops (docs/decisions/0006).
"""

import itertools
import os
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, lru_cache
from typing import TypeVar

import numba as nb

from glintrack.core.kernels.cache import mend_kernel_cache
from glintrack.core.kernels.parts import compile_parts_once

mend_kernel_cache()
compile_parts_once()

T = TypeVar("T")
R = TypeVar("R")

_SLICES_PER_THREAD = 8  # rows differ in cost: small slices keep the cores evenly busy
_alone: ContextVar[bool] = ContextVar("alone", default=False)  # within `one_thread`


def over_rows(
    kernel: Callable[..., None], rows: int, *arguments, least: int = 1, most: int | None = None
) -> None:
    """Call ``kernel(start, stop, *arguments)`` for slices that cover ``range(rows)``.

    Parameters
    ----------
    kernel
        Writes into arrays among its arguments, each row in its own place.
    rows
        How many rows there are.
    least
        Rows of a slice, at least; every slice but the last starts at a multiple of it.
    most
        Rows of a slice, at most, if that is not under ``least``.
    """
    if _alone.get():  # asked first: numba's own count takes as long as a small kernel
        if rows > 0:
            kernel(0, rows, *arguments)
        return
    threads = nb.get_num_threads()
    share = -(-rows // (threads * _SLICES_PER_THREAD))
    size = share if most is None else min(share, most)
    size = max(-(-size // least) * least, least)
    slices = [(start, min(start + size, rows)) for start in range(0, rows, size)]
    if not slices:
        return
    waiting = iter(slices)

    def work() -> None:
        for one in waiting:  # one thread at a time takes the next: a list's iterator holds the lock
            kernel(*one, *arguments)

    helpers = min(threads, len(slices)) - 1
    if not helpers:
        work()
        return
    others = [_helpers(threads).submit(work) for _ in range(helpers)]
    try:
        work()
    finally:  # who has not begun finds nothing left to do
        begun = [other for other in others if not other.cancel()]
        wait(begun)
    for other in begun:
        other.result()


@lru_cache
def _helpers(threads: int) -> ThreadPoolExecutor:
    """Threads that help whoever calls `over_rows`: to start one anew each time takes as long as a kernel."""
    return ThreadPoolExecutor(threads, "rows")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_helpers.cache_clear)  # a fork has none of its parent's threads


def side_by_side(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """``function`` of each item, in order, several at a time: for work that mostly leaves Python's lock."""
    listed, threads = list(items), 1 if _alone.get() else nb.get_num_threads()
    if min(threads, len(listed)) < 2:
        return [function(one) for one in listed]
    with _pool(threads, "side") as pool:
        return list(pool.map(function, listed))


def _pool(threads: int, name: str) -> ThreadPoolExecutor:
    """Threads with as many of numba's as their caller has: that number is a thread's own."""
    helped = nb.get_num_threads()
    return ThreadPoolExecutor(threads, name, initializer=nb.set_num_threads, initargs=(helped,))


class Beside:
    """Work in a thread of its own, one piece at a time; at once where numba is set to one thread."""

    def __init__(self) -> None:
        self._under_way: Future[None] | None = None

    def begin(self, work: Callable[[], None]) -> None:
        """Start a piece once the one before has ended, whose error is raised here."""
        self.wait()
        if nb.get_num_threads() < 2 or _alone.get():
            work()
            return
        pool = _pool(1, "beside")
        self._under_way = pool.submit(work)
        pool.shutdown(wait=False)  # its thread ends with the work

    def wait(self) -> None:
        """Until what was begun has ended; its error is raised here."""
        under_way, self._under_way = self._under_way, None
        if under_way is not None:
            under_way.result()


def soon(make: Callable[[], R]) -> Callable[[], R]:
    """Begin to make something in a thread of its own; what is returned waits for it and gives it.

    Where numba is set to one thread it is made when it is first asked for.
    """
    if nb.get_num_threads() < 2 or _alone.get():
        return cache(make)
    pool = _pool(1, "soon")
    coming = pool.submit(make)
    pool.shutdown(wait=False)  # its thread ends with the work
    return coming.result


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep `over_rows` to the calling thread and to one slice, for work that is itself a slice of more."""
    before = _alone.set(True)
    try:
        yield
    finally:
        _alone.reset(before)


def one_ahead(make: Callable[[T], R], items: Iterable[T]) -> Generator[R, None, None]:
    """``make`` of each item, in order: the next one's in a thread of its own, while this one's is used.

    Where numba is set to one thread each is made when it is asked for. Close the iterator where it may be
    left early: what is being made is waited for and thrown away.

    Parameters
    ----------
    make
        Called for one item at a time.
    items
        In the order in which they are wanted.
    """
    waiting = iter(items)
    if nb.get_num_threads() < 2 or _alone.get():
        yield from map(make, waiting)
        return
    pool = _pool(1, "ahead")
    try:
        coming = [pool.submit(make, item) for item in itertools.islice(waiting, 1)]
        while coming:
            made = coming.pop().result()
            coming += [pool.submit(make, item) for item in itertools.islice(waiting, 1)]
            yield made
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
