"""Names of a package that are loaded when they are first asked for (PEP 562).

A package lists its names under ``TYPE_CHECKING``, where editors and type checkers look, and again as homes
for `lazy_names`; a test holds the two together. The commands list theirs once, under ``TYPE_CHECKING``, and
`load_guarded` puts them into place before a command runs.
"""

import ast
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

_HOMES: dict[str, Mapping[str, str]] = {}  # of each module whose names are lazy


def lazy_names(
    package: str, homes: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of a package.

    Parameters
    ----------
    package
        Its ``__name__``.
    homes
        Name to where it lives: ``module:attribute``, or ``module`` for a module.
    """
    _HOMES[package] = homes

    def load(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, _, attribute = homes[name].partition(":")
        found = import_module(module)
        value = _attribute(found, attribute) if attribute else found
        setattr(sys.modules[package], name, value)  # the next time it is simply there
        return value

    def names() -> list[str]:
        return sorted({*homes, *vars(sys.modules[package])})

    return load, names


def _attribute(module: ModuleType, name: str) -> Any:
    """What a module holds under a name: perhaps a module of the package that it is."""
    if not hasattr(module, name):
        import_module(f"{module.__name__}.{name}")
    return getattr(module, name)


def guarded_names(file: str) -> dict[str, str]:
    """Names that a module imports under ``if TYPE_CHECKING:``, and their homes, as `lazy_names` takes them.

    Parameters
    ----------
    file
        The module's ``__file__``.
    """
    found: dict[str, str] = {}
    for part in ast.parse(Path(file).read_text(encoding="utf-8")).body:
        if isinstance(part, ast.If) and ast.unparse(part.test) == "TYPE_CHECKING":
            for line in part.body:
                if isinstance(line, ast.ImportFrom):
                    found |= {one.asname or one.name: f"{line.module}:{one.name}" for one in line.names}
                elif isinstance(line, ast.Import):
                    found |= {one.asname or one.name: one.name for one in line.names}
    return found


def load_guarded(package: str) -> None:
    """Load the names that modules of a package import under ``if TYPE_CHECKING:``, of those loaded by now.

    Functions find such names only after that; a name that stands already is left alone.
    """
    for module in [name for name in _HOMES if name.startswith(f"{package}.")]:
        for name in _HOMES[module]:
            getattr(sys.modules[module], name)
