"""Name a case by hashes of its content, of the files that it names, and of the program's source."""

import json
import tomllib
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from glintrack.case.design import Case
from glintrack.core.installation import VERSION, package_version
from glintrack.io.atomic import content_hash
from glintrack.io.untrusted import is_file

DECIDE_SCORES = ("embreex", "eclipse-sumo", "sasktran2")
_MAX_NAME = 4096  # characters
_PACKAGE = Path(__file__).parents[1]
# parts that show results or run cases, and do not influence scores
_SHOWS_ONLY = ("cli", "results/figures", "report", "study", "data/cases", "data/page")
_SIMULATES = ("study/workers.py",)


def case_key(case: Case) -> str:
    """Hash of a case without its name, of the contents of its files, and of the program's source."""
    content = case.model_dump(mode="json", exclude={"name"})
    whole = {"case": without_paths(content), "glintrack": VERSION, "source": source_key()}
    return content_hash(json.dumps(whole, sort_keys=True), 20)


def without_paths(value: Any) -> Any:
    """Plain values with hashes for each file named by its whole path, and for the files that it names."""
    if isinstance(value, dict):
        return {key: without_paths(v) for key, v in value.items()}
    if isinstance(value, list):
        return [without_paths(v) for v in value]
    if isinstance(value, str) and Path(value).is_absolute() and is_file(Path(value)):
        names = sorted(set(_named_files(Path(value))))
        hashes = [content_hash(path.read_bytes()) for path in names]
        own = {"sha256": content_hash(Path(value).read_bytes())}
        return own | ({"named": hashes} if hashes else {})
    return value


def _named_files(path: Path) -> Iterator[Path]:
    """Files that a table of materials (TOML) or a mesh (glTF, OBJ) names, such as spectra and buffers."""
    values: Any = {}
    with suppress(ValueError):  # what cannot be read is refused where it is used
        if path.suffix.lower() == ".toml":
            values = tomllib.loads(path.read_text(encoding="utf-8"))
        elif path.suffix.lower() == ".gltf":
            values = json.loads(path.read_bytes())
        elif path.suffix.lower() == ".obj":
            lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
            values = [line.split(maxsplit=1)[-1].strip() for line in lines if line.startswith("mtllib")]
    for text in _texts(values):
        if len(text) < _MAX_NAME and is_file(path.parent / text):
            yield path.parent / text


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    for inner in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from _texts(inner)


@lru_cache(maxsize=1)
def source_key() -> str:
    """Hash of the source, data and packages that influence a case's scores."""
    shown = {path for pattern in _SHOWS_ONLY for path in _PACKAGE.glob(pattern)}
    parts = [path for path in _PACKAGE.iterdir() if path not in shown]
    parts += [_PACKAGE / name for name in _SIMULATES]
    return digest(parts, DECIDE_SCORES, shown)[:20]


def digest(parts: Iterable[str | Path], packages: Iterable[str], without: Iterable[Path] = ()) -> str:
    """Hash of files' names and contents, and of packages' versions.

    Parameters
    ----------
    parts
        Files and folders of this package.
    packages
        Distributions, whether installed or not.
    without
        Files and folders that are left out of folders.
    """
    left_out = set(without)
    found: list[str | bytes] = []
    for part in sorted(_PACKAGE / one for one in parts):
        for file in sorted(part.rglob("*")) if part.is_dir() else [part]:
            skipped = "__pycache__" in file.parts or (file != part and left_out & {file, *file.parents})
            if file.is_file() and not skipped:
                found.append(f"{file.relative_to(_PACKAGE).as_posix()} ")
                found.append(bytes.fromhex(content_hash(file.read_bytes())))
    for name in packages:
        found.append(f"{name} {package_version(name)}")
    return content_hash(found)
