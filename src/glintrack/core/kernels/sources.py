"""Which files a kernel is compiled from: its own, and those of what it calls and reads by name.

numba keeps a kernel by its own file alone: a part that changed in another would go unseen.
"""

import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any
from zlib import crc32

_IMPORT = re.compile(r"^from ([\w.]+) import (?:\(([^)]*)\)|([^\n(]*))", re.MULTILINE)
_OURS = tuple(Path(__file__).with_name(name) for name in ("indices.py", "parts.py"))  # how all are compiled

Stamp = tuple[tuple[str, int, int], ...]


def stamp(function: Callable[..., Any]) -> Stamp:
    """Name, size and checksum of each file of a kernel's package that it is compiled from.

    Those of functions that it calls, directly or not, and of modules that it or they import a name from.
    """
    package, root = function.__module__.split(".")[0], _root(function)
    files, waiting, known = set(_OURS), [function], {function}
    while waiting:
        one = waiting.pop()
        files.add(Path(one.__code__.co_filename))
        names = set(_names(one.__code__))
        imported = _imported(root, one.__code__.co_filename)
        files.update(imported[name] for name in names & imported.keys())
        for called in _called(one, names):
            if called not in known and called.__module__.split(".")[0] == package:
                known.add(called)
                waiting.append(called)
    return tuple(sorted(_told(path) for path in files if path.is_file()))


def _root(function: Callable[..., Any]) -> Path:
    """The folder that a function's package lies in."""
    path = Path(function.__code__.co_filename)
    for _ in range(function.__module__.count(".") + 1 + (path.stem == "__init__")):
        path = path.parent
    return path


@cache
def _told(path: Path) -> tuple[str, int, int]:
    content = path.read_bytes()
    return path.name, len(content), crc32(content)


def _names(code: CodeType) -> Iterator[str]:
    """Global names and attributes that a function and those within it use."""
    yield from code.co_names
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _names(inner)


def _called(function: Callable[..., Any], names: set[str]) -> Iterator[Callable[..., Any]]:
    """Compiled functions that it calls by their name, or as attributes of modules."""
    known = function.__globals__
    found = [known[name] for name in names if name in known]
    modules = [one for one in found if isinstance(one, ModuleType)]
    found += [getattr(module, name, None) for module in modules for name in names]
    return (one.py_func for one in found if hasattr(one, "py_func"))


@cache
def _imported(root: Path, file: str) -> dict[str, Path]:
    """File that each name comes from which a file imports from a module of its package."""
    text = Path(file).read_text(encoding="utf-8") if Path(file).is_file() else ""  # none of a notebook's cell
    out = {}
    for module, within, plain in _IMPORT.findall(text):
        place = root.joinpath(*module.split("."))
        for line in (within or plain).splitlines():
            for one in line.split("#")[0].split(","):
                words = one.split()
                if words:
                    out[words[-1]] = _file(place / words[0]) or _file(place) or place
    return out


def _file(module: Path) -> Path | None:
    """Source of a module by the path that its name says; None if there is none."""
    return next((one for one in (module.with_suffix(".py"), module / "__init__.py") if one.is_file()), None)
