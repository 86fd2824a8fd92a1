"""Calibration of a peak: log-likelihood ratio of a vehicle against clutter, and its place.

A logistic law in what the detector observes, by channel, with the prior of the calibration flights taken off;
how much oftener vehicles than clutter are strong enough to be told; and residuals of position. ``python
tools/calibrate_mosaic.py`` flies `quickstart` with seeds 11 and 12, each with two pitches and two frame
rates, fits all of it and writes it here.
"""

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array

# calibrated: an intercept, and a weight of each of `mosaic_peaks.FEATURES`
LAW = {
    "pan": (-23.56, 17.26, 0.50, -5.55, -5.09, -2.36, 12.34, -4.22),
    "dolp": (-34.18, 21.55, 1.15, -5.99, -9.66, 5.04, 6.89, -9.51),
    "all": (-20.00, 20.48, 0.77, -5.14, -10.75, -1.16, 11.65, -3.03),
}
TOLD = {"pan": 4.14, "dolp": 4.12, "all": 4.25}  # log ratio of being told: vehicle to clutter
HEIGHT_M = 0.11  # of what is seen of a vehicle, in the mean
SIGMA_M = 0.50  # of a position across the line of sight
SIGMA_HEIGHT_M = 1.27  # of that height
# end of what is calibrated
LARGEST = 8.0  # beyond it the calibration flights hold no clutter to count
LEAST_RATIO = 1.1  # of what is told: with fewer, tracks are lost; with more, false ones come


def ratio_of_told(channel: str, ratio: Float[Array, "peak"]) -> Float[Array, "peak"]:
    """The same among peaks beyond `LEAST_RATIO`, which are told: nearly all of the clutter is not. [nat]

    Bayes's rule asks for p(features, told | vehicle) over the density of the clutter that is told, which a
    tracker measures; so what telling alone says is taken off.

    Parameters
    ----------
    channel
        ``pan``, ``dolp`` or ``all``.
    ratio
        From `log_likelihood_ratio`. [nat]
    """
    return ratio - TOLD[channel]


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
