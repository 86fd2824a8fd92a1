"""Clutter map: the local density of false detections, so that a track among them needs more evidence.

Edges that flicker by aliasing and trees that parallax moves are detected in the same places frame after
frame. On an open street such detections are rare. The density is measured from the detections that no
confirmed track explains.
"""

import math

import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.core.arrays import Array
from glintrack.track.detect.frame import Grid

CLUTTER_S = 5.0  # time constant of the map
CELL_M = 15.0  # a few detections a cell where clutter is dense, yet smaller than a junction


def map_of(state, grid: Grid) -> Float[Array, "row column"]:
    """Clutter map of a tracker's state; a uniform one before the first frame. [m⁻²]"""
    if state.clutter is not None:
        return state.clutter
    size = [math.ceil(n * grid.gsd_m / _cell_m(grid)) for n in grid.shape]
    return np.full(size, float(state.design.association.clutter_density_m2))


def density_at(
    clutter: Float[Array, "row column"], grid: Grid, position_m: Float[Array, "detection 2"], least: float
) -> Float[Array, "detection"]:
    """Clutter density around each detection, averaged over 3 × 3 cells; the edges repeat. [m⁻²]"""
    row, column = _cells_of(position_m, clutter, grid)
    padded, total = np.pad(clutter, 1, "edge"), np.zeros(len(position_m))
    for k in range(9):
        total += padded[row + k // 3, column + k % 3]
    return np.maximum(total / 9.0, least)


def update(
    clutter: Float[Array, "row column"],
    grid: Grid,
    position_m: Float[Array, "detection 2"],
    explained: Bool[Array, "detection"],
    share: float,
) -> Float[Array, "row column"]:
    """Update the map with one more frame, which counts as ``share``."""
    out = clutter - share * clutter
    np.add.at(out, _cells_of(position_m[~explained], clutter, grid), share / _cell_m(grid) ** 2)
    return out


def _cell_m(grid: Grid) -> float:
    """Side of a cell, at least a pixel of the grid. [m]"""
    return max(CELL_M, float(grid.gsd_m))


def _cells_of(
    position_m: Float[Array, "n 2"], clutter: Float[Array, "row column"], grid: Grid
) -> tuple[Int[Array, "n"], Int[Array, "n"]]:
    """Row and column of the cell of each position, limited to the map."""
    west_m, north_m = grid.corner_m[0] - grid.gsd_m / 2, grid.corner_m[1] + grid.gsd_m / 2
    row = np.clip((north_m - position_m[:, 1]) // _cell_m(grid), 0, clutter.shape[0] - 1)
    column = np.clip((position_m[:, 0] - west_m) // _cell_m(grid), 0, clutter.shape[1] - 1)
    return row.astype(int), column.astype(int)
