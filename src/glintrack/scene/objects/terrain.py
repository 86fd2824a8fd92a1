"""Height of the ground: level, rolling hills, or from a raster; and its slope."""

import math
from pathlib import Path

import numpy as np
import pyproj
import rasterio.transform
import xarray as xr
from jaxtyping import Float
from rasterio.warp import Resampling, reproject

from glintrack.core import schema
from glintrack.core.arrays import Array
from glintrack.core.interpolation import height_at
from glintrack.io.heights import NotReachedError, read_heights
from glintrack.io.untrusted import plain
from glintrack.scene.objects.geometry import Patch

STEP_M = 10.0
_REACH_M = 3000.0  # of the plane beyond the terrain, for oblique frames
_SLOPE_SPAN_M = 1.5  # half a vehicle's wheelbase
_WAVES_M = (900.0, 420.0, 210.0)  # wavelengths of rolling ground


def flat_terrain(bounds_m: tuple[float, float, float, float]) -> xr.Dataset:
    """Height zero over west, south, east, north [m], as a Dataset of schema ``terrain``."""
    x, y = _grid(bounds_m)
    return _dataset(x, y, np.zeros((y.size, x.size)))


def rolling_terrain(
    bounds_m: tuple[float, float, float, float], relief_m: float, rng: np.random.Generator
) -> xr.Dataset:
    """Gentle hills of a relief [m] over west, south, east, north [m], as a Dataset of schema ``terrain``."""
    x, y = _grid(bounds_m)
    height = np.zeros((y.size, x.size))
    for wave_m in _WAVES_M:
        for _ in range(3):
            angle, phase = rng.uniform(0, 2 * math.pi, 2)
            along = math.cos(angle) * x[None, :] + math.sin(angle) * y[:, None]
            height += wave_m * np.sin(2 * math.pi * along / wave_m + phase)
    height *= relief_m / max(float(np.ptp(height)), 1e-9)
    return _dataset(x, y, height - _centre_height(x, y, height))


def read_dem(
    path: Path, bounds_m: tuple[float, float, float, float], crs: str, origin_m: tuple[float, float]
) -> tuple[xr.Dataset, float]:
    """Read the heights of a raster under a scene.

    Parameters
    ----------
    path
        Any raster that GDAL reads and that has a CRS; heights of its first band are converted to metres.
    bounds_m
        West, south, east, north in ENU that it must cover. [m]
    crs, origin_m
        The scene's projected CRS and the position of ENU (0, 0) in it. [m]

    Returns
    -------
    Dataset of schema ``terrain`` with height zero at ENU (0, 0), and that point's height in the raster. [m]

    Raises
    ------
    ValueError
        If the file is no raster, has no CRS, or does not cover the bounds.
    """
    x, y = _grid(bounds_m)
    height = np.full((y.size, x.size), np.nan)
    to_scene = rasterio.transform.from_origin(
        x[0] - STEP_M / 2 + origin_m[0], y[0] + STEP_M / 2 + origin_m[1], STEP_M, STEP_M
    )
    places = np.meshgrid(x + origin_m[0], y + origin_m[1])
    try:
        read = read_heights(path, "dem_file", *places, crs)
        reproject(
            read.values,
            height,
            src_transform=read.transform,
            src_crs=read.crs,
            src_nodata=np.nan,
            dst_transform=to_scene,
            dst_crs=pyproj.CRS.from_user_input(crs).to_wkt(),
            dst_nodata=np.nan,
            resampling=Resampling.bilinear,
        )
    except NotReachedError:
        pass  # reported below, with the bounds of the scene
    except ValueError:
        raise
    except Exception as error:  # errors of GDAL itself have no public class
        raise ValueError(
            f"`dem_file` must be a raster that GDAL reads and projects; got {path.name}: {plain(error, 200)}."
        ) from error
    missing = ~np.isfinite(height)
    if missing.any():
        raise ValueError(
            f"`dem_file` must cover the scene; got no height in {100 * missing.mean():.0f} % of "
            f"{x[0]:.0f} to {x[-1]:.0f} m east, {y[-1]:.0f} to {y[0]:.0f} m north of "
            f"({origin_m[0]:.0f}, {origin_m[1]:.0f}) in {crs}."
        )
    centre = _centre_height(x, y, height)
    return _dataset(x, y, height - centre), centre


def is_level(terrain: xr.Dataset) -> bool:
    """Return True if the ground has one height everywhere."""
    return bool(np.ptp(terrain["height"].values) == 0)


def slope_at(
    terrain: xr.Dataset, east: Float[Array, "point"], north: Float[Array, "point"]
) -> Float[Array, "point 2"]:
    """Rise of the ground to the east and to the north, over a wheelbase. [1]"""
    d = _SLOPE_SPAN_M
    eastward = height_at(terrain, east + d, north) - height_at(terrain, east - d, north)
    northward = height_at(terrain, east, north + d) - height_at(terrain, east, north - d)
    return np.stack([eastward, northward], axis=-1) / (2 * d)


def ground_surface(terrain: xr.Dataset, below_m: float) -> Patch:
    """Surface at a depth below the ground, level beyond its edge, facing up. [m]"""
    x = terrain["x"].values
    x = np.r_[x[0] - _REACH_M, x, x[-1] + _REACH_M]
    y = terrain["y"].values
    y = np.r_[y[0] + _REACH_M, y, y[-1] - _REACH_M]
    east, north = (g.ravel() for g in np.meshgrid(x, y))
    vertices = np.c_[east, north, height_at(terrain, east, north) - below_m]
    row, column = (g.ravel() for g in np.mgrid[: y.size - 1, : x.size - 1])
    a = row * x.size + column
    b, c, d = a + 1, a + x.size, a + x.size + 1
    return vertices, np.vstack([np.c_[a, c, b], np.c_[b, c, d]])


def _grid(bounds_m: tuple[float, float, float, float]) -> tuple[Array, Array]:
    west, south, east, north = bounds_m
    x = np.arange(west, east + 1, STEP_M)
    y = np.arange(north, south - 1, -STEP_M)
    if x[-1] < east:
        x = np.r_[x, x[-1] + STEP_M]
    if y[-1] > south:
        y = np.r_[y, y[-1] - STEP_M]
    return x, y


def _centre_height(x: Array, y: Array, height: Array) -> float:
    return float(height_at(_dataset(x, y, height), np.zeros(1), np.zeros(1))[0])


def _dataset(x: Array, y: Array, height: Array) -> xr.Dataset:
    terrain = xr.Dataset(
        {"height": (("y", "x"), height, {"units": "m"})},
        coords={"y": ("y", y, {"units": "m"}), "x": ("x", x, {"units": "m"})},
    )
    return schema.check(terrain, "terrain")
