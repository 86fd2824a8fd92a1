"""``glintrack report``: a result or a study as one page."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import track as progress

from glintrack.cli.options import BaseOption, check_file, command_app, print_notes
from glintrack.io import atomic
from glintrack.report import build_page
from glintrack.report.study_page import RUN_PAGE, build_study_page, is_study
from glintrack.results.read import read_result

app = command_app()
AnyArgument = Annotated[
    list[Path],
    typer.Argument(metavar="RESULT", help="A folder that `glintrack run` or `glintrack study` wrote"),
]


@app.command()
def report(
    results: AnyArgument,
    output: Annotated[Path, typer.Option("-o", "--output", help="HTML file to write")] = Path("report.html"),
    base: BaseOption = None,
    runs: Annotated[
        bool, typer.Option("--runs", help="Of a study: write the page of every finished run too, and link it")
    ] = False,
) -> None:
    """Write one page that shows a run or a study and opens anywhere, without a network."""
    if output.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"`output` must end in .html, got {output.name!r}")
    check_file(output)
    if len(results) > 1:
        raise ValueError(
            f"`report` must get one result, got {len(results)} (two designs are compared, with intervals, by "
            "`glintrack study`: docs/guide/study.md)"
        )
    (result,) = results
    console = Console(soft_wrap=True)
    if is_study(result):
        if runs:
            _write_runs(result, base)
        atomic.write_text(output, build_study_page(result, output.parent))
        console.print(f"wrote {output}: links lead to {result / 'cases'}", markup=False)
        return
    found = read_result(result)
    text = build_page(found, base)
    atomic.write_text(output, text)
    print_notes(console, found.notes)
    console.print(f"wrote {output}: {len(text.encode()) / 1e6:.1f} MB", markup=False)


def _write_runs(study: Path, base: str | None) -> None:
    """The page of each finished case, beside its result."""
    cases = sorted(p for p in (study / "cases").glob("*") if (p / "result.nc").is_file())
    for case in progress([c for c in cases if not c.name.startswith(".")], "pages of runs"):
        atomic.write_text(case / RUN_PAGE, build_page(read_result(case), base))
