"""Compile the kernels of a flight on all cores while it is made ready.

numba compiles a kernel when it is first called, one after the other. Here processes of their own
(`kernels.processes`) share those of a table and leave them in numba's cache, where the flight finds them.
``python scripts/list_kernels.py`` makes the table anew, from flights; what it lacks is compiled in flight.
"""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from glintrack.core.kernels.cache import index_of, mend_kernel_cache, wait_for_helpers
from glintrack.core.kernels.early import listed_rows, note_all_kept, start
from glintrack.core.kernels.processes import helpers
from glintrack.core.kernels.types import attribute, from_plain

FEW = 4  # that are as well compiled in flight


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
    needed
        0 if the first frame waits for it, 1 if what follows does.
    """

    name: str
    arguments: list[Any]
    seconds: float
    needed: int = 0

    def signature(self) -> tuple:
        """The types as numba has them."""
        return tuple(from_plain(part) for part in self.arguments)

    def is_kept(self) -> bool:
        """Whether numba's cache holds it; also if there is no such kernel, or no cache."""
        try:
            dispatcher = attribute(self.name)
            cache = dispatcher._cache
            key = cache._index_key(self.signature(), dispatcher.targetctx.codegen())
            return key in index_of(cache)._load_index()
        except (AttributeError, ImportError, OSError):
            return True


def listed_kernels() -> list[Kernel]:
    """The package's table."""
    return [Kernel(**row) for row in listed_rows()]


def compile_ahead(wait: bool = False) -> None:
    """Start to compile what numba's cache lacks of the table, if that is more than a few.

    Parameters
    ----------
    wait
        Until all are compiled, for who times what follows.
    """
    mend_kernel_cache()
    under_way = helpers()
    if under_way is None or not under_way.under_way:
        wait_for_helpers()
        lacking = [kernel for kernel in listed_kernels() if not kernel.is_kept()]
        if len(lacking) <= FEW:
            note_all_kept()
            return
        under_way = start(_rows(lacking))
    wait_for_helpers()
    if wait:
        under_way.wait()


def _rows(kernels: Iterable[Kernel]) -> list[dict]:
    return [asdict(kernel) for kernel in kernels]
