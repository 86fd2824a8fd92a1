"""``glintrack device``: solve the sensor's optical devices, and draw them."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer
import xarray as xr
from matplotlib.figure import Figure
from rich.console import Console

from glintrack.cli.options import Bar, argument, check_output, command_app, open_console, option
from glintrack.core import spectral
from glintrack.core.designs import validate_design
from glintrack.core.installation import missing_extra
from glintrack.devices import PAPER_GRIDS, EtalonDesign, MicromirrorDesign, WireGridDesign, etalon, wire_grid
from glintrack.devices import micromirror as mirror
from glintrack.devices.micromirror.model3d import superpixel_glb
from glintrack.devices.micromirror.plate import bend_plate
from glintrack.io import atomic, images, netcdf
from glintrack.io.toml import read_toml
from glintrack.results.figures import devices as plot_devices

app = command_app("Solve wire grids, etalons and micromirrors, and plot them.")
OutputOption = Annotated[Path, option("NetCDF file to write", "-o", "--output")]
PlotOption = Annotated[bool, option("Draw PNG files next to the output, too", "--plot")]


@app.command("wiregrid")
def solve_wiregrid(
    design: Annotated[str, argument(f"TOML file, or a grid of the paper: {', '.join(PAPER_GRIDS)}")],
    output: OutputOption,
    plot: PlotOption = False,
    start_um: Annotated[float, option("Shortest wavelength [µm]")] = spectral.MIN_WAVELENGTH_UM,
    stop_um: Annotated[float, option("Longest wavelength [µm]")] = spectral.MAX_WAVELENGTH_UM,
    step_um: Annotated[float, option("Step of the wavelengths [µm]")] = spectral.STANDARD_STEP_UM,
    field_um: Annotated[float, option("Wavelength of the field maps of --plot [µm]")] = 1.5,
) -> None:
    """Transmittances, field ratio and Mueller matrices of a wire-grid polarizer against wavelength in µm.

    The paper's grids come from shipped tables; others are solved (extra `em`). The same command continues a
    sweep that was stopped.
    """
    path = Path(design)
    if not path.exists() and design in PAPER_GRIDS:
        grid = PAPER_GRIDS[design]
    else:
        grid = validate_design(WireGridDesign, read_toml(path, "design"))
        grid = grid.model_copy(update={"metal": grid.metal.resolve_files(path.parent)})
    um = spectral.wavelength_grid(start_um, stop_um, step_um)
    spectral.check_wavelengths(field_um, "field_um")
    check_output(output)
    console = open_console()
    with Bar(console) as progress:
        task = progress.add_task(f"solving {um.size} wavelengths", total=1.0)
        try:
            table = wire_grid.response(grid, um, lambda done: progress.update(task, completed=done))
        except KeyboardInterrupt:
            console.print("interrupted: finished wavelengths are stored; the same command continues")
            raise typer.Exit(130) from None
        progress.update(task, completed=1.0)
    netcdf.write_dataset(output, table)
    console.print(f"wrote {output}: {um.size} wavelengths")
    if not plot:
        return
    _draw(output.with_suffix(".png"), lambda f: plot_devices.wire_grid_overview(f, table), console)
    if not wire_grid.can_solve():  # the paper's Figures 5 and 10 need fields, 6 to 9 the table alone
        console.print(f"no field maps: {missing_extra('ngsolve', 'em', 'solve fields')}")
        return
    maps, title = wire_grid.field_maps(grid, field_um), f"{grid.wires} wires every {grid.period_nm:g} nm"
    for name, draw in (("density", plot_devices.cross_section), ("fields", plot_devices.field_at_angle)):
        picture = output.with_name(f"{output.stem}_{name}.png")
        _draw(picture, lambda f, draw=draw: draw(f, maps, title), console, (13, 5))


@app.command("etalon")
def solve_etalon(
    design: Annotated[Path, argument("TOML file of an etalon; an empty one is the default")],
    output: OutputOption,
    plot: PlotOption = False,
) -> None:
    """Transmittance of a tunable etalon over gap and wavelength, its peaks and drive voltages."""
    made = validate_design(EtalonDesign, read_toml(design, "design"))
    made = made.model_copy(update={"metal": made.metal.resolve_files(design.parent)})
    check_output(output)
    table = etalon.tabulate(made)
    netcdf.write_dataset(output, table)
    console = open_console()
    best = table.isel(peak_wavelength=int(table["peak_transmittance"].argmax("peak_wavelength")))
    console.print(
        f"wrote {output}: {table.sizes['gap']} gaps × {table.sizes['wavelength']} wavelengths; best peak "
        f"{float(best['peak_transmittance']):.2f} at {float(best['peak_wavelength']):.2f} µm"
    )
    if plot:
        _draw(output.with_suffix(".png"), lambda f: plot_devices.etalon_overview(f, table), console)


@app.command("micromirror")
def solve_micromirror(
    design: Annotated[Path, argument("TOML file of a micromirror; an empty one is the default")],
    output: OutputOption,
    plot: PlotOption = False,
    model: Annotated[Path | None, option("3-D model to write, .glb (extra `em`)", "--glb")] = None,
    grid: Annotated[Path | None, option("TOML file of the model's wire grid [default: grid A]")] = None,
    exaggeration: Annotated[float, option("Factor on deflections in the 3-D model", min=0, max=1e6)] = 1.0,
    polarizer: Annotated[Path | None, option("Output of `device wiregrid` [default: ideal]")] = None,
    f_number: Annotated[float, option("F-number of lens and relay", min=0.5, max=64)] = 5.6,
) -> None:
    """Rest position, pull-in, modes, step response, bow, heat and scatter of a micromirror.

    Bow and heat need finite elements (extra `em`); the rest is written without them.
    """
    made = validate_design(MicromirrorDesign, read_toml(design, "design"))
    check_output(output)
    if model is not None:
        check_output(model, ".glb", option="glb")
    wires = validate_design(WireGridDesign, read_toml(grid, "grid")) if grid else WireGridDesign()
    console = open_console()
    transmittance, name = _polarizer_transmittance(polarizer)
    table = mirror.tabulate(made, f_number)
    plate = table if model is None or "deflection" in table else bend_plate(made)
    netcdf.write_dataset(output, table)
    attrs = table.attrs
    console.print(
        f"wrote {output}: piston {attrs['rigid_piston_m'] * 1e9:.1f} nm, tip {attrs['rigid_tip_deg']:.3f}°, "
        f"tilt {attrs['rigid_tilt_deg']:.3f}°; {_describe_settling(made, table)}"
    )
    if "deflection" not in table:
        console.print(f"bow and heat are left out: {missing_extra('skfem', 'em', 'bend plates')}")
    if plot:

        def draw_rays(figure: Figure) -> None:  # Figure 4c
            axes = figure.subplots()
            tilt = mirror.steepest_tilt(made)[0]
            plot_devices.superpixel_rays(axes, tilt, transmittance, f_number=f_number)
            axes.set_title(f"light at a mirror at its steepest tilt, and at {name}")

        overview = plot_devices.micromirror_overview
        _draw(output.with_suffix(".png"), lambda f: overview(f, table), console, (16, 9))
        _draw(output.with_name(output.stem + "-rays.png"), draw_rays, console, (8, 7))
    if model is not None:
        atomic.write_bytes(model, superpixel_glb(made, plate, wires, exaggeration=exaggeration))
        console.print(f"wrote {model}")


def _describe_settling(design: MicromirrorDesign, table: xr.Dataset) -> str:
    attrs, frame = table.attrs, design.drive.frame_time_ms
    if attrs["pulled_in"]:
        limit = attrs["dynamic_pull_in_v"]
        return f"the sudden step overshoots into pull-in (undamped limit {limit:.1f} V; raise it slowly)"
    if not attrs["settles_within_frame"]:
        return f"it does not settle within the frame of {frame:g} ms"
    return f"settles in {attrs['settling_time_s'] * 1e6:.1f} µs of a frame of {frame:g} ms"


def _draw(
    path: Path, draw: Callable[[Figure], object], console: Console, size: tuple[float, float] = (12, 9)
) -> None:
    figure = Figure(figsize=size, layout="constrained")
    draw(figure)
    images.write_figure(path, figure, dpi=120)
    console.print(f"wrote {path}")


def _polarizer_transmittance(polarizer: Path | None) -> tuple[float, str]:
    """Transmittance of a polarizer along its axis at mid-band, and its name; an ideal one without a file."""
    if polarizer is None:
        return 1.0, "an ideal polarizer"
    table = netcdf.read_dataset(polarizer, "polarizer")
    if "pass_transmittance" not in table:
        raise ValueError(
            f"`polarizer` must be an output of `glintrack device wiregrid`; got {polarizer} "
            "without `pass_transmittance`."
        )
    one = table.isel(wavelength=table.sizes["wavelength"] // 2)
    return float(one["pass_transmittance"]), f"a wire grid at {float(one['wavelength']):.2f} µm"
