"""Calibration of a peak: log-likelihood ratio of a vehicle against clutter, and its place.

A logistic law in what the detector observes, by channel, with the prior of the calibration flights taken off;
and residuals of position in them. ``python scripts/calibrate_mosaic.py`` flies `quickstart` with seeds 11 and
12, fits all of it and writes it here.
"""

import numpy as np
from jaxtyping import Float

from glintrack.arrays import Array

# calibrated: an intercept, and a weight of each of `mosaic_peaks.FEATURES`
LAW = {
    "pan": (-8.33, 2.05, 8.07, 1.41, -5.97, 4.62),
    "dolp": (-9.42, 1.57, 11.21, 1.53, -6.68, 6.16),
    "all": (-8.26, 2.66, 9.06, 1.34, -7.23, 4.94),
}
HEIGHT_M = 0.29  # of what is seen of a vehicle, in the mean
SIGMA_M = 0.47  # of a position across the line of sight
SIGMA_HEIGHT_M = 1.34  # of that height
# end of what is calibrated
LARGEST = 8.0  # beyond it the calibration flights hold no clutter to count


def log_likelihood_ratio(channel: str, features: Float[Array, "peak feature"]) -> Float[Array, "peak"]:
    """How much likelier peaks like these are of vehicles than of clutter. [nat]

    Parameters
    ----------
    channel
        ``pan``, ``dolp`` or ``all``.
    features
        `mosaic_peaks.FEATURES` of each. [1]
    """
    intercept, *weights = LAW[channel]
    return np.minimum(intercept + features @ np.array(weights), LARGEST)
