"""Interpolation on regular grids: bilinear ground heights, and weights of cubic convolution."""

import numba as nb
import numpy as np
import xarray as xr
from jaxtyping import Float
from numpy.typing import ArrayLike

from glintrack.core.arrays import Array


def height_at(terrain: xr.Dataset, east: ArrayLike, north: ArrayLike) -> Float[Array, "..."]:
    """Height of the ground by bilinear interpolation; beyond the grid, that of its edge. [m]

    Parameters
    ----------
    terrain
        Schema ``terrain``: an even grid, y falling.
    east, north
        Positions, broadcast against each other; NaN gives NaN. [m]
    """
    x, y, height = (terrain.variables[name].values for name in ("x", "y", "height"))
    i, k, fu = _nodes(x, east)
    j, m, fv = _nodes(y, north)
    upper = (1 - fu) * height[j, i] + fu * height[j, k]
    lower = (1 - fu) * height[m, i] + fu * height[m, k]
    return (1 - fv) * upper + fv * lower


def _nodes(axis: Float[Array, "node"], place: ArrayLike) -> tuple[Array, Array, Array]:
    """Nodes before and behind each position, and its fraction of the way between them."""
    step = axis[1] - axis[0] if axis.size > 1 else 1.0
    at = np.clip((np.asarray(place, float) - axis[0]) / step, 0, axis.size - 1)
    before = np.minimum(np.nan_to_num(at).astype(int), max(axis.size - 2, 0))
    return before, np.minimum(before + 1, axis.size - 1), at - before


@nb.njit(nogil=True, cache=True, error_model="numpy", inline="always")
def keys_weights(f):
    """Weights of four pixels in a row for a position ``f`` (0 to 1) behind the second; 32-bit floats.

    Third order for smooth images: R. G. Keys, IEEE Trans. ASSP 29, 1153 (1981), Eq. (15), with a = −½.
    """
    half, one, two = np.float32(0.5), np.float32(1.0), np.float32(2.0)
    three, four, five = np.float32(3.0), np.float32(4.0), np.float32(5.0)
    w0 = half * f * (f * (two - f) - one)
    w1 = one + half * f * f * (three * f - five)
    w2 = half * f * (one + f * (four - three * f))
    w3 = half * f * f * (f - one)
    return w0, w1, w2, w3
