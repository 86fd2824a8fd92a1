"""``glintrack device``: solve the sensor's optical devices, and draw them."""

from pathlib import Path
from typing import Annotated

import typer
import xarray as xr
from matplotlib.figure import Figure
from rich.console import Console

from glintrack.cli.options import check_folder, command_app
from glintrack.cli.wire_grid import Output, Plot, solve_wiregrid
from glintrack.core.designs import validate_design
from glintrack.core.installation import missing_extra
from glintrack.devices import EtalonDesign, MicromirrorDesign, WireGridDesign, etalon
from glintrack.devices import micromirror as mirror
from glintrack.devices.micromirror.model3d import superpixel_glb
from glintrack.devices.micromirror.plate import bend_plate
from glintrack.io import atomic, images, netcdf
from glintrack.io.toml import read_toml
from glintrack.results.figures import devices as plot_devices

_TRAVEL_POINTS = 200
app = command_app("Solve wire grids, etalons and micromirrors, and plot them.")
app.command("wiregrid")(solve_wiregrid)


@app.command("etalon")
def solve_etalon(
    design: Annotated[Path, typer.Argument(help="TOML file of an etalon; an empty one is the default")],
    output: Output,
    plot: Plot = False,
) -> None:
    """Transmittance of a tunable etalon over gap and wavelength, its peaks and drive voltages."""
    made = validate_design(EtalonDesign, read_toml(design, "design"))
    made = made.model_copy(update={"metal": made.metal.resolve_files(design.parent)})
    check_folder(output)
    table = etalon.tabulate(made)
    netcdf.write_dataset(output, table)
    console = Console()
    best = table.isel(peak_wavelength=int(table["peak_transmittance"].argmax("peak_wavelength")))
    console.print(
        f"wrote {output}: {table.sizes['gap']} gaps × {table.sizes['wavelength']} wavelengths; best peak "
        f"{float(best['peak_transmittance']):.2f} at {float(best['peak_wavelength']):.2f} µm",
        soft_wrap=True,
    )
    if plot:
        _draw(output.with_suffix(".png"), plot_devices.etalon_overview, table, console)


@app.command("micromirror")
def solve_micromirror(
    design: Annotated[Path, typer.Argument(help="TOML file of a micromirror; an empty one is the default")],
    output: Output,
    plot: Plot = False,
    model: Annotated[
        Path | None, typer.Option("--glb", help="Write the superpixel as a 3-D model, too (extra `em`)")
    ] = None,
    grid: Annotated[
        Path | None, typer.Option(help="TOML file of the model's polarizers [default: the paper's grid A]")
    ] = None,
    exaggeration: Annotated[
        float, typer.Option(min=0, max=1e6, help="Factor on the plate's deflection in the 3-D model")
    ] = 1.0,
    polarizer: Annotated[
        Path | None,
        typer.Option(help="Output of `device wiregrid` for the ray picture [default: an ideal polarizer]"),
    ] = None,
    f_number: Annotated[
        float, typer.Option(min=0.5, max=64, help="Of the lens, and of the relay behind the mirror")
    ] = 5.6,
) -> None:
    """Rest position, pull-in, modes, step response, bow, heat and scatter of a micromirror.

    Bow and heat need finite elements (extra `em`); the rest is written without them.
    """
    made = validate_design(MicromirrorDesign, read_toml(design, "design"))
    for path in (output, *([model] if model else [])):
        check_folder(path)
    if model is not None and model.suffix.lower() != ".glb":
        raise ValueError(f"`glb` must end in .glb, got {model.name!r}")
    wires = validate_design(WireGridDesign, read_toml(grid, "grid")) if grid else WireGridDesign()
    console = Console()
    through = _through(polarizer)
    table = mirror.tabulate(made, f_number)
    plate = table if model is None or "deflection" in table else bend_plate(made)
    netcdf.write_dataset(output, table)
    attrs = table.attrs
    console.print(
        f"wrote {output}: piston {attrs['rigid_piston_m'] * 1e9:.1f} nm, "
        f"tip {attrs['rigid_tip_deg']:.3f}°, tilt {attrs['rigid_tilt_deg']:.3f}°; "
        f"{settling_sentence(made, table)}",
        soft_wrap=True,
    )
    if "deflection" not in table:
        why = missing_extra("skfem", "em", "bend plates")
        console.print(f"bow and heat are left out: {why}", soft_wrap=True, markup=False)
    if plot:
        _draw(output.with_suffix(".png"), plot_devices.micromirror_overview, table, console, (16, 9))
        _draw_rays(output.with_name(output.stem + "-rays.png"), made, f_number, through, console)
    if model is not None:
        atomic.write_bytes(model, superpixel_glb(made, plate, wires, exaggeration=exaggeration))
        console.print(f"wrote {model}", soft_wrap=True)


def settling_sentence(design: MicromirrorDesign, table: xr.Dataset) -> str:
    """Whether the mirror settles within a frame, in words."""
    attrs, frame = table.attrs, design.drive.frame_time_ms
    if attrs["pulled_in"]:
        limit = attrs["dynamic_pull_in_v"]
        return f"the sudden step overshoots into pull-in (undamped limit {limit:.1f} V; raise it slowly)"
    if not attrs["settles_within_frame"]:
        return f"it does not settle within the frame of {frame:g} ms"
    return f"settles in {attrs['settling_time_s'] * 1e6:.1f} µs of a frame of {frame:g} ms"


def _draw(path: Path, picture, table: xr.Dataset, console: Console, size: tuple[int, int] = (12, 9)) -> None:
    figure = Figure(figsize=size, layout="constrained")
    picture(figure, table)
    images.write_figure(path, figure, dpi=120)
    console.print(f"wrote {path}", soft_wrap=True)


def _through(polarizer: Path | None) -> tuple[float, str]:
    """What a polarizer passes along its axis at mid-band, and its name in words; an ideal one without."""
    if polarizer is None:
        return 1.0, "an ideal polarizer"
    table = netcdf.read_dataset(polarizer, "polarizer")
    if "pass_transmittance" not in table:
        raise ValueError(
            f"`polarizer` must be an output of `glintrack device wiregrid`, got {polarizer} "
            "without `pass_transmittance`"
        )
    one = table.isel(wavelength=table.sizes["wavelength"] // 2)
    return float(one["pass_transmittance"]), f"a wire grid at {float(one['wavelength']):.2f} µm"


def _draw_rays(
    path: Path,
    design: MicromirrorDesign,
    f_number: float,
    through: tuple[float, str],
    console: Console,
) -> None:
    """The rays of Figure 4c with the mirror at its steepest tilt; a real polarizer at mid-band."""
    passed, what = through
    figure = Figure(figsize=(8, 7), layout="constrained")
    axes = figure.subplots()
    plot_devices.superpixel_rays(axes, mirror.steepest_tilt(design)[0], passed, f_number=f_number)
    axes.set_title(f"light at a mirror at its steepest tilt, and at {what}")
    images.write_figure(path, figure, dpi=120)
    console.print(f"wrote {path}", soft_wrap=True)
