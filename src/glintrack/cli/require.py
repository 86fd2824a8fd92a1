"""``--require``: what a design must reach, and the exit code that says whether it does."""

from collections.abc import Sequence
from typing import Annotated

import typer
from rich.console import Console

from glintrack.metrics.requirement import Assessment, Requirement, describe_assessment

EXIT_CODES = {"yes": 0, "no": 1, "undecided": 3}

RequireOption = Annotated[
    list[str] | None,
    typer.Option(
        "--require",
        metavar="SCORE>=NUMBER",
        help="What must be reached, in quotes: 'custody>=0.8' or 'pan.false_per_km2<=40'; repeatable. "
        "Exit code 0: it is, 1: it is not, 3: undecided",
    ),
]


def tell(console: Console, judged: Sequence[tuple[Requirement, Assessment]]) -> None:
    """A sentence each; exits unless all requirements are met."""
    for requirement, found in judged:
        console.print(describe_assessment(requirement, found), soft_wrap=True, markup=False)
    exit_by([found for _, found in judged])


def exit_by(judged: Sequence[Assessment]) -> None:
    """Exit with 1 if something is not met, with 3 if something is undecided."""
    answers = {found.answer for found in judged}
    for answer in ("no", "undecided"):
        if answer in answers:
            raise typer.Exit(EXIT_CODES[answer])
