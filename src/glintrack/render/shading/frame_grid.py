"""A coarse grid of directions of look over a frame, for what changes slowly from pixel to pixel."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.render.hits import Hits


class FrameGrid(NamedTuple):
    """Nodes at some elements of the frame, and where each row and column lies between them.

    Parameters
    ----------
    direction
        Unit direction of look at each node. [1]
    row_low, column_low
        Node before each row and column.
    row_part, column_part
        How far on toward the next node. [1]
    """

    direction: Float[Array, "node_row node_column 3"]
    row_low: Int[Array, "row"]
    row_part: Float[Array, "row"]
    column_low: Int[Array, "column"]
    column_part: Float[Array, "column"]

    def of_rows(self, rows: slice) -> "FrameGrid":
        """The same nodes for some rows of the frame."""
        return self._replace(row_low=self.row_low[rows], row_part=self.row_part[rows])


def frame_grid(hits: Hits, spacing_rad: float) -> FrameGrid:
    """Nodes at most ``spacing_rad`` apart along the middle row and column of a frame."""
    rows, columns = hits.rows, hits.columns
    look = hits.look.reshape(rows, columns, 3)
    at_rows = _nodes(look[:, columns // 2], spacing_rad)
    at_columns = _nodes(look[rows // 2], spacing_rad)
    return FrameGrid(
        np.ascontiguousarray(look[np.ix_(at_rows, at_columns)], dtype=np.float64),
        *_between(at_rows, rows),
        *_between(at_columns, columns),
    )


def _nodes(line: Float[Array, "element 3"], spacing_rad: float) -> Int[Array, "node"]:
    """Evenly spread elements of a line, both ends among them."""
    extent = float(np.arccos(np.clip(line[0].astype(float) @ line[-1], -1, 1)))
    count = min(max(int(np.ceil(extent / spacing_rad)) + 1, 2), len(line))
    return np.unique(np.rint(np.linspace(0, len(line) - 1, count)).astype(np.int64))


def _between(nodes: Array, count: int) -> tuple[Array, Array]:
    if len(nodes) == 1:
        return np.zeros(count, np.int64), np.zeros(count)
    line = np.arange(count)
    low = np.clip(np.searchsorted(nodes, line, side="right") - 1, 0, len(nodes) - 2)
    return low, (line - nodes[low]) / (nodes[low + 1] - nodes[low])
