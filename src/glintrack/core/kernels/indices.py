"""Our kernels count elements from the start alone: an index under 0 is a fault, and not the last element.

numba lets ``a[-1]`` be the last, so that each index of a signed type is asked whether it is under 0, and a
loop over elements is to the compiler no loop over neighbours in memory, which it could run in lanes. None of
our kernels needs that. What others compile in the same process is as numba has it.

`numba.np.arrayobj.fix_integer_index` is not numba's public face: where a later numba has it otherwise, all is
as without.

With GLINTRACK_CHECK_INDICES=1 and an empty NUMBA_CACHE_DIR kernels ask, and raise IndexError.
"""

import inspect
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import cgutils, types
from numba.np import arrayobj

OURS = "glintrack."
_TAKES = ["context", "builder", "idxty", "idx", "size"]
CHECKED = os.environ.get("GLINTRACK_CHECK_INDICES") == "1"
_with_sign: Any = getattr(arrayobj, "fix_integer_index", None)
_lowering: list[str] = []  # modules of the functions that are being lowered, one within the other


@contextmanager
def lowering(module: str) -> Iterator[None]:
    """While a function of a module is lowered; numba does one at a time, with what that needs within."""
    _lowering.append(module)
    try:
        yield
    finally:
        _lowering.pop()


def count_from_start() -> None:
    """Let numba take an index of our kernels as it is."""
    if _with_sign is not None and [*inspect.signature(_with_sign).parameters] == _TAKES:
        arrayobj.fix_integer_index = _index


def _index(context: Any, builder: Any, kind: Any, index: Any, size: Any) -> Any:
    """As numba's, but in functions of ours."""
    if not (_lowering and _lowering[-1].startswith(OURS)):
        return _with_sign(context, builder, kind, index, size)
    taken = context.cast(builder, index, kind, types.intp)
    if CHECKED and kind.signed:
        with cgutils.if_unlikely(builder, builder.icmp_signed("<", taken, taken.type(0))):
            context.call_conv.return_user_exc(builder, IndexError, ("a kernel's index must not be under 0",))
    return taken
