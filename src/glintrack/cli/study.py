"""``glintrack study``: simulate many cases of one base, and report what they show."""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportGeneralTypeIssues=false

import math
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import typer
from rich.console import Console
from rich.progress import BarColumn, TextColumn
from rich.table import Table

from glintrack import study as studies
from glintrack.case.packaged import find_case
from glintrack.cli import options as cli
from glintrack.core.units import format_duration
from glintrack.io.cache import cache_folder
from glintrack.metrics.requirement import Requirement, read_requirement
from glintrack.study.plan import design_notes, field_notes, length_notes
from glintrack.study.report import check_points, view_notes
from glintrack.study.text_tables import (
    answer,
    comparison_tables,
    importance,
    importance_table,
    narrow_intervals,
    points_table,
)

_MAX_GB = 1e6
_MAX_TABLE_WIDTH = 200  # [character]
_MAX_DESIGNS = 12  # that are printed; points.csv holds all
_FEW_AXES = 3  # up to which each channel has a row

SchedulerOption = Annotated[str | None, cli.option("Dask scheduler tcp://HOST:PORT, or 'local'")]
WorkersOption = Annotated[int | None, cli.option("Processes on this machine [default: one per core]", min=1)]
InProcessOption = Annotated[bool, cli.option("Simulate in this process, one by one", "--serial")]
MemoryOption = Annotated[float | None, cli.option("Memory limit of a worker [GB]", min=0.5, max=_MAX_GB)]
CacheOption = Annotated[Path | None, cli.option("Folder for traced frames [default: user's cache]")]

app = cli.command_app(
    "Simulate the cases of a study, `glintrack study FILE`, or report on a study.", default="run"
)


@app.command("run")
def run(
    study: Annotated[str, cli.argument("Study file (TOML), or a packaged study (`glintrack case list`)")],
    output: Annotated[Path | None, cli.option("New folder [default: study-NAME]", "-o", "--output")] = None,
    scheduler: SchedulerOption = None,
    workers: WorkersOption = None,
    in_process: InProcessOption = False,
    memory: MemoryOption = None,
    cache: CacheOption = None,
    replicates: Annotated[int | None, cli.option("Number of replicates [default: all]", min=1)] = None,
    dry_run: Annotated[bool, cli.option("Print time and disk space; simulate nothing", "--dry-run")] = False,
    require: cli.RequireOption = None,
    allow_outside_paths: cli.OutsidePathsOption = False,
) -> None:
    """Simulate the unfinished cases of a study; writes a folder with results.parquet.

    With --require each point of the design is compared with the requirement, over its replicates.
    """
    requirements = [read_requirement(text) for text in require or []]
    check_pool(scheduler, workers, in_process)
    plan = studies.read_plan(find_case(study, "study"), allow_outside_paths)
    mine = plan if replicates is None else plan.first(replicates)
    folder = studies.StudyFolder(output or Path(f"study-{plan.design.name}"))
    frame_cache = cache or cache_folder("hits")
    console = cli.open_console()
    for note in (*field_notes(plan), *length_notes(plan), *design_notes(plan)):
        console.print(note)
    if dry_run:
        folder.check(plan)
        if scheduler and scheduler != "local":
            with studies.dask(scheduler) as pool:
                slots = pool.slots
        else:
            with studies.serial() as pool:
                slots = 1 if in_process else workers or pool.threads
        _print_plan(console, mine, folder, frame_cache, slots)
        return
    with open_pool(scheduler, workers, in_process, memory) as pool, folder.open(plan):
        report = _simulate(console, mine, folder, pool, frame_cache)
        studies.write_results(plan, folder)
    _conclude(console, mine, folder, frame_cache, report)
    if requirements:
        _compare_with_requirements(console, studies.read_results(folder.path), requirements)


def check_pool(scheduler: str | None, workers: int | None, in_process: bool) -> None:
    """Refuse options of executors that exclude each other."""
    if in_process and (workers or scheduler):
        raise ValueError("`--serial` must not be given with --workers or --scheduler; got both.")


def open_pool(
    scheduler: str | None, workers: int | None, in_process: bool, memory: float | None
) -> AbstractContextManager[studies.Pool]:
    """Open the executor that the options of a command name."""
    limit = None if memory is None else int(memory * 1e9)
    if scheduler:
        return studies.dask(scheduler, workers, limit)
    return studies.serial() if in_process else studies.processes(workers, limit)


@app.command("report")
def report(
    result: Annotated[Path, cli.argument("Folder of a study's results.")], require: cli.RequireOption = None
) -> None:
    """Effects with intervals, contrasts, ranks, Pareto front and more; writes tables and figures."""
    requirements = [read_requirement(text) for text in require or []]
    results = studies.read_results(result)
    folder, tables = studies.write_report(result, results)
    console = cli.open_console()
    shown = []
    if len(effects := importance(tables)):
        few = effects["axis"].nunique() <= _FEW_AXES
        shown.append(importance_table(tables, ("axis", "channel") if few else ("axis",)))
    points = tables.get("points")
    if points is not None and points["point"].nunique() <= _MAX_DESIGNS:
        shown.append(points_table(points))
    for text in [*shown, *comparison_tables(tables)]:
        _print_table(console, cli.make_table(text.title, text.heads, text.rows, left=text.words))
    if len(effects) and (narrow := narrow_intervals(*results)):
        console.print(narrow)
    for note in view_notes(tables.get("views", pd.DataFrame(columns=["axis"]))):
        console.print(note)
    console.print(answer(tables))
    written = len([p for p in folder.iterdir() if p.is_file()])
    console.print(f"wrote {folder}: {written} files")
    _compare_with_requirements(console, results, requirements)


def _compare_with_requirements(
    console: Console, results: tuple[pd.DataFrame, Mapping[str, Any]], requirements: Sequence[Requirement]
) -> None:
    """Print a table for each requirement with a row for each design; exit unless all designs meet all."""
    found = []
    for requirement in requirements:
        channel, points = check_points(*results, requirement)
        rows = []
        for name, one in points:
            more = "" if one.more_flights is None else str(one.more_flights)
            interval = f"{one.low:.3g} to {one.high:.3g}" if math.isfinite(one.low) else "too short to say"
            rows.append([name, one.answer, f"{one.value:.3g}", interval, more])
        headings = ("design", "met", "found", "95 % interval", "more runs needed")
        console.print(cli.make_table(f"{requirement} ({channel})", headings, rows, left=len(headings)))
        found += [one for _, one in points]
    cli.check_answers(one.answer for one in found)


def _simulate(
    console: Console, plan: studies.Plan, folder: studies.StudyFolder, pool: studies.Pool, cache: Path
) -> studies.RunReport:
    todo = [key for key in plan.cases if folder.outcome(key) is None]
    console.print(f"{plan.design.name}: {len(todo)} of {len(plan.cases)} cases to simulate with {pool.name}")
    if pool.link:
        console.print(f"dashboard: {pool.link}")
    columns = (TextColumn("{task.description}"), BarColumn(cli.BAR_WIDTH), TextColumn("{task.fields[left]}"))
    pace = studies.StudyPace(plan, folder, todo)
    if todo:
        console.print(f"estimated time: {_estimate_time(pace, pool.slots)}")
    with cli.Bar(console, *columns) as progress:
        # the bar counts work: cases with more rays per element take longer
        task = progress.add_task(plan.design.name, total=pace.whole, left=pace.summary(pool.slots))

        def callback(event: studies.StudyEvent) -> None:
            if event.kind in ("finished", "failed"):
                pace.add(event.case_key, event.seconds if event.kind == "finished" else None)
            progress.update(task, completed=pace.done, left=pace.summary(pool.slots))
            if event.kind != "finished":
                why = event.error.strip().splitlines()[-1] if event.error else "its worker died"
                about = f"case {event.case_key} {event.kind}" if event.case_key else event.kind
                progress.console.print(f"{about}: {why}")

        return studies.run_study(plan, folder, pool, cache, callback=callback)


def _conclude(
    console: Console, plan: studies.Plan, folder: studies.StudyFolder, cache: Path, report: studies.RunReport
) -> None:
    """Print frames, failures, cost and folder; exit unless all cases are finished."""
    done = sum(folder.outcome(key) is not None for key in plan.cases)
    if report.frames_read + report.frames_traced:
        console.print(
            f"frames: {report.frames_traced} traced, {report.frames_read} read from the cache; "
            f"{1e-6 * report.bytes_kept:.0f} MB in {cache} (may be deleted)"
        )
    if report.failed:
        console.print(f"{len(report.failed)} cases failed, see {folder.path / 'failed'}")
    spent = folder.cost(plan.cases)
    if spent["cpu_s"]:
        console.print(
            f"{spent['flights']} run{'' if spent['flights'] == 1 else 's'}, {spent['frames']} frames, "
            f"{format_duration(spent['cpu_s'])} of processor time: "
            f"{spent['frames'] / spent['cpu_s']:.2g} frames per second and core"
        )
    again = " (interrupted: the same command resumes it)" if report.interrupted else ""
    console.print(f"wrote {folder.path}: {done} of {len(plan.cases)} cases finished{again}")
    if report.interrupted or report.failed:
        raise typer.Exit(130 if report.interrupted else 1)


def _print_plan(
    console: Console, plan: studies.Plan, folder: studies.StudyFolder, cache: Path, workers: int
) -> None:
    """Print number of cases and frames, time and disk space; estimated roughly until a case has finished."""
    todo = [key for key in plan.cases if folder.outcome(key) is None]
    ahead, pace = studies.forecast(plan, todo, cache), studies.StudyPace(plan, folder, todo)
    every = {point.replicate for point in plan.points}
    mine = {point.replicate for point in plan.points if point.case_key in plan.cases}
    times = f" × {len(mine)} replicates" if len(mine) > 1 else ""
    traced = ahead.frames - ahead.in_cache - ahead.repeats
    designs = f"{len(plan.points) // len(every)} designs{times}"
    kept_mb, result_mb = 1e-6 * ahead.kept_bytes, 1e-6 * ahead.result_bytes
    rows = (
        ("cases", f"{len(plan.cases)} ({designs}), {len(todo)} to simulate"),
        ("frames", f"{ahead.frames}: {traced} to trace, {ahead.in_cache} cached, {ahead.repeats} shared"),
        ("time", _estimate_time(pace, workers)),
        ("disk", f"{kept_mb:.0f} MB of traced frames in {cache}, {result_mb:.0f} MB of results"),
    )
    console.print(cli.make_table(None, (), rows))
    console.print(f"dry run of {plan.design.name}: nothing written")


def _estimate_time(pace: studies.StudyPace, workers: int) -> str:
    """State the time that a study still takes, and the source of the estimate."""
    source = "from finished cases" if pace.is_measured else "a rough estimate: no case has finished yet"
    return (
        f"{format_duration(pace.remaining_s(workers))} with {workers} worker{'s' * (workers != 1)}, {source}"
    )


def _print_table(console: Console, table: Table) -> None:
    """Print a table with its numbers whole; a narrower terminal breaks the lines."""
    least = console.measure(table, options=console.options.update(max_width=_MAX_TABLE_WIDTH)).minimum
    edges = 2 * len(table.columns) + 2  # which Rich does not count where a column has a least width
    Console(width=console.width if least <= console.width else least + edges, markup=False).print(table)
