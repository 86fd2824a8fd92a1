"""Times that are equal but for rounding."""

import numpy as np

from glintrack.core.arrays import is_at_time


def test_frames_of_a_fast_camera_late_in_the_day_are_apart():
    times_s = 60000.0 + np.arange(5) / 30
    np.testing.assert_array_equal(is_at_time(times_s, 60000.0 + 2 / 30), np.arange(5) == 2)
