"""``glintrack study``: fly many cases of one base, and say what they show."""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportGeneralTypeIssues=false

import math
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import typer
import typer.core
from rich.box import SIMPLE
from rich.console import Console
from rich.progress import BarColumn, TextColumn
from rich.table import Table

from glintrack.case.packaged import find_case
from glintrack.cli.options import STYLE, OutsidePathsOption, group_with_default
from glintrack.cli.progress import WIDTH, Bar
from glintrack.cli.require import RequireOption, exit_by
from glintrack.core.units import format_duration
from glintrack.io.cache import cache_folder
from glintrack.metrics.requirement import Requirement, read_requirement
from glintrack.study import (
    Plan,
    Pool,
    RunReport,
    StudyEvent,
    StudyFolder,
    StudyPace,
    dask,
    forecast,
    processes,
    read_plan,
    read_results,
    run_study,
    serial,
    write_report,
    write_results,
)
from glintrack.study.plan import field_notes, length_notes
from glintrack.study.report import check_points, view_notes
from glintrack.study.text_tables import (
    TextTable,
    answer,
    comparison_tables,
    importance,
    importance_table,
    narrow_intervals,
    points_table,
)

_MOST_GB = 1e6
_WIDEST = 200  # characters of a table
_MOST_DESIGNS = 12  # that are printed; more stand in points.csv
_FEW_AXES = 3  # of which each channel is told


app = typer.Typer(
    cls=group_with_default("run"),  # `study FILE`
    help="Fly the cases of a study, `glintrack study FILE`, resuming where it stopped; or report on one.",
    **STYLE,
)


@app.command("run")
def run(
    study: Annotated[
        str,
        typer.Argument(
            help="A study (TOML), or a packaged one: table1, polarization, "
            "polarization_fine, between, spectra, ranks, standard.",
        ),
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder of the results [default: study-NAME]")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(help="Dask scheduler, tcp://HOST:PORT, or 'local' for a cluster on this machine"),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes on this machine [default: one a core]")
    ] = None,
    in_process: Annotated[
        bool, typer.Option("--serial", help="One case after the other, in this process")
    ] = False,
    memory: Annotated[
        float | None,
        typer.Option(
            min=0.5,
            max=_MOST_GB,
            help="Of each worker, GB [default: its share of four fifths of the machine's]",
        ),
    ] = None,
    cache: Annotated[
        Path | None, typer.Option(help="Folder of kept hits, may be shared [default: the user's cache]")
    ] = None,
    replicates: Annotated[
        int | None,
        typer.Option(min=1, help="Fly the first so many replicates only; the same command with more goes on"),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say how many cases, kept frames, time and disk; fly nothing")
    ] = False,
    require: RequireOption = None,
    allow_outside_paths: OutsidePathsOption = False,
) -> None:
    """Fly every case of a study that is not finished yet; writes a folder with results.parquet in it.

    With --require each point of the design is judged, over its replicates.
    """
    requirements = [read_requirement(text) for text in require or []]
    if in_process and (workers or scheduler):
        raise ValueError("`--serial` must not be given with --workers or --scheduler, got both")
    plan = read_plan(find_case(study, "study"), allow_outside_paths)
    mine = plan if replicates is None else plan.first(replicates)
    folder = StudyFolder(output or Path(f"study-{plan.design.name}"))
    kept = cache or cache_folder("hits")
    console = Console()
    for note in (*field_notes(plan), *length_notes(plan)):
        console.print(note, markup=False, soft_wrap=True)
    if dry_run:
        folder.check(plan)
        _foresee(console, mine, folder, kept, _workers(scheduler, workers, in_process))
        return
    if memory is not None and not memory <= _MOST_GB:  # nan
        raise ValueError(f"`--memory` must be at most {_MOST_GB:g} GB, got {memory:g}")
    limit = None if memory is None else int(memory * 1e9)
    with _pool(scheduler, workers, in_process, limit) as pool, folder.open(plan):
        report = _fly(console, mine, folder, pool, kept)
        write_results(plan, folder)
    _conclude(console, mine, folder, kept, report)
    if requirements:
        _judge(console, read_results(folder.path), requirements)


@app.command("report")
def report(
    result: Annotated[Path, typer.Argument(help="Folder of a study's results.")],
    require: RequireOption = None,
) -> None:
    """Effects with intervals, contrasts, ranks, Pareto front and more; writes tables and figures."""
    requirements = [read_requirement(text) for text in require or []]
    results = read_results(result)
    folder, tables = write_report(result, results)
    console = Console()
    shown = []
    if len(matters := importance(tables)):
        few = matters["axis"].nunique() <= _FEW_AXES
        shown.append(importance_table(tables, ("axis", "channel") if few else ("axis",)))
    points = tables.get("points")
    if points is not None and points["point"].nunique() <= _MOST_DESIGNS:
        shown.append(points_table(points))
    for table in [*shown, *comparison_tables(tables)]:
        _show(console, _text_table(table))
    if len(matters) and (narrow := narrow_intervals(*results)):
        console.print(narrow, markup=False, soft_wrap=True)
    for note in view_notes(tables.get("views", pd.DataFrame(columns=["axis"]))):
        console.print(note, markup=False, soft_wrap=True)
    console.print(answer(tables), markup=False, soft_wrap=True)
    written = len([p for p in folder.iterdir() if p.is_file()])
    console.print(f"wrote {folder}: {written} files", soft_wrap=True)
    _judge(console, results, requirements)


def _judge(
    console: Console,
    results: tuple[pd.DataFrame, Mapping[str, Any]],
    requirements: Sequence[Requirement],
) -> None:
    """A table a requirement, a row a point of the design; exits unless all points meet all of them."""
    found = []
    for requirement in requirements:
        channel, points = check_points(*results, requirement)
        table = Table(title=f"{requirement} ({channel})", title_justify="left")
        for heading in ("design", "required", "found", "95 %", "flights more"):
            table.add_column(heading)
        for name, one in points:
            more = "" if one.more_flights is None else str(one.more_flights)
            interval = f"{one.low:.3g} to {one.high:.3g}" if math.isfinite(one.low) else "too short to say"
            table.add_row(name, one.answer, f"{one.value:.3g}", interval, more)
        console.print(table)
        found += [one for _, one in points]
    exit_by(found)


def _pool(
    scheduler: str | None, workers: int | None, in_process: bool, memory_bytes: int | None
) -> AbstractContextManager[Pool]:
    if scheduler:
        return dask(scheduler, workers, memory_bytes)
    return serial() if in_process else processes(workers, memory_bytes)


def _workers(scheduler: str | None, workers: int | None, in_process: bool) -> int:
    """How many cases would fly at a time; a cluster is asked."""
    if scheduler and scheduler != "local":
        with dask(scheduler) as pool:
            return pool.slots
    with serial() as pool:
        return 1 if in_process else workers or pool.threads


def _fly(console: Console, plan: Plan, folder: StudyFolder, pool: Pool, kept: Path) -> RunReport:
    todo = [key for key in plan.cases if folder.outcome(key) is None]
    console.print(
        f"{plan.design.name}: {len(todo)} of {len(plan.cases)} cases to fly with {pool.name}", soft_wrap=True
    )
    if pool.link:
        console.print(f"dashboard: {pool.link}", soft_wrap=True)
    columns = (TextColumn("{task.description}"), BarColumn(WIDTH), TextColumn("{task.fields[left]}"))
    pace = StudyPace(plan, folder, todo)
    with Bar(console, *columns) as progress:
        # the bar counts work: a case of nine rays an element is no step like one of one
        task = progress.add_task(plan.design.name, total=pace.whole, left=pace.summary(pool.slots))

        def callback(event: StudyEvent) -> None:
            if event.kind in ("finished", "failed"):
                pace.add(event.case_key, event.seconds if event.kind == "finished" else None)
            progress.update(task, completed=pace.done, left=pace.summary(pool.slots))
            if event.kind != "finished":
                why = event.error.strip().splitlines()[-1] if event.error else "its worker died"
                about = f"case {event.case_key} {event.kind}" if event.case_key else event.kind
                progress.console.print(f"{about}: {why}", markup=False, soft_wrap=True)

        return run_study(plan, folder, pool, kept, callback=callback)


def _conclude(console: Console, plan: Plan, folder: StudyFolder, kept: Path, report: RunReport) -> None:
    done = sum(folder.outcome(key) is not None for key in plan.cases)
    if report.frames_read + report.frames_traced:
        console.print(
            f"frames: {report.frames_traced} traced, {report.frames_read} read from the cache, "
            f"{1e-6 * report.bytes_kept:.0f} MB kept in {kept} (it may be removed)",
            soft_wrap=True,
        )
    if report.failed:
        console.print(f"{len(report.failed)} cases failed, see {folder.path / 'failed'}", soft_wrap=True)
    again = " (interrupted: run it again to resume)" if report.interrupted else ""
    _tell_cost(console, folder.cost(plan.cases))
    console.print(f"wrote {folder.path}: {done} of {len(plan.cases)} cases finished{again}", soft_wrap=True)
    if report.interrupted:
        raise typer.Exit(130)
    if report.failed:
        raise typer.Exit(1)


def _tell_cost(console: Console, spent: Mapping[str, float]) -> None:
    """What flights took, if any was flown; ``spent`` is of `StudyFolder.spent`."""
    if spent["cpu_s"]:
        console.print(
            f"{spent['flights']} flight{'' if spent['flights'] == 1 else 's'}, {spent['frames']} frames in "
            f"all, in {format_duration(spent['cpu_s'])} of processor time: "
            f"{spent['frames'] / spent['cpu_s']:.2g} frames a second a core",
            soft_wrap=True,
        )


def _foresee(console: Console, plan: Plan, folder: StudyFolder, kept: Path, workers: int) -> None:
    """What a run would do, with time and disk as finished cases of the study or rough figures say."""
    todo = [key for key in plan.cases if folder.outcome(key) is None]
    ahead, pace = forecast(plan, todo, kept), StudyPace(plan, folder, todo)
    told = Table(show_header=False)
    every = {point.replicate for point in plan.points}
    mine = {point.replicate for point in plan.points if point.case_key in plan.cases}
    times = f" × {len(mine)} replicates" if len(mine) > 1 else ""
    designs = f"{len(plan.points) // len(every)} designs{times}"
    told.add_row("cases", f"{len(plan.cases)} ({designs}), {len(todo)} to fly")
    told.add_row(
        "frames",
        f"{ahead.frames}, {ahead.frames - ahead.in_cache - ahead.repeats} to be traced: {ahead.in_cache} are "
        f"in the cache, {ahead.repeats} are repeated",
    )
    source = "as finished cases took" if pace.is_measured else "roughly: no case has finished yet"
    told.add_row("time", f"{format_duration(pace.remaining_s(workers))} with {workers} workers, {source}")
    told.add_row(
        "disk",
        f"{1e-6 * ahead.kept_bytes:.0f} MB of kept frames in {kept}, "
        f"{1e-6 * ahead.result_bytes:.0f} MB of results",
    )
    console.print(told)
    console.print(f"dry run of {plan.design.name}: nothing written", soft_wrap=True)


def _show(console: Console, table: Table) -> None:
    """Print a table with its numbers whole: where a terminal is narrower, it breaks the lines."""
    least = console.measure(table, options=console.options.update(max_width=_WIDEST)).minimum
    edges = 2 * len(table.columns) + 2  # which Rich does not count where a column has a least width
    Console(width=console.width if least <= console.width else least + edges).print(table)


def _text_table(text: TextTable) -> Table:
    """A table of words as it stands, its first column to the left."""
    table = Table(title=text.title, title_justify="left", box=SIMPLE)
    for k, heading in enumerate(text.heads):
        table.add_column(heading, justify="left" if k < text.words else "right")
    for row in text.rows:
        table.add_row(*row)
    return table
