"""Occlusion masks of the ground: cells with a line to the lens that meets the surface model."""

import numba as nb
import numpy as np
import xarray as xr
from jaxtyping import Bool, Float

from glintrack.camera import Pose
from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.core.schema import check

CLEARANCE_M = 0.25  # surface models are no better than this


def occlusion_mask(
    surface: xr.Dataset,
    pose: Pose,
    east: Float[Array, "y x"],
    north: Float[Array, "y x"],
    height: Float[Array, "y x"],
    clearance_m: float = CLEARANCE_M,
) -> Bool[Array, "y x"]:
    """Mask of places behind, or under, the surface model.

    Parameters
    ----------
    surface
        Schema ``terrain``, its heights those of roofs and crowns; evenly spaced. [m]
    pose
        Pose of the camera.
    east, north, height
        The places: of the ground under the surface model, or on it. [m]
    clearance_m
        A surface above the line of sight by less hides nothing. [m]

    Returns
    -------
    True where hidden. Beyond the surface model nothing hides.

    Raises
    ------
    ValueError
        If the surface model is not evenly spaced.
    """
    values = check(surface, "terrain")["height"].values.astype(float)
    x, y = surface["x"].values.astype(float), surface["y"].values.astype(float)
    if min(len(x), len(y)) < 2:
        raise ValueError(f"`surface` must have two cells a side at least; got {len(y)} × {len(x)}.")
    step_x, step_y = x[1] - x[0], y[0] - y[1]
    if not (np.allclose(np.diff(x), step_x, rtol=1e-3) and np.allclose(-np.diff(y), step_y, rtol=1e-3)):
        raise ValueError("`surface` must be evenly spaced, x rising and y falling; got other coordinates.")
    shape = np.broadcast_shapes(np.shape(east), np.shape(north), np.shape(height))
    east, north, height = (np.broadcast_to(a, shape) for a in (east, north, height))
    out = np.zeros(height.shape, np.bool_)
    frame, highest = np.array([x[0], y[0], step_x, step_y]), float(values.max())
    ground = east, north, height
    over_rows(_march, len(out), values, frame, pose.position, *ground, clearance_m, highest, out)
    return out


@nb.njit(nogil=True, cache=True)
def _march(start, stop, values, frame, lens, east, north, height, clearance, highest, out):
    """From each place toward the lens in half cells, until the line is above everything there is."""
    step = 0.5 * min(frame[2], frame[3])
    for i in range(start, stop):
        for j in range(out.shape[1]):
            px, py, pz = east[i, j], north[i, j], height[i, j]
            if not np.isfinite(pz):
                continue
            dx, dy, dz = lens[0] - px, lens[1] - py, lens[2] - pz
            if dz <= 0:  # ground above the aircraft is not looked at from above
                out[i, j] = True
                continue
            across = np.sqrt(dx * dx + dy * dy)
            level = (highest - clearance - pz) / dz  # share of the way after which nothing is higher
            count = int(min(level, 1.0) * across / step) + 1 if level > 0 else 0
            share = step / across if across > 0 else 1.0
            for k in range(count):
                t = k * share
                if t > 1.0:
                    break
                s = _surface(values, frame, px + t * dx, py + t * dy)
                if s > pz + t * dz + clearance:
                    out[i, j] = True
                    break


@nb.njit(cache=True)
def _surface(values, frame, x, y):
    c, r = (x - frame[0]) / frame[2], (frame[1] - y) / frame[3]
    rows, columns = values.shape
    if not (0.0 <= r <= rows - 1.0 and 0.0 <= c <= columns - 1.0):
        return -np.inf
    i, j = min(int(r), rows - 2), min(int(c), columns - 2)
    fr, fc = r - i, c - j
    upper = (1 - fc) * values[i, j] + fc * values[i, j + 1]
    lower = (1 - fc) * values[i + 1, j] + fc * values[i + 1, j + 1]
    return (1 - fr) * upper + fr * lower
