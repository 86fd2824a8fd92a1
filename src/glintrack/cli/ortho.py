"""``glintrack ortho``: rectify your own image from its camera, its pose and the ground heights."""

from pathlib import Path
from typing import Annotated, Literal

import pyproj

from glintrack.cli.options import Area, argument, check_output, command_app, open_console, option, show_wait
from glintrack.io.atomic import check_new
from glintrack.ortho.photograph import rectify

app = command_app()


@app.command()
def ortho(
    frame: Annotated[Path, argument("Image in a format of GDAL, or a frame of glintrack (.nc)")],
    camera: Annotated[Path, option("TOML file: focal_length_mm, pitch_um, rows, columns")],
    pose: Annotated[Path, option("TOML or CSV file: CRS, position, attitude (docs/howto/my_frames.md)")],
    output: Annotated[Path, option("File to write: .tif (COG) or .nc", "-o", "--output")],
    dem: Annotated[Path | None, option("Raster of ground heights [m] in any CRS; or give --height")] = None,
    height: Annotated[float | None, option("One height for all the ground [m]")] = None,
    surface: Annotated[Path | None, option("Raster of surface heights [m], which hide ground")] = None,
    crs: Annotated[str | None, option("CRS of the result [default: the pose's]")] = None,
    gsd: Annotated[float | None, option("Cell size in units of the CRS [default: a pixel's]")] = None,
    area: Annotated[Area | None, option("West, south, east, north in the CRS [default: the frame's]")] = None,
    method: Annotated[Literal["nearest", "bilinear", "cubic"], option("Interpolation")] = "bilinear",
    register: Annotated[Path | None, option("Raster to register the result to (its first band)")] = None,
) -> None:
    """Rectify your own image by collinearity with its pose, onto a DEM, in any CRS."""
    if (dem is None) == (height is None):
        raise ValueError("`ortho` must get one of --dem and --height; got " + ("both." if dem else "none."))
    check_output(output, ".tif", ".tiff", ".nc")
    check_new(output)
    console = open_console()
    with show_wait(console, "rectifying"):
        found = rectify(
            frame,
            camera,
            pose,
            dem if dem is not None else height or 0.0,
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
    flat, count = pyproj.CRS(grid.crs), len(found.names)
    unit = " m" if flat.axis_info[0].unit_name == "metre" else " °" if flat.is_geographic else ""
    bands = f"{count} band{'s' if count > 1 else ''}"
    bands += "" if output.suffix.lower() == ".nc" else f" of {found.dtype}"
    size = f"{len(grid.y)} × {len(grid.x)} cells of {grid.gsd:g}{unit}"
    console.print(f"wrote {output}: {size} in {flat.name}, {bands}{note}")
