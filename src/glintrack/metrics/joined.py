"""Which pairs of tracks and vehicles have a say in each other's one-to-one choice."""

import numpy as np
from jaxtyping import Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from glintrack.core.arrays import Array


def joined_groups(left: Int[Array, "pair"], right: Int[Array, "pair"]) -> list[Int[Array, "member"]]:
    """Which pairs belong together: those that share an end, and those that share one with them.

    Parameters
    ----------
    left, right
        What each pair joins, numbered from 0 on either side.

    Returns
    -------
    Numbers of each group's pairs, rising.
    """
    if not len(left):
        return []
    first = left.max() + 1
    ends = left, first + right
    graph = coo_array((np.ones(len(left), np.bool_), ends), shape=2 * (first + right.max() + 1,))
    group = connected_components(graph, directed=False)[1][left]
    order = np.argsort(group, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(group[order])) + 1)
