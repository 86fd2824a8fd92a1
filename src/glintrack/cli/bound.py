"""``glintrack bound``: measure the loss budget from the sensor to the detector."""

from pathlib import Path
from typing import Annotated

import xarray as xr
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

from glintrack.bounds.run import measure_bounds
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
from glintrack.io.netcdf import write_tree
from glintrack.results.verdict import format_accuracy

app = command_app()


@app.command()
def bound(
    case: CaseArgument = "quickstart",
    frames: Annotated[int | None, option("Number of frames to simulate [default: all]", min=2)] = None,
    every: Annotated[int | None, option("Interval of measured frames [default: bound.every]", min=1)] = None,
    output: Annotated[Path | None, option("NetCDF file to write", "-o", "--output")] = None,
) -> None:
    """Measure the loss budget of a case, without a tracker.

    For each stage: the share of the moving vehicles that is left, and of those that are visible.
    """
    if output is not None:
        check_output(output)
    design = Case.from_toml(find_case(case))
    if frames is not None:
        design = design.replace({"flight.frames": min(frames, design.flight.frames)})
    if every is not None:
        design = design.replace({"bound.every": every})
    console = open_console()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Bar(console, *columns) as progress:
        task = progress.add_task(f"{design.name}: bounds", total=design.flight.frames)
        found = measure_bounds(design, lambda done: progress.update(task, completed=done))
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
