"""Tracks as a Dataset of the schema `tracks`: what the tracker tells of one epoch."""

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int

from glintrack.core.arrays import Array


def told(
    time_s: float,
    ident: Int[Array, "track"],
    mean: Float[Array, "track 4"],
    covariance: Float[Array, "track 4 4"],
    coasted: Bool[Array, "track"],
) -> xr.Dataset:
    """Tracks of one epoch.

    Parameters
    ----------
    time_s
        Of the epoch. [s]
    ident
        Numbers of the tracks.
    mean, covariance
        Of ``[east, north, east speed, north speed]``. [m, m s⁻¹]
    coasted
        Whether each was not measured then.
    """
    columns = {
        "east": (mean[:, 0], "m"),
        "north": (mean[:, 1], "m"),
        "east_speed": (mean[:, 2], "m s-1"),
        "north_speed": (mean[:, 3], "m s-1"),
        "east_var": (covariance[:, 0, 0], "m2"),
        "north_var": (covariance[:, 1, 1], "m2"),
        "east_north_cov": (covariance[:, 0, 1], "m2"),
        "coasted": (np.asarray(coasted, float), "1"),
    }
    return xr.Dataset(
        {name: ("track", values.copy(), {"units": units}) for name, (values, units) in columns.items()},
        coords={"track": np.array(ident, np.int64)},
        attrs={"time_s": time_s},
    )
