"""Write files and folders whole or not at all, and hash their contents."""

import errno
import glob
import hashlib
import os
import shutil
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # not on Windows, where folders are not locked
    fcntl = None  # type: ignore[assignment]


def content_hash(parts: str | bytes | Iterable[str | bytes], digits: int = 64) -> str:
    """Leading hexadecimal digits of the SHA-256 of concatenated parts; text as UTF-8."""
    found = hashlib.sha256()
    for part in (parts,) if isinstance(parts, str | bytes) else parts:
        found.update(part.encode() if isinstance(part, str) else part)
    return found.hexdigest()[:digits]


@contextmanager
def result_folder(path: Path) -> Iterator[Path]:
    """Folder under a temporary name, which gets its own at the end; after an error nothing is left.

    Parameters
    ----------
    path
        Must not exist yet, or be an empty folder.

    Raises
    ------
    ValueError
        If the path holds something, its parent cannot be written, or another run writes it.
    """
    if path.is_symlink():  # which cannot be replaced as its folder can
        path = path.resolve()
    check_new_folder(path)
    start = f".{path.name}.partial-"
    for other in path.parent.glob(f"{glob.escape(start)}*"):
        with _locked(other) as is_free:
            if not is_free:
                raise ValueError(
                    f"`output` must not be written by another run; got {path} with {other.name} beside it. "
                    "Choose another -o, wait, or remove that folder if nothing runs."
                )
            shutil.rmtree(other, ignore_errors=True)  # of a run that was killed
    partial = path.with_name(f"{start}{uuid.uuid4().hex[:12]}")
    try:
        partial.mkdir(parents=True)
    except OSError as error:
        raise ValueError(f"`output` must be writable; got {path}: {error.strerror}.") from error
    with _locked(partial):
        try:
            yield partial
            partial.rename(path)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise


@contextmanager
def _locked(folder: Path) -> Iterator[bool]:
    """Lock a folder, which the system frees when a process dies; False if another run has locked it."""
    if fcntl is None:
        yield False
        return
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError as error:
        yield isinstance(error, FileNotFoundError)  # the other run has just ended; else it is not ours
        return
    is_free = False
    with suppress(OSError):  # of a file system without locks, too
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        is_free = True
    try:
        yield is_free
    finally:
        os.close(descriptor)


def check_new_folder(path: Path) -> None:
    """Refuse to write a result into a folder that holds something.

    Raises
    ------
    ValueError
        If there is a file, a folder that is not empty, or a mount point.
    """
    if os.path.ismount(path):
        raise ValueError(
            f"`output` must be a folder that can be created; got {path}, a mount point. Choose {path}/NAME."
        )
    if path.exists() and not (path.is_dir() and not any(path.iterdir())):
        raise ValueError(f"`output` must be a new or empty folder; got {path}. Choose another -o.")


def check_new(path: Path, option: str = "output") -> None:
    """Refuse to write over an existing file.

    Raises
    ------
    ValueError
        If there is a file of that name.
    """
    if path.exists() or path.is_symlink():
        raise ValueError(f"`{option}` must be a new file; got {path}. Choose another, or remove it.")


def reserve(path: Path, size: int) -> None:
    """Refuse a new file for which there is no space, before a library begins to write it.

    Raises
    ------
    OSError
        As a write would: a full disk, an exceeded quota, a limit of file sizes. No file is left.
    """
    with path.open("wb") as file:
        try:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)
            elif shutil.disk_usage(path.parent).free < size:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        except OSError:
            path.unlink()
            raise
        file.truncate(0)


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file whole or not at all."""
    with temporary_path(path) as partial:
        partial.write_bytes(data)
        partial.replace(path)


@contextmanager
def temporary_path(path: Path) -> Iterator[Path]:
    """Temporary hidden file name in the same folder, with the same ending; removed at the end.

    It is short, because the name of the file may be as long as the system allows.
    """
    partial = path.with_name(f".partial-{os.getpid()}-{content_hash(path.name, 12)}{path.suffix[-12:]}")
    try:
        yield partial
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def all_or_none(paths: Iterable[Path]) -> Iterator[None]:
    """Remove all new files of a command if it fails."""
    new = [path for path in paths if not path.exists()]
    try:
        yield
    except BaseException:
        for path in new:
            path.unlink(missing_ok=True)
        raise


def list_files(folder: Path) -> list[str]:
    """Sorted names of all files in a folder and below."""
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())
