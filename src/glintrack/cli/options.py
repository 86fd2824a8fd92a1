"""Options that commands share: help, cases, areas, outputs."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer
import typer.core
from rich.console import Console

STYLE: dict = {
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


CaseArgument = Annotated[
    str, typer.Argument(help="A case file (TOML), or a packaged case by name: quickstart, braunschweig.")
]
OutsidePathsOption = Annotated[
    bool,
    typer.Option("--allow-outside-paths", help="Allow file paths outside the file's own folder"),
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
    return typer.Typer(help=help, **STYLE)


def check_folder(output: Path) -> None:
    """Refuse, before anything is solved, a file in a folder that is not there."""
    if not output.parent.is_dir():
        raise ValueError(f"`output` must lie in an existing folder, got {output}")


def check_file(output: Path) -> None:
    """Refuse a file that cannot be put in its place before anything is made."""
    if output.is_dir() or not output.parent.is_dir():
        raise ValueError(f"`output` must be a file in an existing folder, got {output}")


def print_notes(console: Console, notes: Iterable[str]) -> None:
    """Print what is missing or unusual about a result."""
    for note in notes:
        console.print(f"note: {note}", markup=False)
