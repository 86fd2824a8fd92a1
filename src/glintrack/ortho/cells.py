"""Places of a grid's cells as the kernels take them: small where the grid is even, whole arrays elsewhere."""

from dataclasses import dataclass

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.schema import check

_NOWHERE = np.zeros(0)
_LOOKED_AT = 16  # heights along each axis; they only say where rounding is least


@dataclass(frozen=True)
class Cells:
    """Where each cell of a grid lies.

    Parameters
    ----------
    east, north
        Arrays of two axes that broadcast to the grid. [m]
    height
        One height, one for each cell, or the nodes of a terrain; NaN gives no data. [m]
    node_row, node_column
        Place of each row and column of the grid among the terrain's nodes; empty without a terrain. [node]
    """

    east: Float[Array, "a b"]
    north: Float[Array, "c d"]
    height: Float[Array, "e f"]
    node_row: Float[Array, "y"]
    node_column: Float[Array, "x"]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid."""
        if self.node_row.size:
            return len(self.node_row), len(self.node_column)
        rows, columns = np.broadcast_shapes(self.east.shape, self.north.shape, self.height.shape)
        return rows, columns

    @property
    def level_m(self) -> float:
        """A height amid those of the cells. [m]"""
        steps = tuple(max(n // _LOOKED_AT, 1) for n in self.height.shape)
        heights = self.height[:: steps[0], :: steps[1]]
        heights = heights[np.isfinite(heights)]
        return float(0.5 * (heights.min() + heights.max())) if heights.size else 0.0

    def nearest_to(self, place: Float[Array, "3"]) -> Float[Array, "3"]:
        """A place among the cells, near another as far as corners allow; amid them if that is NaN. [m]"""
        found = [*place[:2], self.level_m]
        for axis, values in enumerate((self.east, self.north)):
            ends = sorted((float(values[0, 0]), float(values[-1, -1])))
            found[axis] = (
                min(max(found[axis], ends[0]), ends[1]) if np.isfinite(place).all() else sum(ends) / 2
            )
        return np.array(found, dtype=float)

    @classmethod
    def of(cls, east: Array, north: Array, height: Array) -> "Cells":
        """Cells by arrays, or numbers, that broadcast to two axes; what only repeats is kept once."""
        shape = np.broadcast_shapes((1, 1), np.shape(east), np.shape(north), np.shape(height))
        east, north, height = (
            np.broadcast_to(np.asarray(a, dtype=float), shape) for a in (east, north, height)
        )
        if east.strides[0] == 0 and north.strides[1] == 0:
            east, north = east[:1].copy(), north[:, :1].copy()
        height = height[:1, :1].copy() if height.strides == (0, 0) else np.ascontiguousarray(height)
        return cls(np.ascontiguousarray(east), np.ascontiguousarray(north), height, _NOWHERE, _NOWHERE)

    @classmethod
    def over(cls, terrain: xr.Dataset, x: Float[Array, "x"], y: Float[Array, "y"]) -> "Cells":
        """An even grid over a dataset of schema ``terrain``: bilinear heights, held beyond its edges."""
        nodes = check(terrain, "terrain")["height"].values.astype(float)
        if np.ptp(nodes) == 0:
            return cls.of(x[None], y[:, None], nodes[0, 0])
        across, down = (terrain[n].values.astype(float) for n in ("x", "y"))
        column = np.interp(x, across, np.arange(len(across)))
        row = np.interp(-y, -down, np.arange(len(down)))
        nodes = np.pad(nodes, [(0, 2 - min(n, 2)) for n in nodes.shape], mode="edge")
        return cls(x[None].copy(), y[:, None].copy(), nodes, row, column)
