"""Write files and folders that appear whole or not at all, and hash their contents."""

import errno
import glob
import hashlib
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path


def content_hash(parts: str | bytes | Iterable[str | bytes], digits: int = 64) -> str:
    """Leading hexadecimal digits of the SHA-256 of parts one after another; text as UTF-8."""
    found = hashlib.sha256()
    for part in (parts,) if isinstance(parts, str | bytes) else parts:
        found.update(part.encode() if isinstance(part, str) else part)
    return found.hexdigest()[:digits]


class ResultFolder:
    """A result folder that appears whole: written beside its name, renamed at the end.

    Parameters
    ----------
    path
        Must not exist yet, or be an empty folder.

    Raises
    ------
    ValueError
        If the path holds something or its parent cannot be written.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        check_new_folder(self.path)
        self.partial = self.path.with_name(f".{self.path.name}.partial-{os.getpid()}")
        shutil.rmtree(self.partial, ignore_errors=True)  # of a process that had this number and was killed
        try:
            self.partial.mkdir(parents=True)
        except OSError as error:
            raise ValueError(f"`output` must be writable, got {self.path} ({error.strerror})") from error
        self._alone()

    def _alone(self) -> None:
        """Remove what killed processes left of this folder; refuse if a living one writes it."""
        begin = f".{self.path.name}.partial-"
        for other in self.path.parent.glob(f"{glob.escape(begin)}*"):
            number = other.name.removeprefix(begin)
            if other == self.partial or not number.isdecimal():
                continue
            if _is_alive(int(number)):
                self.discard()
                raise ValueError(
                    f"`output` must not be written by another run, got {self.path}, which process {number} "
                    "writes (choose another -o, or wait)"
                )
            shutil.rmtree(other, ignore_errors=True)

    def publish(self) -> Path:
        """Give the folder its name."""
        self.partial.rename(self.path)
        return self.path

    def discard(self) -> None:
        """Remove what was written so far."""
        shutil.rmtree(self.partial, ignore_errors=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # somebody else's
        return True
    return True


def check_new_folder(path: Path) -> None:
    """Refuse to write a result into a folder that holds something.

    Raises
    ------
    ValueError
        If something is there, but for an empty folder.
    """
    if path.exists() and not (path.is_dir() and not any(path.iterdir())):
        raise ValueError(
            f"`output` must be a new or empty folder, got {path}, which exists (choose another -o)"
        )


def check_new(path: Path, option: str = "output") -> None:
    """Refuse to write over a file: nobody is asked, and what lies there may be all there is of it.

    Raises
    ------
    ValueError
        If something of that name is there.
    """
    if path.exists() or path.is_symlink():
        raise ValueError(
            f"`{option}` must be a new file, got {path}, which exists (choose another, or remove it)"
        )


def reserve(path: Path, size: int) -> None:
    """Refuse a new file for which there is no room, before a library begins to write it.

    Raises
    ------
    OSError
        As a write would: a full disk, a spent quota, a limit to the size of files. Nothing is left.
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
    """A hidden name in the same folder, of the same ending, to make a file under; removed at the end.

    It is short: a file may have a name as long as the system takes.
    """
    partial = path.with_name(f".partial-{os.getpid()}-{content_hash(path.name, 12)}{path.suffix[-12:]}")
    try:
        yield partial
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def all_or_none(paths: Iterable[Path]) -> Iterator[None]:
    """Files that one command makes: where it fails at one of them, the others, if new, go too."""
    fresh = [path for path in paths if not path.exists()]
    try:
        yield
    except BaseException:
        for path in fresh:
            path.unlink(missing_ok=True)
        raise


def listing(folder: Path) -> Iterable[str]:
    """Names of all files below a folder, sorted."""
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())
