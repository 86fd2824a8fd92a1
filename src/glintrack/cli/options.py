"""Options, consoles, tables and progress bars that commands share."""

import threading
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
import typer.core
from rich.box import SIMPLE
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table

from glintrack.core.progress import listen
from glintrack.io.readings import Reading
from glintrack.io.untrusted import plain

if TYPE_CHECKING:  # a case loads numba, which `--help` does without
    from glintrack.case.design import Case

STYLE: dict = {
    "add_completion": False,
    "pretty_exceptions_enable": False,
    "rich_markup_mode": "markdown",  # units in brackets, as [m], are markup to "rich" and would vanish
}
Area = tuple[float, float, float, float]  # west, south, east, north
Corner = tuple[float, float, float]  # west and north edge, and size of a pixel
LINE_S = 10.0  # between two lines of progress where the output is no terminal
BAR_WIDTH = 10  # characters of a progress bar; with its texts it fits into 80 columns
EXIT_CODES = {"no": 1, "undecided": 3}  # of a requirement that is not met


def option(help: str, *names: str, **limits: Any) -> Any:
    """Describe an option of a command; see `typer.Option`."""
    return typer.Option(*names, help=help, **limits)


def argument(help: str, **options: Any) -> Any:
    """Describe an argument of a command; see `typer.Argument`."""
    return typer.Argument(help=help, **options)


CaseArgument = Annotated[str, argument("Case file (TOML), or a packaged case, such as quickstart")]
ResultArgument = Annotated[Path, argument("Folder that `glintrack run` wrote")]
OutsidePathsOption = Annotated[bool, option("Allow files outside the case's folder", "--allow-outside-paths")]
FramesOption = Annotated[int | None, option("Number of frames to simulate [default: all]", min=1)]
BaseOption = Annotated[str | None, option("Case to compare with [default: the packaged case of its name]")]
RequireOption = Annotated[
    list[str] | None,
    option(
        "Required score, in quotes: 'custody>=0.8' or 'pan.false_per_km2<=40'; repeatable. "
        "Exit code 0: met, 1: not met, 3: undecided",
        "--require",
        metavar="SCORE>=NUMBER",
    ),
]


def group_with_default(command: str) -> type[typer.core.TyperGroup]:
    """Group of commands that calls one of them if the first word names none."""

    class WithDefault(typer.core.TyperGroup):
        def parse_args(self, ctx, args):
            if args and args[0] not in {*self.commands, "--help"}:
                args = [command, *args]
            return super().parse_args(ctx, args)

    return WithDefault


def command_app(help: str | None = None, default: str | None = None) -> typer.Typer:
    """Application for one command, or, with a help text, for a group of them with an optional default."""
    return typer.Typer(help=help, cls=group_with_default(default) if default else None, **STYLE)


def open_console() -> Console:
    """Console that prints lines without breaks and takes no text for markup."""
    return Console(soft_wrap=True, markup=False)


def make_table(
    title: str | None, headings: Sequence[str], rows: Iterable[Sequence[Any]], left: int = 1, **options: Any
) -> Table:
    """Table whose first ``left`` columns are aligned to the left; without headings if there are none."""
    options = {"box": SIMPLE, **options}
    table = Table(title=title, title_justify="left", show_header=bool(headings), **options)
    for k, heading in enumerate(headings):
        table.add_column(heading, justify="left" if k < left else "right")
    for row in rows:
        table.add_row(*row)
    return table


def print_readings(console: Console, readings: Iterable[Reading]) -> None:
    """Print what files have, what was used, and what was left out and why."""
    rows = []
    for reading in readings:
        reasons = [f"{count:,}: {reason}" for reason, count in reading.left_out] or ["–"]
        remarks = [*reasons, *reading.notes]
        counts = (f"{reading.found:,} {reading.content}", f"{reading.used:,}")
        rows.append((reading.file, *counts, "\n".join(map(plain, remarks))))
    if rows:
        headings = ("file", "in the file", "used", "left out, and why; how it was read")
        console.print(make_table("What was read", headings, rows, left=4))


class Bar(Progress):
    """Progress bar on a terminal; elsewhere a line every `LINE_S` seconds.

    Steps of the library (`core.progress.step`) follow the description of the last task.

    Parameters
    ----------
    columns
        Columns of the bar; by default description, bar and remaining time.
    transient
        Remove the bar at the end.
    """

    def __init__(self, console: Console, *columns: ProgressColumn, transient: bool = False):
        shown = columns or (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
        shows = console.is_terminal  # a bar that is not shown counts only without its own refresh
        super().__init__(*shown, console=console, transient=transient, disable=not shows, auto_refresh=shows)
        self._described: dict[TaskID, str] = {}
        self._step = ""
        self._stopped, self._exit = threading.Event(), ExitStack()

    def start(self) -> None:
        """Show the bar, or begin to print lines, and listen to the steps of the library."""
        super().start()
        self._exit.enter_context(listen(self._show_step))
        if self.disable:
            printer = threading.Thread(target=self._print_lines, daemon=True)
            printer.start()
            self._exit.callback(printer.join)
            self._exit.callback(self._stopped.set)

    def stop(self) -> None:
        """Remove or leave the bar."""
        self._exit.close()
        super().stop()

    def add_task(self, description: str, *args: Any, announce: bool = True, **options: Any) -> TaskID:
        """Add a task; see `rich.progress.Progress.add_task`. Without a terminal its first line is printed."""
        task_id = super().add_task(description, *args, **options)
        self._described[task_id] = description
        if self.disable and announce:
            self.console.print(description, markup=False, soft_wrap=True)
        return task_id

    def update(self, task_id: TaskID, **changes: Any) -> None:
        """Update a task; its field ``left`` ends its line where the bar is a line."""
        if "description" in changes:
            self._described[task_id] = changes["description"]
        changes["description"] = ": ".join(filter(None, (self._described[task_id], self._step)))
        super().update(task_id, **changes)

    def _show_step(self, text: str) -> None:
        self._step = text
        for task_id in self.task_ids[-1:]:
            self.update(task_id)

    def _print_lines(self) -> None:
        while not self._stopped.wait(LINE_S):
            for task in self.tasks[-1:]:
                done = f"{100 * task.completed / task.total:.0f} %" if task.total and task.completed else ""
                counted = f"{task.completed:.0f} done" if task.completed and not task.total else ""
                spent = f"after {task.elapsed or 0.0:.0f} s"
                texts = (task.description, done, counted, task.fields.get("left"), spent)
                self.console.print(", ".join(filter(None, texts)), markup=False, soft_wrap=True)


@contextmanager
def show_wait(console: Console, description: str) -> Iterator[None]:
    """Show that something of unknown length is done; without a terminal a line from `LINE_S` seconds on."""
    with Bar(console, transient=True) as bar:
        bar.add_task(description, total=None, announce=False)
        yield


def limit_frames(case: "Case", frames: int | None) -> "Case":
    """Case with at most some frames; warns where it has fewer."""
    whole = case.flight.frames
    if frames is not None and frames > whole:
        warnings.warn(
            f"the case has {whole} frames, which are simulated (for more: --set flight.frames={frames})",
            stacklevel=2,
        )
    return case if frames is None else case.replace({"flight.frames": min(frames, whole)})


def check_output(path: Path, *suffixes: str, option: str = "output") -> None:
    """Refuse, before any work, a file of another ending or in a folder that does not exist."""
    if suffixes and path.suffix.lower() not in suffixes:
        known = " or ".join(filter(None, (", ".join(suffixes[:-1]), suffixes[-1])))
        raise ValueError(f"`{option}` must end in {known}; got {path.name!r}.")
    if path.is_dir() or not path.absolute().parent.is_dir():
        raise ValueError(f"`{option}` must be a file in an existing folder; got {path}.")


def print_notes(console: Console, notes: Iterable[str]) -> None:
    """Print what is missing or unusual about a result."""
    for note in notes:
        console.print(f"note: {note}")


def check_answers(answers: Iterable[str]) -> None:
    """Exit with 1 if a requirement's answer is ``no``, with 3 if one is ``undecided``."""
    found = set(answers)
    for answer, code in EXIT_CODES.items():
        if answer in found:
            raise typer.Exit(code)
