"""Names of a module that are loaded when they are first asked for (PEP 562).

A module imports them under ``if TYPE_CHECKING:``, where editors and type checkers look; `lazy_names` reads
that block and makes them load at run time. In packages they load one by one; the commands have all of theirs
put into place by `load_guarded` before one runs.
"""

import ast
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

_HOMES: dict[str, Mapping[str, tuple[str, str]]] = {}  # of each module whose names are lazy


def lazy_names(module: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of a module.

    Parameters
    ----------
    module, file
        Its ``__name__`` and ``__file__``.
    """
    homes = _HOMES[module] = _guarded_names(file)

    def load(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        value = _loaded(*homes[name], module)
        setattr(sys.modules[module], name, value)  # the next time it is simply there
        return value

    def names() -> list[str]:
        return sorted({*homes, *vars(sys.modules[module])})

    return load, names


def _loaded(home: str, attribute: str, asking: str) -> Any:
    """What a module holds under a name: perhaps a module of the package that it is."""
    if not attribute:
        return import_module(home)
    if home != asking:
        found = import_module(home)
        if hasattr(found, attribute):
            return getattr(found, attribute)
    return import_module(f"{home}.{attribute}")


def _guarded_names(file: str) -> dict[str, tuple[str, str]]:
    """Names that a module imports under ``if TYPE_CHECKING:``: which module, and what of it."""
    found: dict[str, tuple[str, str]] = {}
    for part in ast.parse(Path(file).read_text(encoding="utf-8")).body:
        if isinstance(part, ast.If) and ast.unparse(part.test) == "TYPE_CHECKING":
            for line in part.body:
                if isinstance(line, ast.ImportFrom):
                    found |= {one.asname or one.name: (str(line.module), one.name) for one in line.names}
                elif isinstance(line, ast.Import):
                    found |= {one.asname or one.name: (one.name, "") for one in line.names}
    return found


def load_guarded(package: str) -> None:
    """Load the names that modules of a package import under ``if TYPE_CHECKING:``, of those loaded by now.

    Functions find such names only after that; a name that stands already is left alone.
    """
    for module in [name for name in _HOMES if name.startswith(f"{package}.")]:
        for name in _HOMES[module]:
            getattr(sys.modules[module], name)
