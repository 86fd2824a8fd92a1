"""What `scripts/measure_shade_scores.py` counts."""

from types import SimpleNamespace

import numpy as np
import pytest
from scripts import measure_shade_scores as scores


def test_a_vehicle_stands_where_its_upward_faces_do():
    """Vehicle 3 has a lit roof and a dark side, 5 a roof half lit, 8 a dark one, 9 no upward face in view."""
    up, side = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]
    hits = SimpleNamespace(
        vehicle_id=np.array([3, 3, 5, 5, 8, 9, -1]),
        normal=np.array([up, side, up, up, up, side, up]),
        weight=np.ones(7),
        sun_visible=np.array([1.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1.0]),
    )
    lit = scores.lit_part(hits, np.array([3, 5, 8, 9]))
    np.testing.assert_array_equal(lit[:3], [1.0, 0.5, 0.0])
    assert np.isnan(lit[3])
    np.testing.assert_array_equal(scores.stand_of(lit), [0, 1, 2, -1])


def test_an_interval_is_that_of_blocks_of_frames():
    """Half of ten vehicles a frame are tracked: always the same number, or all in every other block."""
    even = np.tile([10, 5], (20, 1))
    assert scores.share(even) == (0.5, 0.0)
    uneven = np.repeat([[10, 10], [10, 0], [10, 10], [10, 0]], scores.BLOCK, axis=0)
    part, wrong = scores.share(uneven)
    assert part == 0.5
    assert wrong == pytest.approx(2 * 0.5 / np.sqrt(3))  # of four blocks, each off by a half
    assert np.isnan(scores.share(np.zeros((5, 2), int))[0])
