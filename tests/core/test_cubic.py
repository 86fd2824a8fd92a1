"""Keys' weights: at a pixel that pixel alone, exact for parabolas, the same seen from the other side."""

import numpy as np

from glintrack.core.interpolation import keys_weights

STEP = 4 * float(np.finfo(np.float32).eps)  # a few roundings of 32-bit floats
PLACES = np.linspace(0, 1, 33, dtype=np.float32)


def weights():
    return np.array([keys_weights(f) for f in PLACES], float)


def test_at_a_pixel_that_pixel_alone():
    np.testing.assert_array_equal(weights()[[0, -1]], [[0, 1, 0, 0], [0, 0, 1, 0]])


def test_parabolas_come_out_exactly():
    """Third order: second degree is met everywhere, and x³ missed by f(1 − f)(1 − 2f)."""
    pixels, places = np.arange(-1.0, 3.0), PLACES.astype(float)
    for degree in (0, 1, 2):
        np.testing.assert_allclose(weights() @ pixels**degree, places**degree, atol=10 * STEP)
    missed = places * (1 - places) * (1 - 2 * places)
    np.testing.assert_allclose(weights() @ pixels**3 - places**3, missed, atol=10 * STEP)


def test_mirrored_places_have_mirrored_weights():
    np.testing.assert_allclose(weights(), weights()[::-1, ::-1], atol=STEP)
