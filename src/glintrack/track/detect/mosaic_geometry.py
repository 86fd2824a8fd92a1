"""Geometry of a mosaic's elements: ground points of all elements, and the element that sees a place.

Both ways are exact on a lattice of nodes, through the camera with its lens and the reported pose, and linear
between. Heights are the terrain's: what stands on it is seen displaced, and learnt as it is seen.
"""

import numba as nb
import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.camera import Camera, Pose, ground_points, project
from glintrack.core.arrays import Array
from glintrack.core.heights import height_at

NODE = 16  # elements or cells between nodes: perspective bends by less than a hundredth of an element between
_SETTLE = 4  # times that a node's height is looked up again where its ray meets the ground


def terrain_height(
    terrain: xr.Dataset | None, east: Float[Array, "*n"], north: Float[Array, "*n"]
) -> Float[Array, "*n"]:
    """Height of the ground, bilinear, held beyond the edges; nought without a terrain. [m]"""
    if terrain is None:
        return np.zeros(np.shape(east))
    return height_at(terrain, east, north)


def element_places(
    camera: Camera, pose: Pose, terrain: xr.Dataset | None, corner_m: tuple[float, float], cell_m: float
) -> tuple[Float[Array, "row column"], Float[Array, "row column"]]:
    """Ground point of every element, in cells of a map: columns east, rows south of its first cell's centre.

    Parameters
    ----------
    camera, pose
        Of the mosaic, in elements; the pose as reported.
    terrain
        Heights of the ground; level at 0 m without.
    corner_m, cell_m
        East and north of the first cell's centre, and the cells' size. [m]

    Returns
    -------
    x and y; NaN for elements that never see the ground. [cell]
    """
    rows, columns = (np.arange(0, n + NODE, NODE, dtype=float) for n in (camera.rows, camera.columns))
    pixels = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1)
    mean = 0.0 if terrain is None else float(np.mean(terrain["height"].values))
    height = np.full(pixels.shape[:2], mean)
    for _ in range(_SETTLE):
        points = ground_points(camera, pose, pixels, height)
        height = terrain_height(terrain, points[..., 0], points[..., 1])
    out = np.empty((2, camera.rows, camera.columns), np.float32)
    between_nodes((points[..., 0] - corner_m[0]) / cell_m, NODE, out[0])
    between_nodes((corner_m[1] - points[..., 1]) / cell_m, NODE, out[1])
    return out[0], out[1]


def seen_by(
    camera: Camera,
    pose: Pose,
    terrain: xr.Dataset | None,
    corner_m: tuple[float, float],
    cell_m: float,
    shape: tuple[int, int],
    moved_m: tuple[float, float] = (0.0, 0.0),
) -> tuple[Float[Array, "row column"], Float[Array, "row column"]]:
    """Element, row and column, that sees each cell of a ground grid.

    Parameters
    ----------
    camera, pose, terrain, corner_m, cell_m
        As in `element_places`, of the grid.
    shape
        Of the grid.
    moved_m
        East and north by which registration found the elements' places to lie farther than the pose says. [m]
    """
    i, j = (np.arange(0, n + NODE, NODE, dtype=float) for n in shape)
    east = corner_m[0] + cell_m * j[None] - moved_m[0] + 0 * i[:, None]
    north = corner_m[1] - cell_m * i[:, None] - moved_m[1] + 0 * j[None]
    points = np.stack([east, north, terrain_height(terrain, east, north)], axis=-1)
    element = project(camera, pose, points)
    out = np.empty((2, *shape), np.float32)
    for k in range(2):
        between_nodes(np.ascontiguousarray(element[..., k]), NODE, out[k])
    return out[0], out[1]


@nb.njit(cache=True, nogil=True)
def between_nodes(nodes, step, out):
    """Fill a raster from its nodes, every ``step`` pixels from the first, linear between."""
    upper = np.empty(nodes.shape[1])
    for i in range(out.shape[0]):
        a = i // step
        f = (i - a * step) / step
        for b in range(nodes.shape[1]):
            upper[b] = (1 - f) * nodes[a, b] + f * nodes[a + 1, b]
        for b in range(nodes.shape[1] - 1):
            rise = (upper[b + 1] - upper[b]) / step
            for g in range(min(step, out.shape[1] - b * step)):
                out[i, b * step + g] = upper[b] + g * rise
