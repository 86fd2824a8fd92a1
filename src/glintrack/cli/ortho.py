"""``glintrack ortho``: rectify an image of one's own, from its camera, its pose and the heights under it."""

from pathlib import Path
from typing import Annotated, Literal

import pyproj
import typer
from rich.console import Console

from glintrack.cli.options import command_app
from glintrack.io.atomic import check_new
from glintrack.ortho.photograph import rectify

app = command_app()


@app.command()
def ortho(
    frame: Annotated[Path, typer.Argument(help="Image that GDAL reads, or a frame of glintrack's own (.nc)")],
    camera: Annotated[Path, typer.Option(help="TOML: focal_length_mm, pitch_um, rows, columns")],
    pose: Annotated[
        Path,
        typer.Option(
            help="TOML, or CSV with a row a frame: crs, place [m or °], attitude [°]; docs/howto/my_frames.md"
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="File to write: .tif (COG) or .nc")],
    dem: Annotated[
        Path | None, typer.Option(help="Heights of the ground [m], any raster in any CRS; or give --height")
    ] = None,
    height: Annotated[float | None, typer.Option(help="One height for all the ground [m]")] = None,
    surface: Annotated[
        Path | None, typer.Option(help="Heights of roofs and crowns [m]: what they hide becomes NaN")
    ] = None,
    crs: Annotated[str | None, typer.Option(help="CRS of the result [default: the pose's]")] = None,
    gsd: Annotated[
        float | None, typer.Option(help="Cell, in units of the result's CRS [default: a pixel's, in metres]")
    ] = None,
    area: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(help="West south east north of the result, in its CRS [default: what the frame sees]"),
    ] = None,
    method: Annotated[
        Literal["nearest", "bilinear", "cubic"], typer.Option(help="Interpolation")
    ] = "bilinear",
    register: Annotated[
        Path | None,
        typer.Option(help="Raster in its right place: the result is moved onto its first band's content"),
    ] = None,
) -> None:
    """Rectify an image of your own by collinearity with its pose, onto a DEM, in any CRS."""
    if (dem is None) == (height is None):
        raise ValueError(
            "`glintrack ortho` must get one of --dem and --height, got " + ("both" if dem else "none")
        )
    if output.suffix.lower() not in (".tif", ".tiff", ".nc") or not output.parent.is_dir():
        raise ValueError(f"`output` must end in .tif or .nc and lie in an existing folder, got {output}")
    check_new(output)
    console = Console()
    ground: Path | float = dem if dem is not None else height or 0.0
    with console.status("rectifying …"):
        found = rectify(
            frame,
            camera,
            pose,
            ground,
            surface=surface,
            crs=crs,
            gsd=gsd,
            area=area,
            method=method,
            register=register,
        )
        found.write(output)
    grid, note = found.grid, ""
    if register is not None:
        rows, columns = (found.tags[f"registration_{axis}"] for axis in ("rows", "columns"))
        note = f", moved by {rows:.2f} rows, {columns:.2f} columns"
    flat = pyproj.CRS(grid.crs)
    unit = "m" if flat.axis_info[0].unit_name == "metre" else "°" if flat.is_geographic else ""
    count = len(found.names)
    size = f"{len(grid.y)} × {len(grid.x)} cells of {grid.gsd:g} {unit}".rstrip()
    bands = f"{count} band{'s' if count > 1 else ''}"
    if output.suffix.lower() != ".nc":
        bands += f" of {found.dtype}"
    console.print(f"wrote {output}: {size} in {flat.name}, {bands}{note}", soft_wrap=True, markup=False)
