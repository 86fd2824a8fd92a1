"""Cache of computed files: named by content, verified by checksum, written whole or not at all."""

import os
import warnings
from pathlib import Path

import platformdirs

from glintrack.core.installation import VERSION
from glintrack.io.atomic import content_hash, write_bytes

_CHECKSUM_DIGITS = 16


def cache_folder(kind: str) -> Path:
    """Folder for computed files of a kind: ``glintrack/KIND`` in the user's cache.

    The user's cache is ``$XDG_CACHE_HOME`` if that is set, otherwise the folder of the operating system.
    """
    base = os.environ.get("XDG_CACHE_HOME")
    own = Path(base) / "glintrack" if base else platformdirs.user_cache_path("glintrack", appauthor=False)
    return own / kind


def content_stem(content: str) -> str:
    """Stem of the file name for a design's content as computed by this version of the program."""
    return content_hash(f"{content} glintrack {VERSION}", 32)


def find(stem: str, suffix: str, folder: Path) -> Path | None:
    """Find the file of a stem; a file that does not match its checksum is deleted."""
    for path in sorted(folder.glob(f"{stem}-*{suffix}")):
        try:
            data = path.read_bytes()
        except FileNotFoundError:  # deleted by another process
            continue
        if path.name.removesuffix(suffix).rsplit("-", 1)[1] == content_hash(data, _CHECKSUM_DIGITS):
            return path
        path.unlink(missing_ok=True)
    return None


def read(stem: str, suffix: str, folder: Path) -> bytes | None:
    """Read the file of a stem; None if there is none (see `find`)."""
    path = find(stem, suffix, folder)
    return None if path is None else path.read_bytes()


def store(stem: str, suffix: str, folder: Path, data: bytes) -> Path | None:
    """Write a file into the cache under a name with its checksum.

    If the cache cannot be written, a warning is given and None is returned.
    """
    path = folder / f"{stem}-{content_hash(data, _CHECKSUM_DIGITS)}{suffix}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_bytes(path, data)
        return path
    except OSError as error:
        warnings.warn(f"the cache {folder} cannot be written: {error.strerror or error}", stacklevel=2)
        return None
