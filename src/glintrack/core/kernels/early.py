"""The package's table of kernels, and compiling it as the program starts. Nothing here loads numba."""

import json
import os
import platform
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import resources
from importlib.metadata import version
from pathlib import Path

from glintrack.core.kernels import processes
from glintrack.io.atomic import content_hash
from glintrack.io.cache import cache_folder

_TABLE = "kernels.json"
_KIND = "kernels"  # of cache


def listed_rows() -> list[dict]:
    """The package's table, as `kernels.processes.Helpers` takes it."""
    return json.loads(resources.files("glintrack.data").joinpath(_TABLE).read_text(encoding="utf-8"))


def start_early() -> None:
    """Start compiling as the program starts, before numba is loaded, unless all was compiled before."""
    if processes.helpers() or os.environ.get("NUMBA_DISABLE_JIT", "0") != "0" or _note().exists():
        return
    start(listed_rows())


def start(rows: Sequence[dict]) -> processes.Helpers:
    """Start compiling rows of the table, and remember it once all is kept."""
    note = _note()
    with suppress(OSError):
        note.unlink(missing_ok=True)  # what it said is not so
    return processes.start(rows, cache_folder(_KIND), note.exists, note_all_kept)


def note_all_kept() -> None:
    """Remember that numba's cache holds the whole table; see `start_early`."""
    note = _note()
    with suppress(OSError):  # then the next start looks again
        note.parent.mkdir(parents=True, exist_ok=True)
        for other in note.parent.glob(f"*{note.suffix}"):
            other.unlink(missing_ok=True)
        note.touch()


def _note() -> Path:
    """A file that is there if the cache was complete for these sources, libraries and machine."""
    package = Path(__file__).parents[2]
    newest = max((path.stat().st_mtime_ns for path in package.rglob("*.py")), default=0)
    kept = os.environ.get("NUMBA_CACHE_DIR", ""), str(package), newest
    system = sys.version, version("numba"), version("llvmlite"), platform.node(), platform.machine()
    return cache_folder(_KIND) / f"{content_hash(repr((kept, system)), 24)}.kept"
