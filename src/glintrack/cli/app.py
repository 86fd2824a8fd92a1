"""The ``glintrack`` program: its commands by name, each loaded from its own file when it is called."""

import os
import signal
import sys
import warnings
from importlib import import_module
from typing import Annotated

import typer
import typer.core
from rich.console import Console

from glintrack.cli.options import STYLE
from glintrack.core.installation import VERSION
from glintrack.core.numba_cache import set_cache_folder
from glintrack.io.cache import cache_folder
from glintrack.io.untrusted import plain

# command -> the first sentence of its help, which `glintrack --help` shows without loading the command
COMMANDS = {
    "run": "Fly a case: city, frames, tracks, scores; writes a result folder.",
    "report": "Write one page that shows a run or a study and opens anywhere, without a network.",
    "view": "Show a result in the browser; pictures are sent as they are needed.",
    "video": "Write the film of a flight with its tracks as MP4 (extra `video`) or GIF.",
    "study": "Fly the cases of a study, `glintrack study FILE`, resuming where it stopped; or report on one.",
    "dataset": "Build a labelled set of frames, `glintrack dataset CASE… -o DIR`, or score baselines on one.",
    "case": "List the packaged cases, check a case file, or print all its keys.",
    "track": "Track your own detections or frames.",
    "bound": "Measure the loss budget from moving vehicles down to the reported pose, without a tracker.",
    "score": "Score tracks against the truth: completeness and purity (Eqs. 13 and 14), and more.",
    "ortho": "Rectify an image of your own by collinearity with its pose, onto a DEM, in any CRS.",
    "render": "Render one frame as the lens receives it.",
    "scene": "Build a city from your own data, look at it, export it.",
    "atmosphere": "Solve a polarized sky and path, and plot them.",
    "polarimetry": "Measure polarization in raw mosaics of a camera: Stokes vectors, DoLP and AoP.",
    "sensor": "Look at a sensor's design, or expose one frame with it.",
    "device": "Solve wire grids, etalons and micromirrors, and plot them.",
    "warm-up": "Compile all kernels of a simulation, once after an installation.",
}


class _LazyGroup(typer.core.TyperGroup):
    """List the commands by their first sentences, and load the one that is called."""

    def resolve_command(self, ctx, args):
        """Load the command that the first word names."""
        name, command, rest = super().resolve_command(ctx, args)
        return name, command if name is None else load_command(name), rest


app = typer.Typer(cls=_LazyGroup, help="Will this imaging sensor keep track of the vehicles?", **STYLE)


def load_command(name: str):
    """Import the module of a command, or of a group of commands, and return the command."""
    command = typer.main.get_command(import_module(f"glintrack.cli.{name.replace('-', '_')}").app)
    command.name = name
    return command


def load_program():
    """Load the program with every command, to read all of its help."""
    program = typer.main.get_command(app)
    program.commands = {name: load_command(name) for name in COMMANDS}  # pyright: ignore
    return program


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"glintrack {VERSION}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def begin(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", help="Show the version.", callback=_print_version, is_eager=True)
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
    _open_closed_streams()
    received = handle_signals()
    warnings.formatwarning = _format_warning
    set_cache_folder(cache_folder("kernels"))
    message, code = _run(received)
    if message:
        Console(stderr=True, soft_wrap=True, highlight=False).print(f"glintrack: {message}", markup=False)
    sys.exit(code)


def _run(received: list[int]) -> tuple[str, int]:
    """Run the command of the command line; return what to say about its end, and the exit code."""
    try:
        code = _call()
    except (ValueError, OSError, MemoryError) as error:
        if received:  # an interrupted library may raise anything
            return _interrupted(received)
        return _describe(error), 2
    except KeyboardInterrupt:
        return _interrupted(received)
    except Exception as error:
        if received:
            return _interrupted(received)
        if not hasattr(error, "format_message"):
            raise
        return _describe_usage(error), 2  # an error of the parser
    if code == _INTERRUPTED:
        return _interrupted(received)
    if received and code == 0:  # the command kept what was done and said so
        return f"stopped by {signal.Signals(received[0]).name}", 128 + received[0]
    return "", code


_INTERRUPTED = 130  # exit code that typer makes of Ctrl-C


def _call() -> int:
    for word in sys.argv[1:]:
        if plain(word, len(word)) != word:  # such a name would be printed again and again
            raise ValueError(
                f"names and values must be without control codes, got {word!r} (rename the file)"
            )
    code = typer.main.get_command(app)(prog_name="glintrack", standalone_mode=False)
    return code if isinstance(code, int) else 0


def _interrupted(received: list[int]) -> tuple[str, int]:
    return "interrupted, nothing written", 128 + (received[0] if received else signal.SIGINT)


def _describe(error: Exception) -> str:
    """Describe invalid input, a failed file access or a lack of memory."""
    if isinstance(error, OSError):
        return plain(f"{error.strerror or error}: {error.filename or 'output'}")
    if isinstance(error, MemoryError):
        return "not enough memory for this computation (use a smaller case or fewer workers)"
    return plain(error)


def _describe_usage(error: Exception) -> str:
    """Describe an error of the command line in the parser's words, with the command whose help to read."""
    context = getattr(error, "ctx", None)
    path = context.command_path if context is not None else "glintrack"
    return f"{plain(error.format_message()).rstrip('.')} (see `{path} --help`)"  # pyright: ignore


def _open_closed_streams() -> None:
    """Open the null device for standard streams that are closed, as files would take their place."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))


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
