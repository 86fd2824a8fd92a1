"""A process that compiles kernels into numba's cache: ``python -m glintrack.kernels.worker``.

It reads kernels and the types of their arguments from standard input, as JSON, and tells each one done.
"""

import json
import sys
from contextlib import suppress

from glintrack.kernels.cache import mend_kernel_cache
from glintrack.kernels.types import attribute, from_plain


def main() -> None:
    """Compile what standard input names."""
    mend_kernel_cache()
    attribute("glintrack.render.rays.embree:load_library")()  # whose symbols some kernels name
    for name, arguments in json.load(sys.stdin):
        with suppress(Exception):  # the flight compiles it, and says what is wrong
            attribute(name).compile(tuple(from_plain(part) for part in arguments))
        print(name, flush=True)


if __name__ == "__main__":
    main()
