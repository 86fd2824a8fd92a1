"""Cases as arguments of commands, refused before what flies them is loaded if they are wrong."""

from importlib import import_module
from typing import Annotated

import typer

from glintrack.io.toml import read_toml
from glintrack.packaged import find_case


def checked_study(name: str) -> str:
    """The name or file of a study, refused before any library is loaded if it is none."""
    read_toml(find_case(name, "study"), "study")
    return name


def checked_case(name: str) -> str:
    """The name or file of a case, refused before what flies it is loaded if a key of it is wrong."""
    path = find_case(name)
    read_toml(path, "case")  # before any library
    import_module("glintrack.config").Case.from_toml(path, anywhere=True)
    return name


CaseArgument = Annotated[
    str,
    typer.Argument(
        help="A case file (TOML), or a packaged case by name: quickstart, braunschweig.",
        callback=checked_case,
    ),
]
