"""Clutter map: the density of blobs that are no vehicles, so that a track among them must prove more.

Edges that flicker by aliasing and trees that parallax moves give blobs in the same places frame after
frame; on an open street they are rare. The density of both is learnt from the blobs that no confirmed
track explains.
"""

import math

import numba as nb
import numpy as np
from jaxtyping import Bool, Float

from glintrack.core.arrays import Array
from glintrack.track.detect.frame import Grid

CLUTTER_S = 5.0  # time constant of the map
CELL_M = 15.0  # a few blobs a cell where clutter is dense, yet smaller than a junction


def empty_map(grid: Grid, density_m2: float) -> Float[Array, "row column"]:
    """A map that expects the same density everywhere. [m⁻²]"""
    size = [math.ceil(n * grid.gsd_m / _cell_m(grid)) for n in grid.shape]
    return np.full(size, float(density_m2))


def map_of(state, grid: Grid) -> Float[Array, "row column"]:
    """The map that a tracker's state has learnt so far. [m⁻²]"""
    if state.clutter is None:
        return empty_map(grid, state.design.association.clutter_density_m2)
    return state.clutter


def density_at(
    clutter: Float[Array, "row column"], grid: Grid, position_m: Float[Array, "detection 2"], least: float
) -> Float[Array, "detection"]:
    """Density of clutter about each detection, averaged over 3 × 3 cells. [m⁻²]"""
    return _about(clutter, position_m, _corner_m(grid), _cell_m(grid), least)


@nb.njit(cache=True)
def _about(clutter, position, corner, cell, least):
    """Mean over 3 × 3 cells; the edges repeat."""
    height, width = clutter.shape
    out = np.empty(len(position))
    for k in range(len(position)):
        row, column = _cell_of(position[k], corner, cell, height, width)
        total = 0.0
        for dy in (-1, 0, 1):
            y = min(max(row + dy, 0), height - 1)
            for dx in (-1, 0, 1):
                total += clutter[y, min(max(column + dx, 0), width - 1)]
        out[k] = max(total / 9.0, least)
    return out


def update(
    clutter: Float[Array, "row column"],
    grid: Grid,
    position_m: Float[Array, "detection 2"],
    explained: Bool[Array, "detection"],
    share: float,
) -> Float[Array, "row column"]:
    """The map after one more frame, which counts as ``share``."""
    return _updated(clutter, position_m, explained, _corner_m(grid), _cell_m(grid), share)


@nb.njit(cache=True)
def _updated(clutter, position, explained, corner, cell, share):
    height, width = clutter.shape
    out = clutter - share * clutter
    for k in range(len(position)):
        if not explained[k]:
            row, column = _cell_of(position[k], corner, cell, height, width)
            out[row, column] += share / cell**2
    return out


def _cell_m(grid: Grid) -> float:
    """Side of a cell, never finer than the grid. [m]"""
    return max(CELL_M, float(grid.gsd_m))


def _corner_m(grid: Grid) -> tuple[float, float]:
    """North-western corner of the grid. [m]"""
    return float(grid.corner_m[0] - grid.gsd_m / 2), float(grid.corner_m[1] + grid.gsd_m / 2)


@nb.njit(cache=True)
def _cell_of(position, corner, cell, height, width):
    row, column = (corner[1] - position[1]) // cell, (position[0] - corner[0]) // cell
    return int(min(max(row, 0.0), height - 1.0)), int(min(max(column, 0.0), width - 1.0))
