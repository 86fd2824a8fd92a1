"""Cases as arguments of commands, refused before what flies them is loaded if they are wrong."""

from importlib import import_module
from typing import Annotated

import typer

from glintrack.case.packaged import find_case
from glintrack.io.toml import read_toml


def checked_study(name: str) -> str:
    """The name or file of a study, refused before any library is loaded if it is none."""
    read_toml(find_case(name, "study"), "study")
    return name


def readable_case(name: str) -> str:
    """The name or file of a case, refused before any library is loaded if it is no TOML."""
    read_toml(find_case(name), "case")
    return name


def checked_case(name: str) -> str:
    """The name or file of a case, refused before what flies it is loaded if a key of it is wrong."""
    readable_case(name)  # before any library
    import_module("glintrack.case.design").Case.from_toml(find_case(name), anywhere=True)
    return name


_HELP = "A case file (TOML), or a packaged case by name: quickstart, braunschweig."
CaseArgument = Annotated[str, typer.Argument(help=_HELP, callback=checked_case)]
CaseToChange = Annotated[str, typer.Argument(help=_HELP, callback=readable_case)]
