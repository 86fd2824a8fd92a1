"""Compile the kernels of a flight on all cores before it flies.

numba compiles a kernel when it is first called, one after the other. Here processes of their own
(`kernels.worker`) share out those of a table and leave them in numba's cache, where the flight finds them.
``python scripts/list_kernels.py`` makes the table anew, from flights; what it lacks is compiled in flight.
"""

import json
import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib import resources
from typing import IO, Any, cast

from glintrack.io.cache import cache_folder
from glintrack.kernels.cache import alone, compiled
from glintrack.kernels.types import attribute, from_plain

FEW = 4  # that are as well compiled in flight
_TABLE = "kernels.json"


@dataclass(frozen=True)
class Kernel:
    """A kernel with the types it is called with.

    Parameters
    ----------
    name
        ``module:function``.
    arguments
        As `kernels.types` writes them.
    seconds
        What compiling it took when the table was made, by which the work is shared out. [s]
    """

    name: str
    arguments: list[Any]
    seconds: float

    def signature(self) -> tuple:
        """The types as numba has them."""
        return tuple(from_plain(part) for part in self.arguments)

    def is_kept(self) -> bool:
        """Whether numba's cache holds it; also if there is no such kernel, or no cache."""
        try:
            dispatcher = attribute(self.name)
            cache = dispatcher._cache
            key = cache._index_key(self.signature(), dispatcher.targetctx.codegen())
            return key in cache._cache_file._load_index()
        except (AttributeError, ImportError, OSError):
            return True


def listed_kernels() -> list[Kernel]:
    """The package's table."""
    text = resources.files("glintrack.data").joinpath(_TABLE).read_text(encoding="utf-8")
    return [Kernel(**row) for row in json.loads(text)]


def compile_ahead() -> None:
    """Compile what numba's cache lacks of the table, if that is more than a few, in a process a core."""
    lacking = [kernel for kernel in listed_kernels() if not kernel.is_kept()]
    if len(lacking) <= FEW:
        return
    with alone(cache_folder("kernels")):
        lacking = [kernel for kernel in lacking if not kernel.is_kept()]  # another process may have
        shares = shared_out(lacking, os.cpu_count() or 1)
        with compiled.ahead(len(lacking)):
            _compile(shares)


def shared_out(kernels: Sequence[Kernel], processes: int) -> list[list[Kernel]]:
    """Kernels by process: each of the longest first to the one that has the least to do."""
    shares: list[list[Kernel]] = [[] for _ in range(min(processes, len(kernels)))]
    for kernel in sorted(kernels, key=lambda one: -one.seconds):
        min(shares, key=lambda share: sum(one.seconds for one in share)).append(kernel)
    return shares


def _compile(shares: list[list[Kernel]]) -> None:
    command = [sys.executable, "-m", "glintrack.kernels.worker"]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    workers = [subprocess.Popen(command, stderr=subprocess.DEVNULL, **pipes) for _ in shares]
    try:
        given = zip(workers, shares, strict=True)
        followers = [threading.Thread(target=_follow, args=one) for one in given]
        for follower in followers:
            follower.start()
        for follower in followers:
            follower.join()
    finally:
        for worker in workers:
            worker.kill()
            worker.wait()


def _follow(worker: subprocess.Popen, kernels: list[Kernel]) -> None:
    """Give a process its kernels and count those that are done."""
    asked, told = cast(IO[str], worker.stdin), cast(IO[str], worker.stdout)
    with suppress(OSError):  # it died; the flight compiles them
        with asked:
            json.dump([asdict(one) for one in reversed(kernels)], asked)  # the shortest first
        for _ in told:
            compiled.add()
