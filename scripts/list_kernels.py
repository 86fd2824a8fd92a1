"""List the kernels that the packaged cases call, with how long each compiles, for `core.kernels.ahead`.

``python scripts/list_kernels.py`` flies some frames of `quickstart` with empty caches and writes
src/glintrack/data/kernels.json. Run it after a kernel came, went or takes other types; a test says when.
"""

import importlib
import json
import os
import tempfile
import threading
import time
from pathlib import Path

os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp(prefix="glintrack-kernels-")  # before numba is imported
os.environ["XDG_CACHE_HOME"] = os.environ["NUMBA_CACHE_DIR"]  # what is kept there would not be computed

from numba.core import event

from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.core.kernels.parts import compile_parts_once
from glintrack.core.kernels.quicker import compile_quicker
from glintrack.core.kernels.types import to_plain
from glintrack.render.rays import embree_leaves
from glintrack.results import recorder
from glintrack.results import run as program

FRAMES = 8  # until every kind of question was asked
TABLE = Path(__file__).parents[1] / "src/glintrack/data/kernels.json"


class Listing(event.Listener):
    """Kernels that are called from Python, as they are compiled."""

    def __init__(self) -> None:
        self.rows: list[dict] = []
        self.needed = 0
        self._thread = threading.local()

    def on_start(self, event: event.Event) -> None:
        """One more, perhaps within another."""
        self._thread.depth = getattr(self._thread, "depth", 0) + 1
        if self._thread.depth == 1:
            self._thread.began = time.thread_time()

    def on_end(self, event: event.Event) -> None:
        """It is compiled, with all that it calls."""
        self._thread.depth -= 1
        kernel = event.data["dispatcher"].py_func
        callback = kernel.__module__ == embree_leaves.__name__  # no kernel, but what Embree calls
        if self._thread.depth == 0 and kernel.__module__.startswith("glintrack.") and not callback:
            self.rows.append(
                {
                    "name": f"{kernel.__module__}:{kernel.__qualname__}",
                    "arguments": [to_plain(kind) for kind in event.data["args"]],
                    "seconds": round(time.thread_time() - self._thread.began, 2),
                    "needed": self.needed,
                }
            )


def main() -> None:
    """Fly, and write the table."""
    listing = Listing()
    # each in its turn, so that it is timed
    importlib.import_module("glintrack.simulate").compile_ahead = lambda: None
    compile_parts_once()
    compile_quicker()
    write = recorder.write_frame

    def note(*arguments) -> None:
        write(*arguments)
        listing.needed = 1  # the first frame is on disk

    recorder.write_frame = note
    event.register("numba:compile", listing)
    for frames in FRAMES, 2:  # a later flight reads what the first kept
        case = Case.from_toml(find_case("quickstart")).replace({"flight.frames": frames})
        program.run(case, Path(tempfile.mkdtemp()) / "result")
    rows = sorted(listing.rows, key=lambda row: -row["seconds"])
    TABLE.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n", encoding="utf-8")
    print(f"{len(rows)} kernels, {sum(row['seconds'] for row in rows):.0f} s")


if __name__ == "__main__":
    main()
