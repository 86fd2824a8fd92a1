"""The one name for a NumPy array in jaxtyping's shapes (``Float[Array, "y x stokes"]``), and equal times."""

import numpy as np
from jaxtyping import Bool, Float

Array = np.ndarray
_ROUNDING_S = 1e-6


def is_at_time(times_s: Float[Array, "row"], time_s: float) -> Bool[Array, "row"]:
    """Return True for the times that equal one time, but for rounding. [s]"""
    return np.abs(times_s - time_s) <= _ROUNDING_S
