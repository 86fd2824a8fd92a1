"""The ``glintrack`` program: its commands by name, each loaded from its own file when it is called."""

import _thread
import atexit
import functools
import gc
import os
import signal
import sys
import threading
import warnings
from importlib import import_module
from typing import Annotated

import typer
import typer.core
from rich.console import Console

from glintrack.cli.options import STYLE
from glintrack.core.about import VERSION
from glintrack.core.heaps import share_heaps
from glintrack.core.kernels.early import start_early
from glintrack.core.lazy import load_guarded
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
    "bound": "Measure the ladder from moving vehicles down to the reported pose, without a tracker.",
    "score": "Score tracks against the truth: completeness and purity (Eqs. 13 and 14), and more.",
    "ortho": "Rectify an image of your own by collinearity with its pose, onto a DEM, in any CRS.",
    "render": "Render one frame as the lens receives it.",
    "scene": "Build a city from your own data, look at it, export it.",
    "atmosphere": "Solve a polarized sky and path, and plot them.",
    "polarimetry": "Measure polarization in raw mosaics of a camera: Stokes vectors, DoLP and AoP.",
    "sensor": "Look at a sensor's design, or expose one frame with it.",
    "device": "Solve wire grids, etalons and micromirrors, and plot them.",
}
# typer brings a parser of its own, or takes that of click: the error is a base of what it makes public
UsageError: type[Exception] = typer.BadParameter.__mro__[1]  # pyright: ignore[reportAssignmentType]
FLIES = ("run",)  # begins at once to compile what a flight calls


class _LoadedWhenCalled(typer.core.TyperGroup):
    """Lists the commands by their first sentences; loads the one that is called.

    What is wrong with a command line is one sentence, as of every other input.
    """

    def main(self, *words, standalone_mode: bool = True, **extra):
        """Call a command and end, with its exit code; a wrong command line raises ValueError."""
        try:
            code = super().main(*words, standalone_mode=False, **{"prog_name": "glintrack", **extra})
        except UsageError as error:
            if type(error).__name__ == "NoArgsIsHelpError":  # the help was shown
                sys.exit(2)
            raise ValueError(import_module("glintrack.cli.usage").usage_sentence(error)) from error
        if standalone_mode:
            sys.exit(code if isinstance(code, int) else 0)
        return code

    def resolve_command(self, ctx, args):
        """The command that the first word names, loaded."""
        name, command, rest = super().resolve_command(ctx, args)
        if name in FLIES and "--help" not in rest:
            start_early()  # before what takes seconds to load
        return name, command if name is None else load_command(name), rest


_as_python_does = warnings.formatwarning
app = typer.Typer(cls=_LoadedWhenCalled, help="Will this imaging sensor keep track of the vehicles?", **STYLE)


def load_command(name: str):
    """A command or group of commands from its file; all of its parameters are known then.

    What takes seconds to load is loaded when it is called, so that a wrong command line is told at once.
    """
    made = import_module(f"glintrack.cli.{name}").app
    command = typer.main.get_command(made)
    command.name = name
    _load_when_called(command)
    return command


def _load_when_called(command) -> None:
    """Put the libraries of `load_guarded` before a command, or before each of a group."""
    for one in getattr(command, "commands", {}).values():
        _load_when_called(one)
    callback = command.callback
    if not (callback is None or hasattr(command, "commands") or hasattr(callback, "at_once")):

        @functools.wraps(callback)
        def called(*words, **options):
            load_guarded("glintrack.cli")
            gc.freeze()  # 200,000 objects of libraries, which none but the end would ever collect
            gc.enable()
            return callback(*words, **options)

        command.callback = called


def load_program():
    """The program with every command loaded, for who wants to read all of its help."""
    program = typer.main.get_command(app)
    program.commands = {name: load_command(name) for name in COMMANDS}  # pyright: ignore
    return program


def _tell_version(wanted: bool) -> None:
    if wanted:
        print(f"glintrack {VERSION}")
        raise typer.Exit


@app.callback()
def begin(
    version: Annotated[
        bool, typer.Option("--version", help="Show the version.", callback=_tell_version, is_eager=True)
    ] = False,
) -> None:
    """Will this imaging sensor keep track of the vehicles?"""
    sys.excepthook = _show_raised  # here, as typer sets its own when it is called


def _listed(name: str, sentence: str) -> None:
    """Make a command known without loading it."""

    def stands_in() -> None:
        raise RuntimeError(f"`{name}` stands in for a command that is loaded when it is called")

    app.command(name, help=sentence)(stands_in)


for _name, _sentence in COMMANDS.items():
    _listed(_name, _sentence)


def main() -> None:
    """Run the program; bad input is one sentence on stderr and exit code 2."""
    gc.disable()  # until libraries are loaded, see `_load_when_called`: a sixth of the time that takes
    _open_closed()
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    received = heed_signals()
    warnings.formatwarning = _as_sentence
    # before NumPy is loaded: helpers of a matrix product spin for 25 ms after it, on cores that flights want
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    share_heaps()
    try:
        _call(received)
    except SystemExit as done:
        if not received or done.code not in (0, None, 130):
            raise
        # what was done is kept and said by the command; the shell is told why it ended
        console.print(f"glintrack: stopped by {signal.Signals(received[0]).name}")
        sys.exit(128 + received[0])
    except ValueError as error:  # of pydantic, too: designs tell their faults as sentences
        console.print(f"glintrack: {plain(error)}", markup=False)
        sys.exit(2)
    except OSError as error:  # a full disk, a folder that may not be written
        what = f"{error.strerror or error}: {error.filename or 'output'}"
        console.print(f"glintrack: {plain(what)}", markup=False)
        sys.exit(2)
    except MemoryError:
        console.print("glintrack: memory must hold what is computed, got too little of it")
        sys.exit(2)
    except KeyboardInterrupt:
        console.print("glintrack: interrupted, nothing written", markup=False)
        sys.exit(128 + (received[0] if received else signal.SIGINT))
    finally:
        gc.enable()


def program() -> None:
    """`main` as a process, which ends at once: to take libraries down first takes half a second."""
    try:
        main()
    except SystemExit as done:
        if not (done.code is None or isinstance(done.code, int)):
            raise
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        except OSError:  # nobody reads, or the disk is full: Python says so
            raise done from None
        atexit._run_exitfuncs()
        os._exit(done.code or 0)


def _open_closed() -> None:
    """Give standard streams that are closed a place to go, or the first files opened would be theirs."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))


def _as_sentence(message, category, filename, lineno, line=None) -> str:
    """A warning of ours as one sentence, without the place in the source where it was given."""
    if issubclass(category, UserWarning):
        return f"glintrack: warning: {plain(message)}\n"
    return _as_python_does(message, category, filename, lineno, line)


def _call(received: list[int]) -> None:
    for word in sys.argv[1:]:
        if plain(word, len(word)) != word:  # what is written under such a name is shown again and again
            raise ValueError(
                f"names and values must be without control codes, got {word!r} (rename the file)"
            )
    try:
        app(standalone_mode=True)
    except Exception as error:
        if not received:
            raise
        # an interrupted compilation leaves a library's state torn, and what it raises then says nothing
        raise KeyboardInterrupt from error


def heed_signals() -> list[int]:
    """Let SIGTERM and SIGHUP end the program as Ctrl-C does; the list fills with what was received."""
    received: list[int] = []

    def stop(number: int, _frame) -> None:
        received.append(number)
        raise KeyboardInterrupt

    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) not in (signal.SIG_IGN, None):  # as under nohup
            signal.signal(number, stop)
    sys.unraisablehook = _heed_unraisable(received, sys.unraisablehook)
    return received


def _show_raised(kind, error, traceback) -> None:
    """As Python does, but of texts in callbacks of C, which have no traceback; see `_heed_unraisable`."""
    if traceback is not None or kind is not UnicodeDecodeError:
        sys.__excepthook__(kind, error, traceback)


def _heed_unraisable(received: list[int], before):
    """A hook for what cannot be raised: an interrupt that fell into a library's callback comes once more.

    What GDAL remarks of a damaged file in bytes that are no text is left out; who reads the file says what is
    wrong with it.
    """

    def hook(unraisable) -> None:
        if received and issubclass(unraisable.exc_type, KeyboardInterrupt):
            timer = threading.Timer(0.01, _thread.interrupt_main, (received[-1],))
            timer.daemon = True
            timer.start()
        elif not (
            issubclass(unraisable.exc_type, UnicodeDecodeError) and "rasterio" in str(unraisable.object)
        ):
            before(unraisable)

    return hook
