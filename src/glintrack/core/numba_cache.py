"""Name the folder of compiled kernels after the sources, so that changed sources are compiled again.

Numba compares only the file of the kernel itself. A function or a constant that changed in another file would
go unnoticed. Only the command line calls this module: the library leaves numba's settings alone.
"""

import os
import shutil
import tempfile
import warnings
from hashlib import sha256
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"
MAX_FOLDERS = 3  # versions of the sources that have a folder
_COMPLETE = "glintrack-{digest}.complete"  # file in the folder once `glintrack warm-up` has finished


def sources_digest() -> str:
    """Digest of the names and contents of the package's source files."""
    package = Path(__file__).parents[1]
    digest = sha256()
    for path in sorted(package.rglob("*.py")):
        digest.update(f"{path.relative_to(package).as_posix()}\0".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def set_cache_folder(parent: Path) -> Path:
    """Set ``NUMBA_CACHE_DIR`` for this process and those that it starts; call it before numba is imported.

    Parameters
    ----------
    parent
        Folder that holds one folder for each version of the sources. The oldest ones are deleted.

    Returns
    -------
    The folder in use: the user's own if ``NUMBA_CACHE_DIR`` is set.
    """
    if given := os.environ.get(VARIABLE):
        return Path(given)
    folder = parent / sources_digest()
    if not folder.exists():
        others = sorted(parent.glob("*/"), key=lambda path: path.stat().st_mtime)
        for old in others[: max(len(others) - MAX_FOLDERS + 1, 0)]:
            shutil.rmtree(old, ignore_errors=True)
        folder = _writable(folder)
    os.environ[VARIABLE] = str(folder)
    return folder


def _writable(folder: Path) -> Path:
    """Make the folder, or a temporary one if that is impossible: numba refuses to work without any."""
    try:
        folder.mkdir(parents=True)
        return folder
    except OSError as error:
        warnings.warn(f"compiled kernels are stored for this run only: {error}", stacklevel=2)
        return Path(tempfile.mkdtemp(prefix="glintrack-kernels-"))


def is_complete() -> bool:
    """Return True if the kernels of these sources are compiled, or no folder is set."""
    return VARIABLE not in os.environ or _marker().exists()


def mark_complete() -> None:
    """Note that the kernels of these sources are compiled."""
    marker = _marker()
    marker.parent.mkdir(parents=True, exist_ok=True)
    marker.touch()


def _marker() -> Path:
    return Path(os.environ[VARIABLE]) / _COMPLETE.format(digest=sources_digest())
