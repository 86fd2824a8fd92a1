"""The ``glintrack`` program: its commands by name, each loaded from its module when it is called."""

import os
import re
import signal
import sys
import warnings
from collections.abc import Mapping
from importlib import import_module
from typing import Annotated

import typer
import typer.core
from rich.console import Console

from glintrack.cli.options import STYLE, open_console, option, print_readings
from glintrack.core.installation import VERSION, read_data
from glintrack.core.numba_cache import set_cache_folder
from glintrack.io.cache import cache_folder
from glintrack.io.readings import collect_readings
from glintrack.io.untrusted import plain

COMMANDS: Mapping[str, str] = read_data("commands.toml")
_MODULES = {"view": "report", "video": "report", "warm-up": "run"}  # others have their own
_UNIT = re.compile(r"\[([^\]:,]{1,8})[\],]")  # in the help of an option, such as [m]
_INTERRUPTED = 130  # exit code that typer makes of Ctrl-C


class _LazyGroup(typer.core.TyperGroup):
    """List the commands by their first sentences, and load the one that is called."""

    def resolve_command(self, ctx, args):
        """Load the command that the first word names."""
        name, command, rest = super().resolve_command(ctx, args)
        return name, command if name is None else load_command(name), rest


app = typer.Typer(cls=_LazyGroup, help="Will this imaging sensor keep track of the vehicles?", **STYLE)


def load_command(name: str):
    """Import the module of a command, or of a group of commands, and return the command."""
    module = import_module(f"glintrack.cli.{_MODULES.get(name, name)}")
    own = f"{name.replace('-', '_')}_app" if name in _MODULES else "app"
    command = typer.main.get_command(getattr(module, own))
    command.name = name
    return command


def load_program():
    """Load the program with every command, to read all of its help."""
    program = typer.main.get_command(app)
    program.commands = {name: load_command(name) for name in COMMANDS}  # pyright: ignore
    return program


def _print_version(requested: bool) -> None:
    if requested:
        print(f"glintrack {VERSION}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def begin(
    context: typer.Context,
    version: Annotated[
        bool, option("Show the version.", "--version", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Will this imaging sensor keep track of the vehicles?"""
    if context.invoked_subcommand is None:
        print(context.get_help())
        raise typer.Exit(2)


for _name, _sentence in COMMANDS.items():
    app.command(_name, help=_sentence)(lambda: None)  # replaced by `load_command` when it is called


def main() -> None:
    """Run the program. Invalid input is one sentence on the standard error stream and exit code 2."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # closed: a file that is opened would take its place
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))
    received = handle_signals()
    warnings.formatwarning = _format_warning
    set_cache_folder(cache_folder("kernels"))
    message, code = _run(received)
    if message:
        Console(stderr=True, soft_wrap=True, highlight=False).print(f"glintrack: {message}", markup=False)
    sys.exit(code)


def _run(received: list[int]) -> tuple[str, int]:
    """Run the command of the command line; return the message about its end, and the exit code."""
    try:
        code = _call()
    except (Exception, KeyboardInterrupt) as error:
        if received or isinstance(error, KeyboardInterrupt):  # an interrupted library may raise anything
            code = _INTERRUPTED
        else:
            return _describe(error), 2
    if code == _INTERRUPTED:
        return "interrupted, nothing written", 128 + (received[0] if received else signal.SIGINT)
    if received and code == 0:  # the command kept what was done and said so
        return f"stopped by {signal.Signals(received[0]).name}", 128 + received[0]
    return "", code


def _call() -> int:
    for word in sys.argv[1:]:
        if plain(word, len(word)) != word:  # such a name would be printed again and again
            raise ValueError(f"names and values must have no control codes; got {word!r}. Rename the file.")
    with collect_readings() as readings:
        code = typer.main.get_command(app)(prog_name="glintrack", standalone_mode=False)
    print_readings(open_console(), readings)
    return code if isinstance(code, int) else 0


def _describe(error: Exception) -> str:
    """Describe invalid input, a failed file access, a lack of memory or a wrong command line."""
    if isinstance(error, OSError):
        return plain(f"{error.strerror or error}: {error.filename or 'output'}")
    if isinstance(error, MemoryError):
        return "not enough memory for this computation (use a smaller case or fewer workers)"
    if isinstance(error, ValueError):
        return plain(error)
    if not hasattr(error, "format_message"):  # no error of the command line's parser
        raise error
    context, option = getattr(error, "ctx", None), getattr(error, "param", None)
    said, fault = error.format_message(), error.__cause__  # pyright: ignore
    if option is not None and hasattr(fault, "errors"):  # of pydantic, which typer has loaded
        first, unit = fault.errors()[0], _UNIT.search(option.help or "")  # pyright: ignore
        if first["type"] != "value_error":  # a number
            designs = import_module("glintrack.core.designs")
            said = designs.describe_value(first, max(option.opts, key=len), unit[1] if unit else "")
    hint = " separated by spaces" if re.search(r"requires \d arguments", said) else ""
    path = context.command_path if context is not None else "glintrack"
    return f"{plain(said).rstrip('.')}{hint} (see `{path} --help`)"


_default_format = warnings.formatwarning


def _format_warning(message, category, filename, lineno, line=None) -> str:
    """Format a warning of ours as one sentence, without its place in the source."""
    if issubclass(category, UserWarning):
        return f"glintrack: warning: {plain(message)}\n"
    return _default_format(message, category, filename, lineno, line)


def handle_signals() -> list[int]:
    """Let SIGTERM and SIGHUP end the program as Ctrl-C does; the list fills with the signals received."""
    received: list[int] = []

    def stop(number: int, _frame) -> None:
        received.append(number)
        raise KeyboardInterrupt

    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) not in (signal.SIG_IGN, None):  # as under nohup
            signal.signal(number, stop)
    return received
