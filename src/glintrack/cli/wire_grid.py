"""``glintrack device wiregrid``: a wire-grid polarizer, solved or from the shipped tables."""

from pathlib import Path
from typing import Annotated

import typer
import xarray as xr
from matplotlib.figure import Figure
from rich.console import Console

from glintrack.cli.options import check_folder
from glintrack.cli.progress import Bar
from glintrack.core.designs import validate_design
from glintrack.core.installation import missing_extra
from glintrack.core.spectral import (
    MAX_WAVELENGTH_UM,
    MIN_WAVELENGTH_UM,
    STANDARD_STEP_UM,
    check_wavelengths,
    wavelength_grid,
)
from glintrack.devices import PAPER_GRIDS, WireGridDesign, wire_grid
from glintrack.io import images, netcdf
from glintrack.io.toml import read_toml
from glintrack.results.figures import devices as plot_devices

Output = Annotated[Path, typer.Option("-o", "--output", help="NetCDF file to write")]
Plot = Annotated[bool, typer.Option("--plot", help="Draw PNG files beside the output, too")]


def solve_wiregrid(
    design: Annotated[
        str,
        typer.Argument(help=f"TOML file of a grid, or one of the paper's by name: {', '.join(PAPER_GRIDS)}"),
    ],
    output: Output,
    plot: Plot = False,
    start_um: Annotated[float, typer.Option(help="Shortest wavelength, µm")] = MIN_WAVELENGTH_UM,
    stop_um: Annotated[float, typer.Option(help="Longest wavelength, µm")] = MAX_WAVELENGTH_UM,
    step_um: Annotated[float, typer.Option(help="Step of the wavelengths, µm")] = STANDARD_STEP_UM,
    field_um: Annotated[float, typer.Option(help="Wavelength of the field maps that --plot draws, µm")] = 1.5,
) -> None:
    """Transmittances, field ratio and Mueller matrices of a wire-grid polarizer against wavelength in µm.

    The paper's grids come from shipped tables; others are solved (extra `em`). A sweep that was stopped goes
    on where it was.
    """
    grid = _read_grid(design)
    um = wavelength_grid(start_um, stop_um, step_um)
    check_wavelengths(field_um, "field_um")
    check_folder(output)
    console = Console()
    with Bar(console) as progress:
        task = progress.add_task(f"solving {um.size} wavelengths", total=1.0)
        try:
            table = wire_grid.response(grid, um, lambda done: progress.update(task, completed=done))
        except KeyboardInterrupt:
            console.print("interrupted: what is solved is kept, the same command goes on from there")
            raise typer.Exit(130) from None
        progress.update(task, completed=1.0)
    netcdf.write_dataset(output, table)
    console.print(f"wrote {output}: {um.size} wavelengths", soft_wrap=True)
    if plot:
        _plot_wiregrid(grid, table, output, field_um, console)


def _plot_wiregrid(
    grid: WireGridDesign, table: xr.Dataset, output: Path, field_um: float, console: Console
) -> None:
    """The paper's Figures 6 to 9 from the table, 5 and 10 from fields solved now where that can be done."""
    figure = Figure(figsize=(12, 9), layout="constrained")
    plot_devices.wire_grid_overview(figure, table)
    _save(figure, output.with_suffix(".png"), console)
    if not wire_grid.can_solve():
        console.print(
            f"no field maps: {missing_extra('ngsolve', 'em', 'solve fields')}", soft_wrap=True, markup=False
        )
        return
    maps = wire_grid.field_maps(grid, field_um)
    title = f"{grid.wires} wires every {grid.period_nm:g} nm"
    for name, draw in (("density", plot_devices.cross_section), ("fields", plot_devices.field_at_angle)):
        figure = Figure(figsize=(13, 5), layout="constrained")
        draw(figure, maps, title)
        _save(figure, output.with_name(f"{output.stem}_{name}.png"), console)


def _save(figure: Figure, path: Path, console: Console) -> None:
    images.write_figure(path, figure, dpi=120)
    console.print(f"wrote {path}", soft_wrap=True)


def _read_grid(name: str) -> WireGridDesign:
    """A design file, or else one of the paper's grids by name."""
    path = Path(name)
    if not path.exists() and name in PAPER_GRIDS:
        return PAPER_GRIDS[name]
    design = validate_design(WireGridDesign, read_toml(path, "design"))
    return design.model_copy(update={"metal": design.metal.resolve_files(path.parent)})
