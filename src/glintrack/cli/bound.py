"""``glintrack bound``: measure the loss budget from the sensor to the detector, or information by task."""

from pathlib import Path
from typing import Annotated

import xarray as xr
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

from glintrack.bounds.run import measure_bounds
from glintrack.bounds.tasks import Task, measure_tasks, summarize_tasks
from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.cli.options import (
    Bar,
    CaseArgument,
    check_output,
    command_app,
    make_table,
    open_console,
    option,
)
from glintrack.io import atomic
from glintrack.io.netcdf import write_tree
from glintrack.results.verdict import format_accuracy

app = command_app()


@app.command()
def bound(
    case: CaseArgument = "quickstart",
    frames: Annotated[int | None, option("Frames to simulate [default: all; with --task 3]", min=1)] = None,
    every: Annotated[int | None, option("Interval of measured frames [default: bound.every]", min=1)] = None,
    output: Annotated[Path | None, option("NetCDF, with --task .csv or .parquet", "-o", "--output")] = None,
    task: Annotated[Task | None, option("Compare sensors with equal light in a task instead")] = None,
    cities: Annotated[int, option("With --task: number of cities", min=2, max=100)] = 3,
    seed: Annotated[int, option("With --task: seed of the first city", min=0)] = 51,
) -> None:
    """Measure the loss budget of a case, without a tracker; or what sensors can reach in a task.

    For each stage: the share of the moving vehicles that is left, and of those that are visible.
    """
    if output is not None:
        check_output(output)
    design = Case.from_toml(find_case(case))
    if task is not None:
        return _compare_sensors(design, task, range(seed, seed + cities), frames or 3, output)
    if frames is not None:
        design = design.replace({"flight.frames": min(frames, design.flight.frames)})
    if every is not None:
        design = design.replace({"bound.every": every})
    console = open_console()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Bar(console, *columns) as progress:
        bar = progress.add_task(f"{design.name}: bounds", total=design.flight.frames)
        found = measure_bounds(design, lambda done: progress.update(bar, completed=done))
    _print_budgets(console, found)
    if output is not None:
        write_tree(output, xr.DataTree.from_dict({f"/{group}": one for group, one in found.items()}))
        console.print(f"wrote {output}")


def _print_budgets(console: Console, found: dict[str, xr.Dataset]) -> None:
    """Print a table for each group of elements: what share of the vehicles each stage leaves."""
    for group, one in found.items():
        few, half = one.attrs["d_prime_5"], one.attrs["d_prime_50"]
        title = (
            f"loss budget, {group} elements, at {one.attrs['false_per_frame']:g} false detections per frame; "
            f"d′: median {half:.0f}, 5th percentile {few:.0f}"
        )
        names = {
            "of_moving": "of all moving",
            "of_visible": "of visible",
            "unpolarized": "of all, S1 = S2 = 0",
        }
        shown = {name: heading for name, heading in names.items() if name in one}
        shares = one[[*shown]].to_dataframe().dropna(subset="of_moving").itertuples()
        rows = [(str(stage), *("–" if v != v else f"{v:.3f}" for v in values)) for stage, *values in shares]
        console.print(make_table(title, ["stage", *shown.values()], rows))
        console.print(format_accuracy(one.attrs))


def _compare_sensors(case: Case, task: Task, cities: range, frames: int, output: Path | None) -> None:
    """Print what each preset can reach, and write the rows of its cities."""
    if output is not None and output.suffix not in (".csv", ".parquet"):
        raise ValueError(f"`--output` must be a .csv or .parquet file with --task; got {output}.")
    console = open_console()
    with Bar(console, TextColumn("{task.description}"), BarColumn()) as progress:
        progress.add_task(f"{case.name}: {task}", total=None)
        rows = measure_tasks(case, task, cities, frames)
    means, count = summarize_tasks(rows), rows["vehicles"].to_numpy().sum()
    title = f"{task}: {count // len(means):,} cases; cities {cities[0]} to {cities[-1]}, {frames} frames each"
    names = {"found_50": "at 50 false per km²", "found_200": "at 200", "gain": "gain over pan (95 %)"}
    headings = ["sensor", *(names.get(name, name) for name in means.columns[:-1])]
    shown = [
        (str(preset), *(f"{score:.3f}" for score in scores), f"{gain:+.3f} ± {half:.3f}")
        for preset, *scores, gain, half in means.itertuples()
    ]
    console.print(make_table(title, headings, shown))
    if output is not None:
        text = rows.to_csv(index=False).encode()
        atomic.write_bytes(output, text if output.suffix == ".csv" else rows.to_parquet(index=False))
        console.print(f"wrote {output}")
