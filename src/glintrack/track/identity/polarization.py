"""Evidence of identity in the polarization about a detection, and how long it lasts.

The features are Q/I and U/I in the meridian frame. They hold DoLP as their length and the angle of
polarization as half their direction, and unlike that angle they have no jump and no meaning lost at DoLP 0.
A vehicle that turns, and an aircraft that flies round it, change them: a track's mean forgets.
"""

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.track.detect.frame import Grid

MOST_OBSERVATIONS = 6.0  # the mean is that of about the last six observations


def of_detections(
    image: xr.Dataset, grid: Grid, position_m: Float[Array, "detection 2"]
) -> Float[Array, "detection 2"]:
    """Q/I and U/I over 3 × 3 pixels about each detection; NaN where there is no light. [1]

    Parameters
    ----------
    image
        Dataset of the schema ``image``.
    grid
        Of the image.
    position_m
        East and north. [m]
    """
    stokes = image["stokes_radiance"]
    axis = [str(name) for name in stokes["stokes"].values]
    planes = stokes.values[..., [axis.index(name) for name in "IQU"]]
    rows, columns = grid.pixel_of(position_m)
    total = np.zeros((len(position_m), 3))
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            y = np.clip(rows + dy, 0, grid.shape[0] - 1)
            x = np.clip(columns + dx, 0, grid.shape[1] - 1)
            total += np.nan_to_num(planes[y, x])
    lit = total[:, 0] > 0
    out = np.full((len(total), 2), np.nan)
    out[lit] = total[lit, 1:] / total[lit, :1]
    return out


def remember(
    mean: Float[Array, "target 2"], observations: Float[Array, "target"], new: Float[Array, "target 2"]
) -> tuple[Float[Array, "target 2"], Float[Array, "target"]]:
    """Mean and count after one more observation; NaN is none."""
    known = np.asarray(np.isfinite(new).all(axis=1))
    count = np.where(known, np.minimum(observations + 1, MOST_OBSERVATIONS), observations)
    step = np.where(known[:, None], new - mean, 0.0) / np.maximum(count, 1)[:, None]
    return mean + step, count
