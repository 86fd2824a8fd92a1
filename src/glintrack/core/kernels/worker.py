"""A process that compiles kernels into the cache: ``python -m glintrack.core.kernels.worker [PIPES ...]``.

It reads kernels and the types of their arguments from standard input, a line of JSON each, and tells each one
done, until one cannot be kept. For each further pair of pipes, ``READ:WRITE``, it forks another that does the
same over these, once all that compiling needs is loaded.
"""

import gc
import json
import os
import sys
from contextlib import suppress
from typing import Any, cast

from numba.core.registry import cpu_target

from glintrack.core.kernels.ahead import Kernel, listed_kernels
from glintrack.core.kernels.cache import mend_kernel_cache
from glintrack.core.kernels.parts import compile_parts_once
from glintrack.core.kernels.quicker import compile_quicker
from glintrack.core.kernels.types import attribute


def main() -> None:
    """Load what compiles, fork, and compile what the pipes name."""
    if hasattr(os, "nice"):
        os.nice(3)  # what the flight does meanwhile comes first: the kernels are for it
    mend_kernel_cache()
    compile_parts_once()
    compile_quicker()
    attribute("glintrack.render.rays.embree:load_library")()  # whose symbols some kernels name
    further = [tuple(map(int, words.split(":"))) for words in sys.argv[1:]]
    if further:
        for kernel in listed_kernels():
            attribute(kernel.name)
        for context in (cpu_target.typing_context, cpu_target.target_context):
            cast(Any, context).refresh()
    gc.freeze()
    gc.set_threshold(50_000, 20, 100)  # a compiler makes many objects and few cycles
    for read, write in further:
        if os.fork() == 0:
            os.dup2(read, 0)
            os.dup2(write, 1)
            break
    for pair in further:
        for end in pair:  # whoever holds another's pipe keeps it open
            os.close(end)
    urgent = True
    for line in sys.stdin:
        kernel = Kernel(**json.loads(line))
        if urgent and kernel.needed and hasattr(os, "nice"):
            urgent = False
            os.nice(7)  # the first frame is on its way, and waits for none of these
        if not kernel.is_kept():
            with suppress(Exception):  # the flight compiles it, and says what is wrong
                attribute(kernel.name).compile(kernel.signature())
            if not kernel.is_kept():
                return  # as nothing can be, on a full disk
        print(kernel.name, flush=True)


if __name__ == "__main__":
    main()
