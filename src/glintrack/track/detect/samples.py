"""Some of a frame's pixels: enough for a quantile, few enough to sort."""

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array

SAMPLES = 60_000


def some_of(image: Float[Array, "y x"], most: int) -> Float[Array, "pixel"]:
    """At most so many pixels, evenly over the image but not along its columns."""
    step = -(-image.size // most)
    while step > 1 and (image.shape[1] % step == 0 or image.shape[1] % step == step - 1):
        step += 1
    return image.reshape(-1)[::step]


def median(values: Float[Array, "n"]) -> float:
    """NumPy's median of numbers of which none is NaN, 0 of none at all, in a tenth of its time.

    To find NaN, NumPy asks for three places in order, for which it has no vectors.
    """
    if len(values) == 0:
        return 0.0
    upper = len(values) // 2
    ordered = np.partition(values, upper)
    lower = ordered[upper] if len(values) % 2 else ordered[:upper].max()
    return float(np.mean([lower, ordered[upper]], dtype=values.dtype))
