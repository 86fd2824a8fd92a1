"""What a peak's strength says: log-likelihood ratio of a vehicle against clutter, from calibration flights.

A logistic law in what the detector observes, by channel, fitted to the peaks of the flights that
docs/tracking.md names (`quickstart` with seeds 11 and 12), with the prior of those flights taken off. What
stands still speaks against a vehicle: the law's strongest help against facades, kerbs and glints.
"""

import numpy as np
from jaxtyping import Float

from glintrack.arrays import Array

# intercept, and weights of support, strength now, and standing still
LAW = {
    "pan": (-4.16, 8.14, -0.59, -4.80),
    "dolp": (-5.49, 11.65, -1.31, -4.33),
    "all": (-4.26, 10.63, -1.29, -6.08),
}
STRONGEST = 6.0  # strength counts no further
LARGEST = 8.0  # beyond it the calibration flights hold no clutter to count


def log_likelihood_ratio(
    channel: str,
    support: Float[Array, "peak"],
    strength: Float[Array, "peak"],
    still: Float[Array, "peak"],
) -> Float[Array, "peak"]:
    """How much likelier peaks like these are of vehicles than of clutter. [nat]

    Parameters
    ----------
    channel
        ``pan``, ``dolp`` or ``all``.
    support, still
        Mean strength along the best straight motion, and at a standstill. [1]
    strength
        Of the peak itself, not capped. [1]
    """
    a, b, c, d = LAW[channel]
    return np.minimum(a + b * support + c * np.minimum(strength, STRONGEST) + d * still, LARGEST)
