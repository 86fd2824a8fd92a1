"""The ground grid: places of its cells in any CRS, and the heights under them."""

import numpy as np
import xarray as xr
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.interpolate import RegularGridInterpolator

from glintrack.camera import Camera, Pose, rays
from glintrack.core.arrays import Array
from glintrack.core.interpolation import height_at
from glintrack.io.crs import any_crs, change_crs

_LATTICE = 32  # cells between places that are transformed exactly
_MAX_LATTICE_ERROR = 0.02  # of a cell; otherwise every place is transformed exactly
_DESCENTS = 4  # of a ray onto the terrain


def ground_grid(
    area_m: tuple[float, float, float, float], gsd_m: float
) -> tuple[Float[Array, "x"], Float[Array, "y"]]:
    """Centres of the grid's cells: rising eastings, falling northings. [m]"""
    west, south, east, north = area_m
    if not (gsd_m > 0 and east - west >= gsd_m and north - south >= gsd_m):
        raise ValueError(f"`area_m` must hold at least one cell of {gsd_m} m; got {area_m}.")
    columns, rows = round((east - west) / gsd_m), round((north - south) / gsd_m)
    return west + gsd_m * (np.arange(columns) + 0.5), north - gsd_m * (np.arange(rows) + 0.5)


def transform_axes(
    x: Float[Array, "x"], y: Float[Array, "y"], from_crs: str, to_crs: str
) -> tuple[Float[Array, "y x"], Float[Array, "y x"]]:
    """Places of a grid's cells in another CRS.

    Parameters
    ----------
    x, y
        Axes of the grid in its own CRS. [unit of from_crs]
    from_crs, to_crs
        Anything that PROJ understands; x is east or longitude in both.

    Returns
    -------
    x and y of every cell in the other CRS, exact on a lattice and linear between where that is correct to a
    fiftieth of a cell. [unit of to_crs]

    Raises
    ------
    ValueError
        If a CRS is unknown, or places lie beyond the other CRS.
    """
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    shape = (len(y), len(x))
    if any_crs(from_crs) == any_crs(to_crs):
        return np.broadcast_to(x[None], shape), np.broadcast_to(y[:, None], shape)

    def exact(columns: Array, rows: Array) -> Array:
        return np.stack(transform_places(*np.meshgrid(columns, rows), from_crs, to_crs))

    i, j = (np.unique(np.r_[np.arange(0, n, _LATTICE), n - 1]) for n in shape)
    coarse = exact(x[j], y[i])
    if min(len(i), len(j)) >= 2:
        middle = exact((x[j][1:] + x[j][:-1]) / 2, (y[i][1:] + y[i][:-1]) / 2)
        mean = (coarse[:, 1:, 1:] + coarse[:, 1:, :-1] + coarse[:, :-1, 1:] + coarse[:, :-1, :-1]) / 4
        steps = coarse[:, :2, :2]
        side = min(np.hypot(*(steps[:, 0, 1] - steps[:, 0, 0])), np.hypot(*(steps[:, 1, 0] - steps[:, 0, 0])))
        if np.abs(middle - mean).max() < _MAX_LATTICE_ERROR * side / _LATTICE:
            between = RegularGridInterpolator((i, j), np.moveaxis(coarse, 0, -1))
            places = between(tuple(np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij")))
            return places[..., 0], places[..., 1]
    east, north = exact(x, y)
    return east, north


def transform_places(
    x: Float[Array, "*place"], y: Float[Array, "*place"], from_crs: str, to_crs: str
) -> tuple[Float[Array, "*place"], Float[Array, "*place"]]:
    """Places in another CRS, each by itself; see `transform_axes`."""
    source, target = any_crs(from_crs), any_crs(to_crs)
    found = change_crs(source, target).transform(x, y)
    if not np.isfinite(found).all():
        raise ValueError(f"`crs` must hold the whole grid; got places of {source.name} beyond {target.name}.")
    return found


def on_ground(terrain: xr.Dataset, enu: Float[Array, "point axis"]) -> Float[Array, "point 3"]:
    """Set points on the ground, with constant heights outside the terrain. [m]

    Parameters
    ----------
    terrain
        Schema ``terrain``.
    enu
        East, north and perhaps up, which is replaced. [m]
    """
    return np.column_stack([enu[:, :2], height_at(terrain, enu[:, 0], enu[:, 1])])


def intersect_terrain(
    terrain: xr.Dataset, camera: Camera, pose: Pose, pixels: Float[Array, "... 2"] | None = None
) -> Float[Array, "... 3"]:
    """Intersect the rays through pixels with the terrain, as rectification does. [m]

    Each ray is intersected with the height of the ground below its previous point, starting at the level of
    the ENU origin.

    Parameters
    ----------
    terrain
        Schema ``terrain``.
    camera, pose
        The camera and its pose.
    pixels
        (row, column); the middles of all elements by default. [element]

    Returns
    -------
    (east, north, up); NaN for a ray that never comes down. [m]
    """
    direction = rays(camera, pose, pixels)
    height = np.zeros(direction.shape[:-1])
    for _ in range(_DESCENTS):
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = (height - pose.up_m) / direction[..., 2]
        reach[~(np.isfinite(reach) & (reach > 0))] = np.nan
        east, north = pose.east_m + reach * direction[..., 0], pose.north_m + reach * direction[..., 1]
        before, height = height, height_at(terrain, np.nan_to_num(east), np.nan_to_num(north))
        if np.array_equal(before, height):  # level ground
            break
    return np.stack([east, north, pose.up_m + reach * direction[..., 2]], axis=-1)


def heights_at(heights: Float[Array, "row column"], row: ArrayLike, column: ArrayLike) -> Float[Array, "y x"]:
    """Heights of a raster at places given in its own pixels, bilinear.

    Parameters
    ----------
    heights
        NaN where the raster has none, which makes all pixels that use it NaN. [m]
    row, column
        Centres at integers; constant up to half a pixel beyond the outermost centres. [pixel]

    Returns
    -------
    NaN outside the raster. [m]
    """
    row, column = np.broadcast_arrays(np.asarray(row, float), np.asarray(column, float))
    last_r, last_c = (n - 1.0 for n in heights.shape)
    values = np.asarray(heights, float)
    values = np.pad(values, [(0, 2 - min(n, 2)) for n in values.shape], mode="edge")
    inside = (row >= -0.5) & (row <= last_r + 0.5) & (column >= -0.5) & (column <= last_c + 0.5)
    r, c = (np.clip(np.nan_to_num(v), 0.0, last) for v, last in ((row, last_r), (column, last_c)))
    i, j = np.minimum(r.astype(int), values.shape[0] - 2), np.minimum(c.astype(int), values.shape[1] - 2)
    down, right, total = r - i, c - j, np.zeros(row.shape)
    for di, dj in ((0, 0), (0, 1), (1, 0), (1, 1)):
        weight = (down if di else 1 - down) * (right if dj else 1 - right)
        # a hole next to a place exactly on a pixel does not matter
        total = total + np.where(weight > 0, weight * values[i + di, j + dj], 0.0)
    return np.where(inside, total, np.nan)
