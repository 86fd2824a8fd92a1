"""One-to-one choices: against all permutations, and groups against a walk over what is joined."""

from itertools import permutations

import numpy as np

from glintrack.metrics.assignment import assigned, joined_groups


def test_the_choice_costs_least():
    rng = np.random.default_rng(2)
    for _ in range(20):
        cost = rng.uniform(size=(4, 5))
        least = min(sum(cost[i, j] for i, j in enumerate(to)) for to in permutations(range(5), 4))
        np.testing.assert_allclose(cost[assigned(cost)].sum(), least)


def test_pairs_that_share_ends_are_one_group():
    left, right = np.array([0, 3, 0, 1, 5, 3]), np.array([2, 0, 1, 2, 4, 0])
    groups = {tuple(group) for group in joined_groups(left, right)}
    assert groups == {(0, 2, 3), (1, 5), (4,)}
    assert joined_groups(np.zeros(0, int), np.zeros(0, int)) == []
