"""``glintrack optimize``: search for the cheapest design that meets requirements."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from glintrack.cli import options as cli
from glintrack.cli import study as studies
from glintrack.core.installation import require_extra
from glintrack.core.units import format_duration
from glintrack.io.cache import cache_folder
from glintrack.study import StudyEvent, StudyFolder, write_results
from glintrack.study import optimize as search
from glintrack.study.optimize.report import requirement_labels

app = cli.command_app()


@app.command()
def optimize(
    specification: Annotated[Path, cli.argument("Optimization file (TOML)")],
    output: Annotated[
        Path | None, cli.option("New folder [default: optimization-NAME]", "-o", "--output")
    ] = None,
    scheduler: studies.SchedulerOption = None,
    workers: studies.WorkersOption = None,
    in_process: studies.InProcessOption = False,
    memory: studies.MemoryOption = None,
    cache: studies.CacheOption = None,
    dry_run: Annotated[bool, cli.option("Print ranges and time; simulate nothing", "--dry-run")] = False,
    allow_outside_paths: cli.OutsidePathsOption = False,
) -> None:
    """Search for the cheapest design that meets requirements, and confirm it over unseen cities.

    Run it again to resume. Exit code 0: confirmed, 1: no design in the ranges meets them, 3: undecided.
    """
    studies.check_pool(scheduler, workers, in_process)
    require_extra("sklearn", "optimize", "search for a design")
    setup = search.read_optimization(specification, allow_outside_paths)
    folder = StudyFolder(output or Path(f"optimization-{setup.design.name}"))
    console = cli.open_console()
    _print_setup(console, setup)
    if dry_run:
        console.print(f"dry run of {setup.design.name}: nothing written")
        return
    with studies.open_pool(scheduler, workers, in_process, memory) as pool:
        runner = search.StudyRunner(setup, folder, pool, cache or cache_folder("hits"))
        runner.announce = lambda designs, cities, duration_s: console.print(
            f"simulations: {designs} (designs) × {cities} (cities) of {duration_s:g} s"
        )
        runner.callback = lambda event: _print_failure(console, event)
        with folder.open(runner.plan()):
            result = _run(console, runner)
    print_result(console, result)
    console.print(f"wrote {folder.path} (`glintrack report {folder.path}` makes a page)")
    cli.check_answers([result.answer])


def _run(console: Console, runner: search.StudyRunner) -> search.OptimizationResult:
    """Search, and write the folder; an interrupt leaves what was simulated."""
    folder = runner.folder
    try:
        outcome = search.run_search(runner)
    except KeyboardInterrupt:
        console.print(f"wrote {folder.path} (interrupted: the same command resumes it)")
        raise typer.Exit(130) from None
    finally:
        if runner.rows:
            write_results(runner.plan(), folder)
    result = search.build_result(runner.optimization, outcome)
    search.write_result(folder.path, result)
    return result


def _print_setup(console: Console, setup: search.Optimization) -> None:
    """Print candidates, cost, requirements, and the longest time."""
    problem, design = setup.problem, setup.design
    low, high = problem.cost.min(), problem.cost.max()
    console.print(
        f"{design.name}: {len(problem.cost):,} designs of cost {low:.4g} to {high:.4g}; required: "
        f"{', '.join(requirement_labels(setup))}; at most {problem.simulations} simulations, roughly "
        f"{format_duration(problem.simulations * setup.cpu_s)} of processor time"
    )
    if setup.uses_recorded_traffic:
        console.print(
            "all cities have the same recorded traffic (`base.scene.traffic_duration_s = 130`, without a "
            "`scene.traffic_file`, gives each its own; extra `traffic`)"
        )


def _print_failure(console: Console, event: StudyEvent) -> None:
    if event.kind != "finished":
        why = event.error.strip().splitlines()[-1] if event.error else "its worker died"
        console.print(f"case {event.case_key} {event.kind}: {why}")


def print_result(console: Console, result: search.OptimizationResult) -> None:
    """Print tables, then the sentences."""
    for table in result.tables:
        console.print(cli.make_table(table.title, table.heads, table.rows, left=table.words))
    for sentence in result.sentences:
        console.print(sentence)
