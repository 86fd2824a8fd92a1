"""``glintrack ortho``: rectify an image of one's own, from its camera, its pose and the heights under it."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import rasterio
import typer
import xarray as xr
from rasterio.crs import CRS
from rasterio.errors import RasterioError
from rasterio.transform import from_origin
from rasterio.warp import Resampling, reproject
from rich.console import Console

from glintrack import ortho as rectification
from glintrack.arrays import Array
from glintrack.camera import Camera, ground_points, rays
from glintrack.cli.options import command_app
from glintrack.image_shift import displacement_between
from glintrack.io import files
from glintrack.io.photographs import (
    Heights,
    PlacedPose,
    applied,
    read_camera,
    read_height_range,
    read_heights,
    read_picture,
    read_pose,
)
from glintrack.schema import check

_MOST_CELLS = 400e6
_MOST_SURFACE = 100e6


app = command_app()


@app.command()
def ortho(
    frame: Annotated[Path, typer.Argument(help="Image that GDAL reads, or a frame of glintrack's own (.nc)")],
    camera: Annotated[Path, typer.Option(help="TOML: focal_length_mm, pitch_um, rows, columns")],
    pose: Annotated[
        Path,
        typer.Option(
            help="TOML, or CSV with a row a frame: crs, place [m or °], attitude [°]; docs/geometry.md"
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
    console = Console()
    with console.status("rectifying …"):
        lens, placed = read_camera(camera), read_pose(pose, frame.name)
        _looks_down(lens, placed, area is None)
        picture = _Picture.read(frame, lens)
        levels = (
            (height, height) if height is not None else read_height_range(dem, "--dem") if dem else (0, 0)
        )
        if placed.pose.up_m <= levels[0]:
            raise ValueError(
                f"`pose.height_m` must be above the ground, {levels[0]:g} m at its lowest, "
                f"got {placed.pose.up_m:g} m (are both in the same heights?)"
            )
        target = _Grid.of(lens, placed, levels, crs, gsd, area)
        east, north = target.places(placed)
        ground = np.full(east.shape, height, float) if dem is None else _under(dem, "--dem", target)
        _no_holes(ground, lens, placed, east, north)
        bands = picture.onto(lens, placed, east, north, ground, method)
        tags: dict[str, str | float] = {"frame": frame.name, "method": method}
        if register is not None:
            rows, columns = _misplaced(bands, register, target)
            moved = target.moved(rows, columns).places(placed)
            bands = picture.onto(lens, placed, *moved, ground, method)
            tags |= {"registration_rows": rows, "registration_columns": columns}
        names = picture.names
        if surface is not None:
            dark = _behind(surface, target, placed, east, north, ground)
            bands[dark] = np.nan
            bands = np.concatenate([bands, dark[..., None].astype(np.float32)], axis=-1)
            names = [*names, "occluded"]
        if not np.isfinite(bands[..., : len(picture.names)]).any():
            raise ValueError("`--area` must hold ground that the frame sees, got none of it")
        files.write_bands(output, bands, names, target.x, target.y, target.crs, tags)
    note = ""
    if register is not None:
        note = f", moved by {tags['registration_rows']:.2f} rows, {tags['registration_columns']:.2f} columns"
    size = f"{len(target.y)} × {len(target.x)} cells of {target.gsd:g}"
    console.print(
        f"wrote {output}: {size}, {len(names)} bands{note}",
        soft_wrap=True,
        markup=False,
    )


@dataclass(frozen=True)
class _Picture:
    """What is rectified: a user's image, or a frame of superpixels."""

    values: Array
    names: list[str]
    frame: xr.Dataset | None = None

    @classmethod
    def read(cls, path: Path, camera: Camera) -> "_Picture":
        if path.suffix.lower() == ".nc":
            frame = check(files.read_dataset(path, "FRAME"), "frame")
            size = tuple(round(float(2 * frame[n][0] + frame[n].diff(n).sum() + 1)) for n in ("y", "x"))
            found = cls(np.empty(0), ["pan", "I", "Q", "U"], frame)
        else:
            values, names = read_picture(path)
            size, found = values.shape[:2], cls(values, names)
        if size != (camera.rows, camera.columns):
            raise ValueError(
                f"`FRAME` must be {camera.rows} × {camera.columns} pixels as the camera file says, "
                f"got {size[0]} × {size[1]}"
            )
        return found

    def onto(self, camera: Camera, placed: PlacedPose, east, north, ground, method: str) -> Array:
        if self.frame is None:
            return rectification.rectify_onto(self.values, camera, placed.pose, east, north, ground, method)
        pan, stokes = rectification.rectify_frame(
            self.frame, camera, placed.pose, east, north, ground, method
        )
        return np.concatenate([pan[..., None], stokes[..., :3]], axis=-1)


@dataclass(frozen=True)
class _Grid:
    """Axes of the result in its own CRS."""

    x: Array
    y: Array
    gsd: float
    crs: str

    @classmethod
    def of(cls, camera: Camera, placed: PlacedPose, levels, crs, gsd, area) -> "_Grid":
        own = placed.crs if crs is None else crs
        if area is None:
            area = _seen(camera, placed, levels, own)
        if gsd is None:
            if crs is not None and CRS.from_user_input(own).is_geographic:
                raise ValueError(f"`--gsd` must be given in degrees for a geographic CRS, got none for {crs}")
            gsd = _pixel_on_ground(camera, placed, sum(levels) / 2)
        if not gsd > 0:
            raise ValueError(f"`--gsd` must be positive, got {gsd:g}")
        west, south, east, north = (f(v / gsd) * gsd for f, v in zip(_OUTWARD, area, strict=True))
        if not (west < east and south < north):
            raise ValueError(f"`--area` must be west south east north and not empty, got {area}")
        if (east - west) / gsd * (north - south) / gsd > _MOST_CELLS:
            raise ValueError(
                f"`--gsd` must be larger, or `--area` smaller, got {(east - west) / gsd:.3g} × "
                f"{(north - south) / gsd:.3g} cells"
            )
        columns, rows = max(round((east - west) / gsd), 2), max(round((north - south) / gsd), 2)
        x, y = west + gsd * (np.arange(columns) + 0.5), north - gsd * (np.arange(rows) + 0.5)
        return cls(x, y, gsd, own)

    def moved(self, rows: float, columns: float) -> "_Grid":
        """Where the picture's content of each cell was found."""
        return _Grid(self.x + columns * self.gsd, self.y - rows * self.gsd, self.gsd, self.crs)

    def places(self, placed: PlacedPose) -> tuple[Array, Array]:
        """East and north of every cell from the pose's origin. [m]"""
        east, north = rectification.transform_axes(self.x, self.y, self.crs, placed.crs)
        return east - placed.origin_m[0], north - placed.origin_m[1]


_OUTWARD = (math.floor, math.floor, math.ceil, math.ceil)


def _border(camera: Camera) -> Array:
    """Pixels' outer corners and edges, every one on the border of the frame."""
    rows = np.linspace(-0.5, camera.rows - 0.5, 33)
    columns = np.linspace(-0.5, camera.columns - 0.5, 33)
    edges = [np.stack(np.broadcast_arrays(r, columns), -1) for r in (rows[0], rows[-1])]
    edges += [np.stack(np.broadcast_arrays(rows, c), -1) for c in (columns[0], columns[-1])]
    return np.concatenate(edges)


def _looks_down(camera: Camera, placed: PlacedPose, whole: bool) -> None:
    """Refuse a frame that sees the horizon: with an area, only one whose middle does."""
    pixels = _border(camera) if whole else np.array([camera.principal_point])
    if (rays(camera, placed.pose, pixels)[..., 2] > -1e-3).any():
        remedy = "give --area to rectify a part" if whole else "check the angles' signs and units"
        raise ValueError(
            f"`pose` must look below the horizon, got a line of sight at or above it in the frame ({remedy})"
        )


def _seen(camera: Camera, placed: PlacedPose, levels: tuple[float, float], crs: str) -> tuple:
    """Bounds, in a CRS, of the ground that the frame sees between two heights."""
    heights = [h for h in levels if h < placed.pose.up_m]
    border = np.concatenate([ground_points(camera, placed.pose, _border(camera), h) for h in heights])
    east, north = border[:, 0] + placed.origin_m[0], border[:, 1] + placed.origin_m[1]
    places = np.stack(rectification.transform_places(east, north, placed.crs, crs), axis=-1)
    return (*places.min(axis=0).tolist(), *places.max(axis=0).tolist())


def _pixel_on_ground(camera: Camera, placed: PlacedPose, level: float) -> float:
    """Side of a square as large as the middle pixel's share of the ground, to two digits. [m]"""
    row, column = camera.principal_point
    corners = np.array([[row, column], [row + 1, column], [row, column + 1]])
    a, b, c = ground_points(camera, placed.pose, corners, min(level, placed.pose.up_m - 1))
    side = math.sqrt(float(np.linalg.norm(np.cross(b - a, c - a))))
    return float(f"{side:.2g}")


def _under(path: Path, option: str, grid: _Grid) -> Array:
    """Heights of a raster at the cells of a grid, NaN where it has none."""
    corners = np.meshgrid(np.linspace(grid.x[0], grid.x[-1], 33), np.linspace(grid.y[0], grid.y[-1], 33))
    heights = read_heights(path, option, corners[0], corners[1], grid.crs)
    return _at(heights, *rectification.transform_axes(grid.x, grid.y, grid.crs, heights.crs))


def _at(heights: Heights, x: Array, y: Array) -> Array:
    column, row = applied(heights.to_pixel, x, y)
    return rectification.heights_at(heights.values, row, column)


def _no_holes(ground: Array, camera: Camera, placed: PlacedPose, east: Array, north: Array) -> None:
    """Refuse heights that are missing where the frame looks."""
    missing = ~np.isfinite(ground)
    if not missing.any():
        return
    level = float(np.nanmedian(ground)) if not missing.all() else 0.0
    seen = _within(camera, placed, east, north, level)
    holes = missing & seen
    if holes.any():
        raise ValueError(
            "`--dem` must have a height wherever the frame looks, got none in "
            f"{100 * holes.sum() / seen.sum():.2g} % of that ground "
            "(fill it with gdal_fillnodata.py, give a smaller --area, or --height)"
        )


def _within(camera: Camera, placed: PlacedPose, east: Array, north: Array, level: float) -> Array:
    frame = np.zeros((camera.rows, camera.columns), np.float32)
    level_ground = np.full(east.shape, level)
    found = rectification.rectify_onto(frame, camera, placed.pose, east, north, level_ground, "nearest")
    return np.isfinite(found)


def _misplaced(bands: Array, path: Path, grid: _Grid) -> tuple[float, float]:
    """Displacement of a rectified picture against a reference raster. [cell]"""
    reference = np.full(bands.shape[:2], np.nan)
    try:
        with rasterio.open(path) as file:
            if file.crs is None:
                raise ValueError(
                    f"`--register` must have a CRS, got none in {path.name} (gdal_edit.py -a_srs …)"
                )
            corner = from_origin(grid.x[0] - grid.gsd / 2, grid.y[0] + grid.gsd / 2, grid.gsd, grid.gsd)
            reproject(
                file.read(1, masked=True).astype(float).filled(np.nan), reference,
                src_transform=file.transform, src_crs=file.crs, src_nodata=np.nan,
                dst_transform=corner, dst_crs=grid.crs, dst_nodata=np.nan, resampling=Resampling.bilinear,
            )  # fmt: skip
    except RasterioError as error:
        raise ValueError(f"`--register` must be a raster that GDAL reads, got {path}") from error
    rows, columns, _ = displacement_between(bands[..., 0], reference)
    if not math.isfinite(rows):
        raise ValueError(
            "`--register` must show the same ground as the frame, got no displacement that stands out "
            f"against {path.name}"
        )
    return rows, columns


def _behind(path: Path, grid: _Grid, placed: PlacedPose, east: Array, north: Array, ground: Array) -> Array:
    """Cells hidden by a surface model, which is first brought to an even grid of metres around the result."""
    lowest, highest = read_height_range(path, "--surface")
    pose = placed.pose
    fall = max(pose.up_m - highest, 1.0)
    far = float(np.hypot(east - pose.east_m, north - pose.north_m).max())
    reach = (highest - min(lowest, float(np.nanmin(ground)))) * far / fall + 2 * grid.gsd
    toward = [min(max(v, a - reach), b + reach) for v, a, b in (
        (pose.east_m, east.min(), east.max()), (pose.north_m, north.min(), north.max()))]  # fmt: skip
    west, right = min(east.min(), toward[0]), max(east.max(), toward[0])
    south, top = min(north.min(), toward[1]), max(north.max(), toward[1])
    step = max(_pixel_size(path, placed, west, south), 0.05)
    if (right - west) * (top - south) / step**2 > _MOST_SURFACE:
        raise ValueError(f"`--surface` must be coarser, or `--area` smaller, got cells of {step:g} m")
    x, y = np.arange(west, right + step, step), np.arange(top, south - step, -step)
    axes = x + placed.origin_m[0], y + placed.origin_m[1]
    heights = read_heights(path, "--surface", *np.meshgrid(axes[0][[0, -1]], axes[1][[0, -1]]), placed.crs)
    values = _at(heights, *rectification.transform_axes(*axes, placed.crs, heights.crs))
    metres = {"units": "m"}
    model = xr.Dataset(
        {"height": (("y", "x"), np.where(np.isfinite(values), values, lowest), metres)},
        coords={"y": ("y", y, metres), "x": ("x", x, metres)},
    )
    return rectification.hidden(model, pose, east, north, ground)


def _pixel_size(path: Path, placed: PlacedPose, west: float, south: float) -> float:
    """Side of a raster's pixel at a place, in metres."""
    x, y = west + placed.origin_m[0] + np.array([0.0, 100.0]), south + placed.origin_m[1] + np.array([0.0])
    heights = read_heights(path, "--surface", *np.meshgrid(x, y), placed.crs)
    column, row = applied(heights.to_pixel, *rectification.transform_axes(x, y, placed.crs, heights.crs))
    return 100.0 / float(np.hypot(np.diff(column), np.diff(row))[0, 0])
