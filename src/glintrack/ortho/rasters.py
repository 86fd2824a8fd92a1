"""Grids of orthophotos in any CRS, and rasters under them: heights, occlusion, a reference to register."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from rasterio.crs import CRS
from rasterio.errors import RasterioError
from rasterio.transform import from_origin
from rasterio.warp import Resampling, reproject

from glintrack.camera import Camera, ground_points
from glintrack.core.arrays import Array
from glintrack.core.records import Extent
from glintrack.io.heights import (
    Heights,
    NotReachedError,
    is_within,
    read_height_range,
    read_heights,
    transform_points,
)
from glintrack.io.photographs import PlacedPose
from glintrack.io.read_raster import read_raster
from glintrack.io.untrusted import MAX_CELL_M, MAX_COORDINATE_M
from glintrack.ortho.grid import heights_at, transform_axes, transform_places
from glintrack.ortho.image_shift import displacement_between
from glintrack.ortho.occlusion import occlusion_mask

_MAX_CELLS = 400e6
MAX_CELLS_PER_PIXEL = 25  # for each pixel of a frame: five frames long and wide
_OUTWARD = (math.floor, math.floor, math.ceil, math.ceil)


@dataclass(frozen=True)
class MapGrid:
    """Centres of an orthophoto's cells in its own CRS, falling northings.

    Parameters
    ----------
    x, y, gsd
        Axes and cell. [unit of crs]
    crs
        Anything that PROJ understands.
    """

    x: Array
    y: Array
    gsd: float
    crs: str

    @classmethod
    def over(
        cls,
        camera: Camera,
        placed: PlacedPose,
        levels_m: tuple[float, float],
        crs: str | None = None,
        gsd: float | None = None,
        area: tuple[float, float, float, float] | None = None,
    ) -> "MapGrid":
        """Build a grid over a camera's footprint between two heights, or over an area; see `rectify`."""
        own = placed.crs if crs is None else crs
        if area is None:
            area = footprint(camera, placed, levels_m, own)
        most = _MAX_CELLS
        if gsd is None:
            most = min(most, MAX_CELLS_PER_PIXEL * camera.rows * camera.columns)
            if crs is not None and CRS.from_user_input(own).is_geographic:
                raise ValueError(f"`gsd` must be given in degrees for a geographic CRS; got none for {crs}.")
            # side of a square as large as the middle pixel's share of the ground, to two digits
            row, column = camera.principal_point
            corners = np.array([[row, column], [row + 1, column], [row, column + 1]])
            level_m = min(sum(levels_m) / 2, placed.pose.up_m - 1)
            a, b, c = ground_points(camera, placed.pose, corners, level_m)
            side = math.sqrt(float(np.linalg.norm(np.cross(b - a, c - a))))
            gsd = float(f"{side / CRS.from_user_input(own).linear_units_factor[1]:.2g}")
        if not 0 < gsd <= MAX_CELL_M:
            raise ValueError(f"`gsd` must be positive and at most {MAX_CELL_M:g}; got {gsd:g}.")
        check_area(area)
        west, south, east, north = (f(v / gsd) * gsd for f, v in zip(_OUTWARD, area, strict=True))
        if not (west < east and south < north):
            raise ValueError(f"`area` must be west south east north and not empty; got {area}.")
        if (east - west) / gsd * (north - south) / gsd > most:
            raise ValueError(
                f"`gsd` must be larger, or `area` smaller, for at most {most:,.0f} cells; got "
                f"{(east - west) / gsd:,.0f} × {(north - south) / gsd:,.0f} cells of {gsd:g}."
            )
        columns, rows = max(round((east - west) / gsd), 2), max(round((north - south) / gsd), 2)
        x, y = west + gsd * (np.arange(columns) + 0.5), north - gsd * (np.arange(rows) + 0.5)
        return cls(x, y, gsd, own)

    def shift(self, rows: float, columns: float) -> "MapGrid":
        """Shift the grid by a number of cells."""
        return MapGrid(self.x + columns * self.gsd, self.y - rows * self.gsd, self.gsd, self.crs)

    def places(self, placed: PlacedPose) -> tuple[Array, Array]:
        """East and north of every cell from the pose's origin. [m]"""
        east, north = transform_axes(self.x, self.y, self.crs, placed.crs)
        return east - placed.origin_m[0], north - placed.origin_m[1]


def check_area(area: tuple[float, float, float, float]) -> None:
    """Refuse an area that is not on Earth."""
    if not all(abs(v) <= MAX_COORDINATE_M for v in area):
        raise ValueError(
            f"`area` must lie within ±{MAX_COORDINATE_M:g}; got {' '.join(f'{v:g}' for v in area)}."
        )


def frame_border(camera: Camera) -> Array:
    """Pixels' outer corners and edges, every one on the border of the frame."""
    rows = np.linspace(-0.5, camera.rows - 0.5, 33)
    columns = np.linspace(-0.5, camera.columns - 0.5, 33)
    edges = [np.stack(np.broadcast_arrays(r, columns), -1) for r in (rows[0], rows[-1])]
    edges += [np.stack(np.broadcast_arrays(rows, c), -1) for c in (columns[0], columns[-1])]
    return np.concatenate(edges)


def footprint(camera: Camera, placed: PlacedPose, levels: tuple[float, float], crs: str) -> Extent:
    """Bounds, in a CRS, of the frame's footprint between two heights, as far as they are below the lens."""
    heights = [min(h, placed.pose.up_m - 1) for h in levels]
    border = np.concatenate([ground_points(camera, placed.pose, frame_border(camera), h) for h in heights])
    east, north = border[:, 0] + placed.origin_m[0], border[:, 1] + placed.origin_m[1]
    places = np.stack(transform_places(east, north, placed.crs, crs), axis=-1)
    return Extent(*places.min(axis=0).tolist(), *places.max(axis=0).tolist())


_MAX_SURFACE_CELLS = 100e6


def heights_under(path: Path, option: str, grid: MapGrid, placed: PlacedPose) -> Array:
    """Heights of a raster at the cells of a photograph's grid, NaN where it has none."""
    corners = np.meshgrid(np.linspace(grid.x[0], grid.x[-1], 33), np.linspace(grid.y[0], grid.y[-1], 33))
    try:
        heights = read_heights(path, option, corners[0], corners[1], grid.crs)
    except NotReachedError as error:
        raise ValueError(f"{error}{hint_of_exchange(path, option, placed)}") from error
    return _at(heights, *transform_axes(grid.x, grid.y, grid.crs, heights.crs))


def hint_of_exchange(path: Path, option: str, placed: PlacedPose) -> str:
    """Remedy for a pose far from a raster, with a hint if easting and northing are exchanged."""
    east = placed.origin_m[0] + placed.pose.east_m
    north = placed.origin_m[1] + placed.pose.north_m
    if is_within(path, option, east, north, placed.crs):
        return ""
    if not is_within(path, option, north, east, placed.crs):
        return f" The pose is at {east:.9g} m east, {north:.9g} m north in its own CRS."
    return (
        f" Are they exchanged? With easting_m = {north:.9g} and northing_m = {east:.9g} the pose is over "
        f"{path.name}."
    )


def _at(heights: Heights, x: Array, y: Array) -> Array:
    column, row = transform_points(heights.to_pixel, x, y)
    return heights_at(heights.values, row, column)


def displacement_against(bands: Array, path: Path, grid: MapGrid) -> tuple[float, float]:
    """Displacement of a rectified image against a reference raster. [cell]"""
    reference = np.full(bands.shape[:2], np.nan)
    source = read_raster(path, "register")
    if source.crs is None:
        raise ValueError(f"`register` must have a CRS; got none: {path.name}. Set it: gdal_edit.py -a_srs …")
    corner = from_origin(grid.x[0] - grid.gsd / 2, grid.y[0] + grid.gsd / 2, grid.gsd, grid.gsd)
    try:
        reproject(
            source.bands[0].astype(float), reference,
            src_transform=source.transform, src_crs=source.crs, src_nodata=np.nan,
            dst_transform=corner, dst_crs=grid.crs, dst_nodata=np.nan, resampling=Resampling.bilinear,
        )  # fmt: skip
    except RasterioError as error:
        raise ValueError(f"`register` must be a raster that GDAL projects; got {path}.") from error
    rows, columns, _ = displacement_between(bands[..., 0], reference)
    if not math.isfinite(rows):
        raise ValueError(
            "`register` must show the same ground as the frame; got no significant displacement "
            f"against {path.name}."
        )
    return rows, columns


def occlusion_by_raster(
    path: Path, grid: MapGrid, placed: PlacedPose, east: Array, north: Array, ground: Array
) -> Array:
    """Cells hidden by a surface model, which is first resampled to an even grid in metres."""
    pose = placed.pose
    east_m, north_m = np.append(east, pose.east_m), np.append(north, pose.north_m)
    west, south = east_m.min() + placed.origin_m[0], north_m.min() + placed.origin_m[1]
    seen = west, south, west + np.ptp(east_m), south + np.ptp(north_m)
    lowest, highest = read_height_range(path, "surface", seen, placed.crs)
    fall = max(pose.up_m - highest, 1.0)
    far = float(np.hypot(east - pose.east_m, north - pose.north_m).max())
    reach = (highest - min(lowest, float(np.nanmin(ground)))) * far / fall + 2 * grid.gsd
    toward = [min(max(v, a - reach), b + reach) for v, a, b in (
        (pose.east_m, east.min(), east.max()), (pose.north_m, north.min(), north.max()))]  # fmt: skip
    west, right = min(east.min(), toward[0]), max(east.max(), toward[0])
    south, top = min(north.min(), toward[1]), max(north.max(), toward[1])
    x0, y0, side = _pixel_near(path, placed, west, south)
    step = max(side, 0.05)
    west, south = west - (west - x0) % step, south - (south - y0) % step  # on the raster's own centres
    if (right - west) * (top - south) / step**2 > _MAX_SURFACE_CELLS:
        raise ValueError(f"`surface` must be coarser, or `area` smaller; got cells of {step:g} m.")
    x, y = np.arange(west, right + step, step), np.arange(south, top + step, step)[::-1]
    axes = x + placed.origin_m[0], y + placed.origin_m[1]
    heights = read_heights(path, "surface", *np.meshgrid(axes[0][[0, -1]], axes[1][[0, -1]]), placed.crs)
    values = _at(heights, *transform_axes(*axes, placed.crs, heights.crs))
    metres = {"units": "m"}
    model = xr.Dataset(
        {"height": (("y", "x"), np.where(np.isfinite(values), values, lowest), metres)},
        coords={"y": ("y", y, metres), "x": ("x", x, metres)},
    )
    return occlusion_mask(model, pose, east, north, ground)


def _pixel_near(path: Path, placed: PlacedPose, east: float, north: float) -> tuple[float, float, float]:
    """East and north of a pixel's centre near a place, from the pose's origin, and the pixel's side. [m]"""
    x, y = east + placed.origin_m[0] + np.array([0.0, 100.0]), north + placed.origin_m[1] + np.array([0.0])
    heights = read_heights(path, "surface", *np.meshgrid(x, y), placed.crs)
    column, row = transform_points(heights.to_pixel, *transform_axes(x, y, placed.crs, heights.crs))
    side = 100.0 / float(np.hypot(np.diff(column), np.diff(row))[0, 0])
    centre = transform_points(~heights.to_pixel, np.round(column[0, :1]), np.round(row[0, :1]))
    east_m, north_m = transform_places(*centre, heights.crs, placed.crs)
    return float(east_m[0]) - placed.origin_m[0], float(north_m[0]) - placed.origin_m[1], side
