"""Where blobs come from that are no vehicles: a clutter map, so that a track among them must prove more.

Edges that flicker by aliasing and trees that parallax moves give blobs in the same places frame after
frame; on an open street they are rare. The density of both is learnt from the blobs that no confirmed
track explains.
"""

import math

import numba as nb
import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.track.frame import Grid

Array = np.ndarray
CELL_M = 15.0  # a few blobs a cell where clutter is dense, yet smaller than a junction


def empty_map(grid: Grid, density_m2: float) -> Float[Array, "row column"]:
    """A map that expects the same density everywhere. [m⁻²]"""
    size = [math.ceil(n * grid.gsd_m / _cell_m(grid)) for n in grid.shape]
    return np.full(size, float(density_m2))


def density_at(
    clutter: Float[Array, "row column"], grid: Grid, position_m: Float[Array, "detection 2"], least: float
) -> Float[Array, "detection"]:
    """Density of clutter about each detection, averaged over 3 × 3 cells. [m⁻²]"""
    rows, columns = _cells(clutter, grid, position_m)
    return np.maximum(_about(clutter, rows, columns), least)


@nb.njit(cache=True)
def _about(clutter, rows, columns):
    """Mean over 3 × 3 cells; the edges repeat."""
    height, width = clutter.shape
    out = np.empty(len(rows))
    for k in range(len(rows)):
        total = 0.0
        for dy in (-1, 0, 1):
            y = min(max(rows[k] + dy, 0), height - 1)
            for dx in (-1, 0, 1):
                total += clutter[y, min(max(columns[k] + dx, 0), width - 1)]
        out[k] = total / 9.0
    return out


def learn(
    clutter: Float[Array, "row column"],
    grid: Grid,
    position_m: Float[Array, "detection 2"],
    explained: Bool[Array, "detection"],
    share: float,
) -> Float[Array, "row column"]:
    """The map after one more frame, which counts as ``share``."""
    count = np.zeros_like(clutter)
    np.add.at(count, _cells(clutter, grid, position_m[~explained]), 1.0)
    return clutter + share * (count / _cell_m(grid) ** 2 - clutter)


def _cell_m(grid: Grid) -> float:
    """Side of a cell, never finer than the grid. [m]"""
    return max(CELL_M, grid.gsd_m)


def _cells(
    clutter: Array, grid: Grid, position_m: Float[Array, "n 2"]
) -> tuple[Int[Array, "n"], Int[Array, "n"]]:
    cell = _cell_m(grid)
    rows = (grid.corner_m[1] + grid.gsd_m / 2 - position_m[:, 1]) // cell
    columns = (position_m[:, 0] - grid.corner_m[0] + grid.gsd_m / 2) // cell
    rows = np.clip(rows, 0, clutter.shape[0] - 1).astype(int)
    return rows, np.clip(columns, 0, clutter.shape[1] - 1).astype(int)
