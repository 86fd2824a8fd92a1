"""Options that commands share: help, cases, areas, outputs."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer
import typer.core
from rich.console import Console

if TYPE_CHECKING:  # `glintrack --help` needs none of it
    from glintrack.results.read import Result

Command = TypeVar("Command", bound=Callable)
STYLE: dict = {
    "no_args_is_help": True,
    "add_completion": False,
    "pretty_exceptions_enable": False,
    "rich_markup_mode": "markdown",  # units in brackets, as [m], are markup to "rich" and would vanish
}


def group_with_default(command: str) -> type[typer.core.TyperGroup]:
    """A group of commands whose words mean one of them where they name none."""

    class WithDefault(typer.core.TyperGroup):
        def parse_args(self, ctx, args):
            if args and args[0] not in {*self.commands, "--help"}:
                args = [command, *args]
            return super().parse_args(ctx, args)

    return WithDefault


AnywhereOption = Annotated[
    bool,
    typer.Option("--files-anywhere", help="Let the file name others outside its own folder: one you trust"),
]
ResultArgument = Annotated[Path, typer.Argument(help="A folder that `glintrack run` wrote")]
BaseOption = Annotated[
    str | None,
    typer.Option(
        help="Case to compare the design with [default: the packaged case of that name, or defaults]"
    ),
]


def command_app(help: str | None = None) -> typer.Typer:
    """An empty application for one command, or, with a help text, for a group of them."""
    return typer.Typer(help=help, **STYLE) if help else typer.Typer(**{**STYLE, "no_args_is_help": False})


def at_once(command: Command) -> Command:
    """Mark a command that needs none of the libraries which are loaded when a command is called."""
    vars(command)["at_once"] = True
    return command


def check_folder(output: Path) -> None:
    """Refuse, before anything is solved, a file in a folder that is not there."""
    if not output.parent.is_dir():
        raise ValueError(f"`output` must lie in an existing folder, got {output}")


def check_file(output: Path) -> None:
    """Refuse a file that cannot be put in its place before anything is made."""
    if output.is_dir() or not output.parent.is_dir():
        raise ValueError(f"`output` must be a file in an existing folder, got {output}")


def say_notes(console: Console, result: "Result") -> None:
    """What is missing or odd about a result."""
    for note in result.notes:
        console.print(f"note: {note}", markup=False)
