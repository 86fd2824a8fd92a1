"""``glintrack bound``: how far the sensor itself reaches, before any tracker."""

from pathlib import Path
from typing import Annotated

import typer
import xarray as xr
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from glintrack.bounds.run import measure_bounds
from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.cli.options import CaseArgument, check_file, command_app
from glintrack.cli.progress import Bar
from glintrack.io.netcdf import write_tree
from glintrack.results.verdict import format_accuracy

app = command_app()


@app.command()
def bound(
    case: CaseArgument = "quickstart",
    frames: Annotated[int | None, typer.Option(min=2, help="Fly only this many frames of the case")] = None,
    every: Annotated[
        int | None, typer.Option(min=1, help="Frames from one that is measured to the next [bound.every]")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Write the loss budgets, NetCDF")
    ] = None,
) -> None:
    """Measure the loss budget from moving vehicles down to the reported pose, without a tracker."""
    if output is not None:
        check_file(output)
    design = Case.from_toml(find_case(case))
    if frames is not None:
        design = design.replace({"flight.frames": min(frames, design.flight.frames)})
    if every is not None:
        design = design.replace({"bound.every": every})
    console = Console()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Bar(console, *columns) as progress:
        task = progress.add_task(f"{design.name}: bounds", total=design.flight.frames)
        found = measure_bounds(design, lambda done: progress.update(task, completed=done))
    print_loss_budgets(console, found)
    if output is not None:
        write_tree(output, xr.DataTree.from_dict({f"/{group}": one for group, one in found.items()}))
        console.print(f"wrote {output}", soft_wrap=True)


def print_loss_budgets(console: Console, found: dict[str, xr.Dataset]) -> None:
    """Print a table of each group of elements: share of the movers and of the visible ones at each stage."""
    for group, one in found.items():
        few, half = one.attrs["d_prime_5"], one.attrs["d_prime_50"]
        table = Table(
            title=f"loss budget, {group} elements, {one.attrs['false_per_frame']:g} false detections a "
            f"frame, d′ of 95 % of the vehicles above {few:.0f}, of half above {half:.0f}",
            title_justify="left",
        )
        headings = {
            "of_moving": "of all movers",
            "of_visible": "of visible",
            "unpolarized": "of all, S1 = S2 = 0",
        }
        shown = {name: heading for name, heading in headings.items() if name in one}
        table.add_column("stage")
        for heading in shown.values():
            table.add_column(heading, justify="right")
        for stage, *shares in one[[*shown]].to_dataframe().dropna(subset="of_moving").itertuples():
            table.add_row(str(stage), *("–" if v != v else f"{v:.3f}" for v in shares))
        console.print(table)
        console.print(format_accuracy(one.attrs), soft_wrap=True)
