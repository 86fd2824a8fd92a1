"""How far a command is: a bar on a terminal, and where output is a file a line at each tenth of the work."""

from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TaskID, TextColumn, TimeRemainingColumn

WIDTH = 10  # characters of a bar, beside which all that is said fits eighty


class Bar(Progress):
    """A bar with what is done, or lines in its place.

    Parameters
    ----------
    console
        Where it is shown.
    columns
        Beside each other on a terminal; by default what is done, the bar and the time left.
    transient
        Whether the bar goes at the end.

    A field ``left`` of a task, if it has one, ends its lines.
    """

    def __init__(self, console: Console, *columns: ProgressColumn, transient: bool = False):
        shown = columns or (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
        live = console.is_terminal or console.is_jupyter
        super().__init__(*shown, console=console, transient=transient, disable=not live)
        self._told: dict[TaskID, int] = {}

    def add_task(self, description: str, *args: Any, **options: Any) -> TaskID:
        """As `rich.progress.Progress.add_task` has it."""
        if self.disable:
            self.console.print(description, markup=False, soft_wrap=True)
        return super().add_task(description, *args, **options)

    def update(self, task_id: TaskID, **changes: Any) -> None:
        """As `rich.progress.Progress.update` has it."""
        super().update(task_id, **changes)
        task = next(task for task in self.tasks if task.id == task_id)
        tenths = int(10 * task.completed / task.total + 1e-9) if task.total else 0
        if self.disable and tenths > self._told.get(task_id, 0):
            self._told[task_id] = tenths
            left = task.fields.get("left")
            said = [task.description, f"{10 * tenths} %", *([left] if left else [])]
            self.console.print(", ".join(said), markup=False, soft_wrap=True)
