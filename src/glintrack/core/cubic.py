"""Weights of cubic convolution: third order for smooth pictures.

R. G. Keys, IEEE Trans. ASSP 29, 1153 (1981), Eq. (15), with a = −½.
"""

import numba as nb
import numpy as np


@nb.njit(nogil=True, cache=True, error_model="numpy", inline="always")
def keys_weights(f):
    """Weights of four pixels in a row, the place ``f`` (0 to 1) behind the second of them; 32-bit floats."""
    half, one, two = np.float32(0.5), np.float32(1.0), np.float32(2.0)
    three, four, five = np.float32(3.0), np.float32(4.0), np.float32(5.0)
    w0 = half * f * (f * (two - f) - one)
    w1 = one + half * f * f * (three * f - five)
    w2 = half * f * (one + f * (four - three * f))
    w3 = half * f * f * (f - one)
    return w0, w1, w2, w3
