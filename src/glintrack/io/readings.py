"""Account for what was read: what a file has, what of it was used, and what was left out and why.

Readers call `report_reading`. The program collects the reports of a command by `collect_readings` and prints
them as its last table. A reader that cannot explain a difference between file and result is refused.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Reading:
    """One kind of content of one file.

    Parameters
    ----------
    file
        Name of the file, without its folder.
    content
        What was counted, as a plural: ``vehicles``, ``bands``.
    found, used
        Number in the file, and number used. [1]
    left_out
        (reason, number) of what was not used; the reason continues "3 of them: ".
    notes
        How the content was understood, one phrase each: units, scale, CRS, time zero.
    """

    file: str
    content: str
    found: int
    used: int
    left_out: tuple[tuple[str, int], ...] = ()
    notes: tuple[str, ...] = ()


_readings: ContextVar[list[Reading] | None] = ContextVar("readings", default=None)


@contextmanager
def collect_readings() -> Iterator[list[Reading]]:
    """Collect what is read within a ``with`` block; an inner block hides its readings from an outer one."""
    readings: list[Reading] = []
    token = _readings.set(readings)
    try:
        yield readings
    finally:
        _readings.reset(token)


def report_reading(
    path: Path | str,
    content: str,
    found: int,
    used: int,
    left_out: Mapping[str, int] | None = None,
    notes: Sequence[str] = (),
) -> None:
    """Report one kind of content of a file, see `Reading`; ``left_out`` is the number by reason.

    Count ``found`` in the file and ``used`` in the result, each by itself.

    Raises
    ------
    ValueError
        If ``found`` is not ``used`` plus what was left out: something was lost, or came twice.
    """
    reasons = tuple((reason, count) for reason, count in (left_out or {}).items() if count)
    known = used + sum(count for _, count in reasons)
    if found != known:
        raise ValueError(
            f"`{Path(path).name}` must be read whole; got {used:,} of its {found:,} {content}, "
            f"and {known - used:,} left out for a known reason. Convert the file to another format."
        )
    readings = _readings.get()
    reading = Reading(Path(path).name, content, found, used, reasons, tuple(notes))
    if readings is not None and reading not in readings:
        readings.append(reading)
