"""``glintrack atmosphere``: solve a sky, and plot it."""

from pathlib import Path
from typing import Annotated

from matplotlib.figure import Figure

from glintrack.atmosphere import AtmosphereDesign, solve_tables
from glintrack.case.design import Case, over_like
from glintrack.cli.options import Bar, argument, check_output, command_app, open_console, option
from glintrack.core.designs import validate_design
from glintrack.core.schema import check
from glintrack.io import images, netcdf
from glintrack.io.toml import read_toml
from glintrack.results.figures import sky as plot_sky

app = command_app("Solve the polarized sky and path radiance, and plot them.")
_QUANTITIES = ("I", "DoLP", "AoP")


@app.command()
def solve(
    design: Annotated[Path, argument("TOML file: a case, or the keys of its [atmosphere] table")],
    output: Annotated[Path, option("NetCDF file to write", "-o", "--output")],
) -> None:
    """Solve irradiance, sky, path radiance and transmittance.

    Radiances are in W m⁻² sr⁻¹ µm⁻¹, wavelengths in µm.
    """
    values = over_like(read_toml(design, "design"))
    is_case = not set(values) <= set(AtmosphereDesign.model_fields) and set(values) & set(Case.model_fields)
    atmosphere = validate_design(AtmosphereDesign, values.get("atmosphere", {} if is_case else values))
    check_output(output)
    console = open_console()
    with Bar(console) as progress:
        task = progress.add_task("solving the sky", total=1.0)
        tables = solve_tables(atmosphere, lambda done: progress.update(task, completed=done))
        progress.update(task, completed=1.0)
    netcdf.write_dataset(output, tables)
    console.print(f"wrote {output}: {tables.sizes['wavelength']} wavelengths")


@app.command()
def plot(
    tables: Annotated[Path, argument("NetCDF file from `glintrack atmosphere solve`")],
    output: Annotated[Path | None, option("PNG to write [default: TABLES.png]", "-o", "--output")] = None,
    wavelength_um: Annotated[
        list[float] | None, option("Wavelength to map [µm]; repeatable", "--wavelength-um")
    ] = None,
) -> None:
    """Draw fisheye maps of the sky's I, DoLP and AoP, and the spectra of sun, sky and path radiance."""
    dataset = check(netcdf.read_dataset(tables, "tables"), "atmosphere")
    available = dataset["wavelength"].values
    chosen = wavelength_um or [0.45, 0.65, 0.85]
    for value in chosen:
        if not available[0] - 1e-9 <= value <= available[-1] + 1e-9:
            raise ValueError(
                f"`--wavelength-um` must lie within the tables' {available[0]:g} to {available[-1]:g} µm; "
                f"got {value:g}."
            )
    figure = Figure(figsize=(4 * len(_QUANTITIES), 3.6 * (len(chosen) + 1)), layout="constrained")
    grid = figure.add_gridspec(len(chosen) + 1, len(_QUANTITIES))
    for row, value in enumerate(chosen):
        for column, quantity in enumerate(_QUANTITIES):
            axes = figure.add_subplot(grid[row, column], projection="polar")
            shown = plot_sky.fisheye(axes, dataset, value, quantity)
            figure.colorbar(shown, ax=axes, shrink=0.8, label=plot_sky.LABELS[quantity])
    plot_sky.spectra(figure.add_subplot(grid[-1, :]), dataset)
    output = output or tables.with_suffix(".png")
    images.write_figure(output, figure, dpi=120)
    open_console().print(f"wrote {output}")
