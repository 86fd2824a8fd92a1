"""Height of the ground at a place: the one bilinear look-up of a terrain."""

import numpy as np
import xarray as xr
from jaxtyping import Float
from numpy.typing import ArrayLike

from glintrack.core.arrays import Array


def height_at(terrain: xr.Dataset, east: ArrayLike, north: ArrayLike) -> Float[Array, "..."]:
    """Height of the ground, bilinear; beyond the grid's edge that of the edge. [m]

    Parameters
    ----------
    terrain
        Schema ``terrain``: an even grid, y falling.
    east, north
        Broadcast against each other; NaN for no place. [m]

    Returns
    -------
    NaN where there is no place. [m]
    """
    x, y, height = (terrain.variables[name].values for name in ("x", "y", "height"))
    i, k, fu = _nodes(x, east)
    j, m, fv = _nodes(y, north)
    upper = (1 - fu) * height[j, i] + fu * height[j, k]
    lower = (1 - fu) * height[m, i] + fu * height[m, k]
    return (1 - fv) * upper + fv * lower


def _nodes(axis: Float[Array, "node"], place: ArrayLike) -> tuple[Array, Array, Array]:
    """The nodes before and behind each place, and its share of the way between them."""
    step = axis[1] - axis[0] if axis.size > 1 else 1.0
    at = np.clip((np.asarray(place, float) - axis[0]) / step, 0, axis.size - 1)
    before = np.minimum(np.nan_to_num(at).astype(int), max(axis.size - 2, 0))
    return before, np.minimum(before + 1, axis.size - 1), at - before
