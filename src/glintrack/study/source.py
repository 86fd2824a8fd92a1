"""Which code results come from: a version number stays the same while its source is edited."""

from collections.abc import Iterable
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from glintrack.io.digest import content_hash

_PACKAGE = Path(__file__).parents[1]
# what shows results, or runs cases, and has no part in what a case scores; all else has, also what is new
_SHOWS_ONLY = ("cli", "results/figures", "report", "study", "data/cases", "data/page")
_FLIES = ("study/task.py",)
DECIDE_SCORES = ("embreex", "eclipse-sumo", "sasktran2")


@lru_cache(maxsize=1)
def source_key() -> str:
    """Hash of the source, data and packages that decide a case's scores: other code has other results."""
    shown = {path for pattern in _SHOWS_ONLY for path in _PACKAGE.glob(pattern)}
    parts = [path for path in _PACKAGE.iterdir() if path not in shown]
    parts += [_PACKAGE / name for name in _FLIES]
    return digest(parts, DECIDE_SCORES, shown)[:20]


def digest(parts: Iterable[Path], packages: Iterable[str], without: Iterable[Path] = ()) -> str:
    """Hash of files' names and contents, and of packages' versions.

    Parameters
    ----------
    parts
        Files and folders of this package; of a folder all that is in it. A file that is named counts.
    packages
        Distributions; one that is not installed counts as such.
    without
        Files and folders in them that are left out.
    """
    left_out = set(without)
    found: list[str | bytes] = []
    for part in sorted(parts):
        for file in sorted(part.rglob("*")) if part.is_dir() else [part]:
            if not file.is_file() or "__pycache__" in file.parts:
                continue
            if file != part and left_out & {file, *file.parents}:
                continue
            found.append(f"{file.relative_to(_PACKAGE).as_posix()} ")
            found.append(bytes.fromhex(content_hash(file.read_bytes())))
    for name in packages:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"no {name}")
    return content_hash(found)
