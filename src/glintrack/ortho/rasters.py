"""Rasters under an orthophoto: heights, what surfaces hide, and a reference to register against."""

import math
from pathlib import Path

import numpy as np
import xarray as xr
from rasterio.errors import RasterioError
from rasterio.transform import from_origin
from rasterio.warp import Resampling, reproject

from glintrack.core.arrays import Array
from glintrack.core.image_shift import displacement_between
from glintrack.io.photographs import (
    Heights,
    NotReachedError,
    PlacedPose,
    applied,
    is_within,
    read_height_range,
    read_heights,
)
from glintrack.io.untrusted import open_raster
from glintrack.ortho.grid import heights_at, transform_axes
from glintrack.ortho.rasters import MapGrid
from glintrack.ortho.occlusion import occlusion_mask

_MOST_SURFACE = 100e6


def heights_under(path: Path, option: str, grid: MapGrid, placed: PlacedPose) -> Array:
    """Heights of a raster at the cells of a photograph's grid, NaN where it has none."""
    corners = np.meshgrid(np.linspace(grid.x[0], grid.x[-1], 33), np.linspace(grid.y[0], grid.y[-1], 33))
    try:
        heights = read_heights(path, option, corners[0], corners[1], grid.crs)
    except NotReachedError as error:
        raise ValueError(f"{error}{_if_exchanged(path, option, placed)}") from error
    return _at(heights, *transform_axes(grid.x, grid.y, grid.crs, heights.crs))


def _if_exchanged(path: Path, option: str, placed: PlacedPose) -> str:
    """A remedy for a pose far from a raster of heights that is near with easting and northing exchanged."""
    east = placed.origin_m[0] + placed.pose.east_m
    north = placed.origin_m[1] + placed.pose.north_m
    if is_within(path, option, east, north, placed.crs):
        return ""
    if not is_within(path, option, north, east, placed.crs):
        return f" (the pose is at {east:.9g} m east, {north:.9g} m north in its own CRS)"
    return (
        f" (with easting_m = {north:.9g} and northing_m = {east:.9g} the pose lies over {path.name}: are "
        "they exchanged?)"
    )


def _at(heights: Heights, x: Array, y: Array) -> Array:
    column, row = applied(heights.to_pixel, x, y)
    return heights_at(heights.values, row, column)


def displacement_against(bands: Array, path: Path, grid: MapGrid) -> tuple[float, float]:
    """Displacement of a rectified picture against a reference raster. [cell]"""
    reference = np.full(bands.shape[:2], np.nan)
    try:
        with open_raster(path, "register") as file:
            if file.crs is None:
                raise ValueError(
                    f"`register` must have a CRS, got none in {path.name} (gdal_edit.py -a_srs …)"
                )
            corner = from_origin(grid.x[0] - grid.gsd / 2, grid.y[0] + grid.gsd / 2, grid.gsd, grid.gsd)
            reproject(
                file.read(1, masked=True).astype(float).filled(np.nan), reference,
                src_transform=file.transform, src_crs=file.crs, src_nodata=np.nan,
                dst_transform=corner, dst_crs=grid.crs, dst_nodata=np.nan, resampling=Resampling.bilinear,
            )  # fmt: skip
    except RasterioError as error:
        raise ValueError(f"`register` must be a raster that GDAL reads, got {path}") from error
    rows, columns, _ = displacement_between(bands[..., 0], reference)
    if not math.isfinite(rows):
        raise ValueError(
            "`register` must show the same ground as the frame, got no displacement that stands out "
            f"against {path.name}"
        )
    return rows, columns


def occlusion_by_raster(
    path: Path, grid: MapGrid, placed: PlacedPose, east: Array, north: Array, ground: Array
) -> Array:
    """Cells hidden by a surface model, which is first brought to an even grid of metres around the result."""
    lowest, highest = read_height_range(path, "surface")
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
        raise ValueError(f"`surface` must be coarser, or `area` smaller, got cells of {step:g} m")
    x, y = np.arange(west, right + step, step), np.arange(top, south - step, -step)
    axes = x + placed.origin_m[0], y + placed.origin_m[1]
    heights = read_heights(path, "surface", *np.meshgrid(axes[0][[0, -1]], axes[1][[0, -1]]), placed.crs)
    values = _at(heights, *transform_axes(*axes, placed.crs, heights.crs))
    metres = {"units": "m"}
    model = xr.Dataset(
        {"height": (("y", "x"), np.where(np.isfinite(values), values, lowest), metres)},
        coords={"y": ("y", y, metres), "x": ("x", x, metres)},
    )
    return occlusion_mask(model, pose, east, north, ground)


def _pixel_size(path: Path, placed: PlacedPose, west: float, south: float) -> float:
    """Side of a raster's pixel at a place, in metres."""
    x, y = west + placed.origin_m[0] + np.array([0.0, 100.0]), south + placed.origin_m[1] + np.array([0.0])
    heights = read_heights(path, "surface", *np.meshgrid(x, y), placed.crs)
    column, row = applied(heights.to_pixel, *transform_axes(x, y, placed.crs, heights.crs))
    return 100.0 / float(np.hypot(np.diff(column), np.diff(row))[0, 0])
