"""Groups of pairs that no pair joins."""

import numpy as np

from glintrack.metrics.joined import joined_groups


def test_pairs_that_share_ends_are_one_group():
    left, right = np.array([0, 3, 0, 1, 5, 3]), np.array([2, 0, 1, 2, 4, 0])
    groups = {tuple(group) for group in joined_groups(left, right)}
    assert groups == {(0, 2, 3), (1, 5), (4,)}
    assert joined_groups(np.zeros(0, int), np.zeros(0, int)) == []
