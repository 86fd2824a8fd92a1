"""``glintrack render``: one frame of a case, as a picture or as data."""

from pathlib import Path
from typing import Annotated, cast

import numpy as np
from rich.console import Console

from glintrack.case.build import trace_frame
from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.cli.options import Bar, CaseArgument, command_app, open_console, option, show_wait
from glintrack.core.records import RasterLayout
from glintrack.io import images, raster
from glintrack.render.frame import FrameView, Product, cube_blocks, cube_layout, render_product
from glintrack.results.figures import frame as plot_frame
from glintrack.results.figures.frame import azimuth_of, in_view, on_map
from glintrack.stokes import dolp

_PICTURES = (".png", ".jpg", ".jpeg")
Bands = tuple[tuple[float, float], ...]
app = command_app()


@app.command()
def render(
    case: CaseArgument,
    output: Annotated[
        Path,
        option(
            "File to write: .png or .jpg for a picture; .tif, .hdr (ENVI), .nc or .zarr for data",
            "-o",
            "--output",
        ),
    ],
    frame: Annotated[int, option("Index of the frame, from 0")] = 0,
    rgb: Annotated[bool, option("Natural colour (the default)", "--rgb")] = False,
    band: Annotated[list[str] | None, option("Mean radiance I, Q, U over A:B [µm]; repeatable")] = None,
    degree: Annotated[bool, option("Degree of linear polarization", "--dolp")] = False,
    angle: Annotated[bool, option("Angle of polarization", "--aop")] = False,
    cube: Annotated[bool, option("I, Q, U at every wavelength", "--cube")] = False,
    ortho: Annotated[bool, option("Rectify onto the ground grid", "--ortho")] = False,
    gsd: Annotated[float | None, option("Cell of the grid [m] [default: the case's]", min=0.05)] = None,
) -> None:
    """Render one frame of a case as the lens receives it.

    Bands are in µm, radiance in W m⁻² sr⁻¹ µm⁻¹, angles in rad.
    """
    bands = tuple(_parse_band(text) for text in band or ())
    product = _select_product(rgb, degree, angle, cube, bands)
    picture = output.suffix.lower() in _PICTURES
    _check_output(output, product, bands, picture)
    if gsd is not None and not ortho:
        raise ValueError(f"`--gsd` must be given with --ortho; got {gsd:g} without it.")
    design = Case.from_toml(find_case(case))
    console = open_console()
    with show_wait(console, "tracing a frame"):
        view = trace_frame(design, frame, ortho, gsd)
    if product == "cube":
        layout = _write_cube(output, view, bands, console)
    else:
        with show_wait(console, "shading"):
            layout, values = render_product(view, cast(Product, product), bands)
            of_aop = product == "aop" and picture
            polarized = dolp(render_product(view, "radiance", bands)[1]) if of_aop else None
        if picture:
            _draw(output, design.name, view, layout, values, polarized)
        else:
            with raster.raster_writer(output, layout) as write:
                write(0, 0, values)
    size = f"{layout.columns} × {layout.rows}"
    bands_said = "" if picture else f", {layout.count} band{'s' if layout.count > 1 else ''}"
    console.print(f"wrote {output}: {size} pixels{bands_said}")


def _parse_band(text: str) -> tuple[float, float]:
    try:
        low, high = (float(part) for part in text.split(":"))
    except ValueError:
        raise ValueError(f"`--band` must be two wavelengths in µm, as 0.6:0.7; got {text!r}.") from None
    if not 0 < low < high < np.inf:
        raise ValueError(f"`--band` must be two rising wavelengths in µm; got {text!r}.")
    return low, high


def _select_product(rgb: bool, degree: bool, angle: bool, cube: bool, bands: Bands) -> str:
    flags = {"rgb": rgb, "dolp": degree, "aop": angle, "cube": cube}
    given = [name for name, flag in flags.items() if flag]
    if len(given) > 1:
        raise ValueError(f"`render` must get one product; got --{' and --'.join(given)}.")
    if given == ["rgb"] and bands:
        raise ValueError("`--rgb` must be given without --band; got both.")
    if given == ["cube"] and len(bands) > 1:
        raise ValueError(f"`--cube` must be given at most one --band, its range; got {len(bands)}.")
    return given[0] if given else "radiance" if bands else "rgb"


def _check_output(output: Path, product: str, bands: Bands, picture: bool) -> None:
    """Refuse what cannot be written before anything is built."""
    if product == "cube" and output.suffix.lower() not in (".hdr", ".nc", ".zarr"):
        raise ValueError(f"`output` must end in .hdr, .nc or .zarr for a cube; got {output.name!r}.")
    if not picture and output.suffix.lower() not in raster.SUFFIXES:
        suffixes = ", ".join((*_PICTURES, *raster.SUFFIXES))
        raise ValueError(f"`output` must end in one of {suffixes}; got {output.name!r}.")
    if picture and len(bands) > 1:
        raise ValueError(f"`--band` must be given once for a picture; got {len(bands)}.")
    (raster.check_place if picture else raster.output_files)(output)


def _write_cube(output: Path, view: FrameView, bands: Bands, console: Console) -> RasterLayout:
    range_um = bands[0] if bands else None
    layout = cube_layout(view, range_um)
    with raster.raster_writer(output, layout) as write, Bar(console) as progress:
        task = progress.add_task("writing the cube", total=layout.rows * len(layout.channels))
        for row, channel, values in cube_blocks(view, layout, range_um):
            write(row, channel, values)
            progress.update(task, advance=values.shape[0] * values.shape[2])
    return layout


def _draw(
    output: Path,
    name: str,
    view: FrameView,
    layout: RasterLayout,
    values: np.ndarray,
    polarized: np.ndarray | None,
) -> None:
    extent = view.city.extent_m if view.grid is not None else None
    sun = azimuth_of(view.sky.sun_direction)
    bearings = on_map(sun) if extent is not None else in_view(view.camera, view.pose, sun)
    shown = values[:, :, 0, 0]
    band = f", {layout.channels[0].replace(' um', ' µm')}" if layout.channels[0] else ""
    if layout.name == "rgb":
        colours, scale, label = values[:, :, 0], None, "natural colour"
    elif layout.name == "dolp":
        colours, scale = plot_frame.dolp_colours(shown)
        label = f"degree of linear polarization{band}"
    elif layout.name == "aop":
        assert polarized is not None
        on_ground = layout.stokes_frame == "meridian"
        colours, scale = plot_frame.aop_colours(shown, polarized[:, :, 0], np.pi / 2 if on_ground else 0.0)
        frame = "from the vertical" if on_ground else "from image right"
        label = f"angle of polarization {frame}, counter-clockwise{band} [°]"
    else:
        colours, scale = plot_frame.radiance_colours(shown)
        label = f"radiance{band} [W m$^{{-2}}$ sr$^{{-1}}$ µm$^{{-1}}$]"
    title = f"{name}, frame {view.frame} at {view.time_s:g} s: {label.split(' [')[0]}"
    images.write_figure(output, plot_frame.frame_figure(colours, scale, label, extent, title, bearings))
