"""Some of a frame's pixels."""

import numpy as np

from glintrack.track.detect.samples import median, some_of


def test_all_of_a_small_frame():
    frame = np.arange(12.0).reshape(3, 4)
    assert some_of(frame, 12).tolist() == frame.ravel().tolist()


def test_no_more_than_asked_and_from_every_part_of_the_frame():
    for shape in ((100, 200), (101, 130), (64, 64), (90, 91)):
        rows, columns = np.indices(shape)
        taken = some_of(rows * 1000 + columns, 500)
        assert 100 < len(taken) <= 500
        assert len(np.unique(taken % 1000)) > shape[1] // 4  # not the same few columns
        assert len(np.unique(taken // 1000)) > shape[0] // 2


def test_median_is_numpys():
    rng = np.random.default_rng(3)
    assert median(np.empty(0, np.float32)) == 0.0
    for count in (1, 2, 3, 10, 1001, 1002):
        for kind in (np.float32, np.float64):
            values = rng.gamma(0.5, 1.0, count).astype(kind)
            assert median(values) == float(np.median(values))
