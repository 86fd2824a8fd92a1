"""A process that compiles kernels into numba's cache: ``python -m glintrack.kernels.worker``.

It reads kernels and the types of their arguments from standard input, a line of JSON each, and tells each one
done, until one cannot be kept.
"""

import gc
import json
import os
import sys
from contextlib import suppress

from glintrack.kernels.ahead import Kernel
from glintrack.kernels.cache import mend_kernel_cache
from glintrack.kernels.parts import compile_parts_once
from glintrack.kernels.quicker import compile_quicker
from glintrack.kernels.types import attribute


def main() -> None:
    """Compile what standard input names."""
    if hasattr(os, "nice"):
        os.nice(3)  # what the flight does meanwhile comes first: the kernels are for it
    mend_kernel_cache()
    compile_parts_once()
    compile_quicker()
    attribute("glintrack.render.rays.embree:load_library")()  # whose symbols some kernels name
    gc.freeze()
    gc.set_threshold(50_000, 20, 100)  # a compiler makes many objects and few cycles
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
