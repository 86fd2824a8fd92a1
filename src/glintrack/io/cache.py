"""Solved files on disk: addressed by content, verified by checksum, written all at once or not at all."""

import os
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path

import platformdirs

from glintrack.core.installation import VERSION
from glintrack.io.atomic import content_hash

_CHECKSUM_DIGITS = 16


def cache_folder(kind: str) -> Path:
    """Where solved files of a kind are kept: ``glintrack/KIND`` in the user's cache.

    ``$XDG_CACHE_HOME`` on every system where it is set; else what the system calls its cache.
    """
    base = os.environ.get("XDG_CACHE_HOME")
    own = Path(base) / "glintrack" if base else platformdirs.user_cache_path("glintrack", appauthor=False)
    return own / kind


def content_stem(content: str) -> str:
    """A file name's stem for a design's content as solved by this version of the program."""
    return content_hash(f"{content} glintrack {VERSION}", 32)


def find(stem: str, suffix: str, folder: Path) -> Path | None:
    """The kept file of a stem; one that does not match its own checksum is removed."""
    return next((path for path, _ in _whole(stem, suffix, folder)), None)


def read(stem: str, suffix: str, folder: Path) -> bytes | None:
    """What the kept file of a stem holds; see `find`."""
    return next(read_all(stem, suffix, folder), None)


def read_all(stem: str, suffix: str, folder: Path) -> Iterator[bytes]:
    """What each kept file of a stem holds, where it may have several; see `find`."""
    return (data for _, data in _whole(stem, suffix, folder))


def _whole(stem: str, suffix: str, folder: Path) -> Iterator[tuple[Path, bytes]]:
    for path in sorted(folder.glob(f"{stem}-*{suffix}")):
        try:
            data = path.read_bytes()
        except FileNotFoundError:  # removed by another process since it was listed
            continue
        if path.name.removesuffix(suffix).rsplit("-", 1)[1] == content_hash(data, _CHECKSUM_DIGITS):
            yield path, data
        else:
            path.unlink(missing_ok=True)


def keep(stem: str, suffix: str, folder: Path, data: bytes) -> Path | None:
    """Put a file into the cache in one step, under a name that holds its checksum.

    A cache that cannot be written costs the next run its file, not this one its result: that is warned about,
    and None returned.
    """
    try:
        return _put(stem, suffix, folder, data)
    except OSError as error:
        warnings.warn(f"the cache {folder} cannot be written: {error.strerror or error}", stacklevel=2)
        return None


def _put(stem: str, suffix: str, folder: Path, data: bytes) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{stem}-{content_hash(data, _CHECKSUM_DIGITS)}{suffix}"
    handle, staged = tempfile.mkstemp(dir=folder, suffix=".part")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        os.replace(staged, target)
    except BaseException:
        Path(staged).unlink(missing_ok=True)
        raise
    return target


def trim(suffix: str, folder: Path, most_bytes: int) -> None:
    """Remove the files written longest ago, until those left take no more than so many bytes; one stays."""
    known = []
    for path in folder.glob(f"*{suffix}"):
        try:
            known.append((path.stat().st_mtime_ns, path.stat().st_size, path))
        except FileNotFoundError:  # removed by another process since it was listed
            continue
    known.sort(key=lambda file: file[0], reverse=True)
    total = 0
    for k, (_, size, path) in enumerate(known):
        total += size
        if k and total > most_bytes:
            path.unlink(missing_ok=True)
