"""One-to-one choices between tracks and vehicles, and which pairs have a say in each other's.

SciPy's optimization takes a twentieth of a second to load; no flight's first frame waits for it.
"""

import numpy as np
from jaxtyping import Float, Int

from glintrack.arrays import Array


def assigned(cost: Float[Array, "row column"]) -> tuple[Int[Array, "pair"], Int[Array, "pair"]]:
    """Rows and columns of the one-to-one choice of least total cost."""
    from scipy.optimize import linear_sum_assignment

    return linear_sum_assignment(cost)


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
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not len(left):
        return []
    first = left.max() + 1
    ends = left, first + right
    graph = coo_array((np.ones(len(left), np.bool_), ends), shape=2 * (first + right.max() + 1,))
    group = connected_components(graph, directed=False)[1][left]
    order = np.argsort(group, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(group[order])) + 1)
