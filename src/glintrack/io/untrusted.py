"""Files of others, checked before a parser sees them, so that none can hang, crash, swell or call out.

Text and archives are bounded by size. NetCDF-4 is read once in a child process with bounds on its time and
memory, because HDF5 loops or crashes on some damaged files. Rasters are opened by `untrusted_rasters`; here
nothing loads a library, as what reads a command line needs it.
"""

import functools
import json
import os
import zlib
from pathlib import Path
from typing import Any

from glintrack.io.messages import plain
from glintrack.io.netcdf_guard import fault_of

MOST_TEXT_BYTES = 256_000_000
FARTHEST_M, COARSEST_M = 1e8, 1e5  # no projected coordinate is larger; no cell of a map is
LOWEST_M, HIGHEST_M = -500.0, 9000.0  # of ground and roofs: the Dead Sea's shore, Everest
_HDF5 = b"\x89HDF\r\n\x1a\n"


def check_file(path: str | Path, name: str, most_bytes: int | None = None) -> Path:
    """Refuse what is no regular file (a device or a pipe may never end), or a larger one than is read.

    Raises
    ------
    ValueError
        If there is no such file, or it is too large.
    """
    path = Path(path)
    try:
        regular, size = path.is_file(), path.stat().st_size
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"`{name}` must be a readable file, got {path} ({reason})") from error
    if not regular:
        kind = "a folder (name a file in it)" if path.is_dir() else "no regular file"
        raise ValueError(f"`{name}` must be a readable file, got {path}, which is {kind}")
    if most_bytes is not None and size > most_bytes:
        raise ValueError(
            f"`{name}` must have at most {most_bytes / 1e6:g} MB, got {path} with {size / 1e6:.0f}"
        )
    return path


def whole_path(path: str | Path) -> Path:
    """A path from the root on, links followed; one of links in a circle stays, told when it is read."""
    return Path(os.path.realpath(path))


def is_file(path: Path) -> bool:
    """Whether there is a file; none has a name that the system refuses."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long, or with a NUL
        return False


def read_bytes(path: str | Path, name: str, most_bytes: int = MOST_TEXT_BYTES) -> bytes:
    """The bytes of a file, unzipped if they are gzip's; both bounded.

    Raises
    ------
    ValueError
        If the file cannot be read, is a damaged archive, or holds too much.
    """
    path = check_file(path, name, most_bytes)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ValueError(f"`{name}` must be a readable file, got {path} ({error.strerror})") from error
    return unzip(content, path, name, most_bytes) if content[:2] == b"\x1f\x8b" else content


def unzip(content: bytes, path: Path, name: str, most_bytes: int = MOST_TEXT_BYTES) -> bytes:
    """What a gzip archive of one or several members holds; refused when it is more than ``most_bytes``.

    Raises
    ------
    ValueError
        If it is damaged, cut short or holds too much.
    """
    parts, size = [], 0
    try:
        while content:
            member = zlib.decompressobj(wbits=31)
            parts.append(member.decompress(content, most_bytes - size + 1))
            size += len(parts[-1])
            if size > most_bytes:
                most = f"{most_bytes / 1e6:g} MB"
                raise ValueError(f"`{name}` must hold at most {most} when unzipped, got more in {path}")
            if not member.eof:
                raise zlib.error("the archive ends early")
            content = member.unused_data.lstrip(b"\x00")
    except zlib.error as error:
        raise ValueError(f"`{name}` must be a whole gzip archive, got {path}: {error}") from error
    return b"".join(parts)


def read_text(path: str | Path, name: str, most_bytes: int = MOST_TEXT_BYTES) -> str:
    """The text of a UTF-8 file, without a byte-order mark.

    Raises
    ------
    ValueError
        If the file cannot be read, is too large or not UTF-8.
    """
    path = check_file(path, name, most_bytes)
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ValueError(f"`{name}` must be a readable file, got {path} ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"`{name}` must be UTF-8 text, got {path} with a byte that is not") from error


def read_json(path: str | Path, name: str) -> Any:
    """What a JSON file says.

    Raises
    ------
    ValueError
        If the file cannot be read, is too large, or is not JSON in UTF-8.
    """
    try:
        return json.loads(read_bytes(path, name).decode("utf-8"))
    except RecursionError as error:
        raise ValueError(f"`{name}` must be JSON, got {path}, nested too deeply") from error
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"`{name}` must be JSON in UTF-8, got {path}: {plain(error, 200)}") from error


def check_netcdf(path: str | Path, name: str) -> Path:
    """Refuse a NetCDF-4 file that cannot be read to its end within bounds of time and memory.

    Raises
    ------
    ValueError
        If the file is none, is damaged, refers to other files, or holds far more than its size.
    """
    path = check_file(path, name)
    with path.open("rb") as file:
        if file.read(8) != _HDF5:
            raise ValueError(f"`{name}` must be a readable NetCDF-4 file, got {path}")
    about = path.stat()
    fault = _probed(str(path.resolve()), about.st_size, about.st_mtime_ns)
    if fault:
        raise ValueError(f"`{name}` must be a whole NetCDF-4 file, got {path}: {fault}")
    return path


@functools.lru_cache(maxsize=256)
def _probed(path: str, size: int, _changed_ns: int) -> str:
    """What is wrong with a file, found out in a child process; empty if nothing is."""
    return plain(fault_of(path, size).strip(), 200)
