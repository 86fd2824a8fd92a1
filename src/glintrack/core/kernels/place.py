"""A folder for compiled kernels where numba finds none: it refuses to define what it could not keep."""

import atexit
import os
import shutil
import sys
import tempfile
import warnings
from pathlib import Path

import platformdirs

_VARIABLE = "NUMBA_CACHE_DIR"


def find_place() -> None:
    """Let numba keep kernels until this process ends where none of its own places is writable.

    Called as the package is imported, before its kernels are defined; `tell_place` says so once they are. A
    read-only system without a writable home is such a place.

    Raises
    ------
    OSError
        If not even a temporary folder can be made.
    """
    named = os.environ.get(_VARIABLE)
    beside = Path(__file__).with_name("__pycache__")
    own = [Path(named)] if named else []
    if any(map(_is_writable, [*own, beside, platformdirs.user_cache_path("numba", appauthor=False)])):
        return
    folder = tempfile.mkdtemp(prefix=_prefix())
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ[_VARIABLE] = folder
    if "numba" in sys.modules:  # it has read its environment already
        sys.modules["numba"].core.config.reload_config()


def tell_place() -> None:
    """Warn of kernels that go with this process."""
    if Path(os.environ.get(_VARIABLE, "")).name.startswith(_prefix()):
        warnings.warn(
            "compiled kernels cannot be kept, and are compiled each time "
            f"(set {_VARIABLE} to a folder that can be written)",
            stacklevel=2,
        )


def _prefix() -> str:
    """Of a folder of this process; those that it starts share it."""
    return f"glintrack-kernels-{os.getpid()}-"


def _is_writable(folder: Path) -> bool:
    """Whether files can be made in a folder, or in the one that it would be made in."""
    try:
        there = next(place for place in (folder, *folder.parents) if place.exists())
        with tempfile.TemporaryFile(dir=there):
            return True
    except (OSError, StopIteration):
        return False
