"""Some of a frame's pixels: enough for a quantile, few enough to sort."""

from jaxtyping import Float

from glintrack.arrays import Array

SAMPLES = 60_000


def some_of(image: Float[Array, "y x"], most: int) -> Float[Array, "pixel"]:
    """At most so many pixels, evenly over the image but not along its columns."""
    step = -(-image.size // most)
    while step > 1 and (image.shape[1] % step == 0 or image.shape[1] % step == step - 1):
        step += 1
    return image.reshape(-1)[::step]
