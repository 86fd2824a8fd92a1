"""The table of what probes found."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.render.sky_patches import PATCHES

BOUNCE_UNIT = 2.0 / 32767  # of `ProbeTable.bounced`: irradiance over that of the light itself [1]


class ProbeTable(NamedTuple):
    """What probes found; `Hits.light_cell` points into ``cells``.

    Parameters
    ----------
    cells
        The four probes of each cell. Cells of points in space are eight each, the first at a multiple of
        eight, by which components of the normal are negative (1 x, 2 y, 4 z): z, x, y and y again.
    facing
        Node of the normal that each probe faces (`normals.node_normals`).
    patches
        Part of each patch of the sky that is open, 0 to 255.
    bounced
        Irradiance from what stands around, over that of its light, by light and class of material
        (`bounce`), in units of `BOUNCE_UNIT`; no columns where materials are not known.
    view
        Sky view factor; negative of a probe that stands in a building or under a car. [1]
    past_leaves
        Part that leaves leave of the light from an even sky past solids. [1]
    """

    cells: Int[Array, "cell 4"]
    facing: Int[Array, "probe"]
    patches: Int[Array, "probe patch"]
    bounced: Int[Array, "probe bounce"]
    view: Float[Array, "probe"]
    past_leaves: Float[Array, "probe"]


def empty_table(bounces: int, rows: int = 0) -> ProbeTable:
    """No cells yet, and rows that are not yet filled."""
    return ProbeTable(
        np.zeros((0, 4), np.int32),
        np.zeros(rows, np.int16),
        np.zeros((rows, PATCHES), np.uint8),
        np.zeros((rows, bounces), np.int16),
        np.zeros(rows, np.float32),
        np.zeros(rows, np.float32),
    )


def joined(first: ProbeTable, second: ProbeTable) -> ProbeTable:
    """Two tables in one; cells of the second already count probes from the end of the first."""
    return ProbeTable(*(np.concatenate(both) for both in zip(first, second, strict=True)))
