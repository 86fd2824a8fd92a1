"""Windows of a vehicle's footprint: the greatest of neighbours is SciPy's."""

import numpy as np
from scipy.ndimage import maximum_filter

from glintrack.track.detect.footprint import greatest_around


def test_greatest_around_is_scipys():
    for shape in ((1, 1), (1, 7), (2, 2), (9, 14)):
        values = np.random.default_rng(5).normal(size=shape).astype(np.float32)
        before = values.copy()
        np.testing.assert_array_equal(greatest_around(values), maximum_filter(values, size=3))
        np.testing.assert_array_equal(values, before)
