"""Which vehicles count: moving, in the window, visible. Written down only here (docs/conventions.md)."""

import numpy as np
import xarray as xr
from jaxtyping import Bool

from glintrack.core.arrays import Array
from glintrack.core.schema import MOVING_SPEED_M_S

MATCH_DISTANCE_M = 5.0
VISIBLE_FRACTION = 0.25

AreaM = tuple[float, float, float, float]


def is_moving(truth: xr.Dataset, least_m_s: float = MOVING_SPEED_M_S) -> Bool[Array, "vehicle"]:
    """Vehicles at least this fast."""
    return np.hypot(truth["east_speed"].values, truth["north_speed"].values) >= least_m_s


def is_in_window(truth: xr.Dataset, area_m: AreaM) -> Bool[Array, "vehicle"]:
    """Vehicles whose centre lies in (west, south, east, north), its edges included."""
    west, south, east, north = area_m
    x, y = truth["east"].values, truth["north"].values
    return (x >= west) & (x <= east) & (y >= south) & (y <= north)


def is_visible(truth: xr.Dataset, least: float = VISIBLE_FRACTION) -> Bool[Array, "vehicle"]:
    """Vehicles of which the camera sees this part at least (`render.visible_fraction`).

    All of them if the truth does not say.
    """
    if "visible_fraction" not in truth:
        return np.ones(truth["east"].shape, np.bool_)
    return truth["visible_fraction"].values >= least


def window_km2(area_m: AreaM) -> float:
    """Area of the window. [km²]

    Raises
    ------
    ValueError
        If it is empty.
    """
    west, south, east, north = area_m
    if not (west < east and south < north):
        raise ValueError(f"`area_m` must be (west, south, east, north) and not empty, got {tuple(area_m)}")
    return 1e-6 * (east - west) * (north - south)
