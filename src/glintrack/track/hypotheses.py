"""Multi-hypothesis tracking: each target is a tree of its possible associations over the last scans.

In every scan each leaf of a tree branches into a miss and one branch for each gated detection. Over all trees
the least costly choice of leaves is searched in which no detection of the window belongs to two targets.
Leaves that do not descend from the choice's nodes at the start of the window are deleted (N-scan pruning).
The leaves are rows of `Targets`, predicted and updated by the same code as one-to-one association. A window
of one scan is one-to-one association.

References
----------
Reid, IEEE Trans. Automatic Control 24, 843 (1979); track-oriented trees and N-scan pruning: Blackman, IEEE
Aerospace and Electronic Systems Magazine 19, 5 (2004).
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from glintrack.core.arrays import Array
from glintrack.track import assignment, identity, update
from glintrack.track.initiation import Targets, concatenate, select

MAX_LEAVES = 8  # of a tree
_REACH_NAT = 15.0  # a leaf this much more costly than the best of its tree is deleted


@dataclass(frozen=True)
class Leaves:
    """Leaves of all trees: the hypotheses of every target.

    Parameters
    ----------
    targets
        One row per leaf; rows of one tree share their id and are contiguous.
    cost
        Cost of the associations that lead to each leaf, relative to its tree's best. [nat]
    used
        Detection of each leaf in the scans of the window, the latest first; −1 for a miss.
    lineage
        Node of each leaf in the scans of the window, the latest first.
    chosen
        Mask of one leaf per tree: together the best hypothesis.
    nodes
        Number of nodes so far.
    """

    targets: Targets
    cost: Float[Array, "leaf"]
    used: Int[Array, "leaf scan"]
    lineage: Int[Array, "leaf scan"]
    chosen: Bool[Array, "leaf"]
    nodes: int

    @property
    def tree(self) -> Int[Array, "leaf"]:
        """Number of the tree of each leaf, from 0."""
        return np.cumsum(np.r_[0, np.diff(self.targets.id) != 0][: len(self.targets.id)])


def advance_trees(
    state, seen, evidence: update.Evidence
) -> tuple[Leaves, Int[Array, "tree"], identity.Population]:
    """Advance the leaves by an epoch; parameters as in `update.advance_targets`.

    Returns
    -------
    The leaves, the detection of each best leaf (−1 for none), and the population of features.
    """
    costs = update.association_costs(state, seen, seen.predicted, seen.in_view, evidence)
    new, parent, detection = _branch(state.leaves, seen.predicted, costs, len(seen.found), state.frame)
    hit = np.flatnonzero(detection >= 0)
    choice = update.Choice(detection, hit, detection[hit], np.ones(len(hit)))
    assigned = detection[new.chosen]
    # spectra update the population once, from the best hypothesis
    population = update.update_features(state, select(new.targets, new.chosen), evidence, assigned)[2]
    rows, _ = update.update_targets(state, seen, new.targets, seen.in_view[parent], evidence, choice)
    # a tree is confirmed as soon as its best leaf is
    confirmed = (new.targets.confirmed | rows.confirmed)[new.chosen][new.tree]
    return replace(new, targets=replace(rows, confirmed=confirmed)), assigned, population


def _branch(
    leaves: Leaves, targets: Targets, costs: update.AssociationCosts, count: int, scan: int
) -> tuple[Leaves, Int[Array, "branch"], Int[Array, "branch"]]:
    """Branch all leaves and prune all but the best hypothesis; with the leaf before and detection of each."""
    # all children by tree, rising cost and detection (−1 for a miss), less those far more costly than the
    # best
    parent = np.r_[np.arange(len(leaves.cost)), costs.tracks]
    detection = np.r_[np.full(len(leaves.cost), -1), costs.partners]
    earned = -np.r_[costs.miss_cost, costs.cost + costs.feature_ratio]
    cost = np.r_[leaves.cost + costs.miss_cost, leaves.cost[costs.tracks] + costs.cost]
    tree, trees = leaves.tree[parent], np.arange(leaves.chosen.sum() + 1)
    order = np.lexsort((detection, cost, tree))
    tree = tree[order]
    least = cost[order][np.searchsorted(tree, trees[:-1])][tree]
    # a choice without conflict remains: the one-to-one assignment of the chosen leaves
    row, mine = np.cumsum(leaves.chosen) - 1, np.flatnonzero(leaves.chosen[costs.tracks])
    assigned = np.full(len(leaves.chosen), -2)
    assigned[leaves.chosen] = assignment.assign(
        row[costs.tracks[mine]], costs.partners[mine], costs.cost[mine], costs.miss_cost[leaves.chosen], count
    )
    safe = (detection == assigned[parent])[order]
    near = (cost[order] <= least + _REACH_NAT) | safe
    tree, order = tree[near], order[near]
    parent, detection, earned, cost = parent[order], detection[order], earned[order], cost[order]
    # the number of a detection is unique over all scans
    latest = np.where(detection >= 0, scan * 2**32 + detection, -1)
    used = np.column_stack([latest, leaves.used[parent, :-1]])
    node = leaves.nodes + np.arange(len(parent))
    lineage = np.column_stack([node, leaves.lineage[parent, :-1]])
    starts = np.searchsorted(tree, trees)
    best = select_hypothesis(starts, cost, used)
    # the best of each tree, and the first that share its root
    chosen = np.zeros(len(parent), bool)
    chosen[best] = True
    shares_root = lineage[:, -1] == lineage[best, -1][tree]
    keep = np.flatnonzero(chosen | (shares_root & (np.arange(len(tree)) - starts[tree] < MAX_LEAVES)))
    targets = select(targets, parent[keep])
    first = np.searchsorted(tree[keep], trees[:-1])
    new = Leaves(
        targets=replace(targets, score=np.maximum(targets.score + earned[keep], 0.0)),
        cost=cost[keep] - cost[keep][first][tree[keep]], used=used[keep], lineage=lineage[keep],
        chosen=chosen[keep], nodes=int(node[keep].max(initial=leaves.nodes)) + 1,
    )  # fmt: skip
    return new, parent[keep], detection[keep]


def select_hypothesis(
    starts: Int[Array, "tree_plus_1"], cost: Float[Array, "row"], used: Int[Array, "row scan"]
) -> Int[Array, "tree"]:
    """Select one row per tree at least total cost, with no detection in two of them.

    Parameters
    ----------
    starts
        Rows ``starts[t]`` to ``starts[t + 1]`` belong to tree t, by rising cost.
    cost
        Cost of each row. [nat]
    used
        Detections of each row, −1 for none.

    Notes
    -----
    An integer program (`scipy.optimize.milp`) over the trees that share detections, directly or through other
    trees, with two trees whose best rows conflict. The best rows of all other trees are chosen.
    """
    best, trees = np.asarray(starts[:-1]).copy(), len(starts) - 1
    items = np.full(used.shape, -1)
    code, items[used >= 0] = np.unique(used[used >= 0], return_inverse=True)
    row, scan = np.nonzero(items >= 0)
    item, tree = items[row, scan], np.repeat(np.arange(trees), np.diff(starts))
    counts = np.bincount(items[best][items[best] >= 0], minlength=len(code))
    if not (counts > 1).any():
        return best
    size = trees + len(code)
    graph = coo_array((np.ones(len(row)), (tree[row], trees + item)), shape=(size, size))
    part = connected_components(graph, directed=False)[1]
    open_ = np.isin(part[tree], part[trees:][counts > 1])
    rows, index = np.flatnonzero(open_), np.cumsum(open_) - 1
    inside = open_[row]
    uses = csr_array((np.ones(inside.sum()), (item[inside], index[row[inside]])), (len(code), len(rows)))
    group = np.unique(tree[rows], return_inverse=True)[1]
    of_tree = csr_array((np.ones(len(rows)), (group, np.arange(len(rows)))))
    found = milp(
        cost[rows], integrality=np.ones(len(rows)), bounds=Bounds(0, 1),
        constraints=[LinearConstraint(of_tree, 1, 1), LinearConstraint(uses, ub=1)],
        options={"mip_rel_gap": 0.0},
    )  # fmt: skip
    chosen = rows[found.x > 0.5]
    best[tree[chosen]] = chosen
    return best


def prune(leaves: Leaves, alive: Targets, new: Targets) -> Leaves:
    """Delete the trees whose best leaf is not alive, and add a tree of one leaf for each new target.

    An older tree may still use the detection of a new one. `initiation.prune` deletes the duplicate.

    Parameters
    ----------
    leaves
        From `advance_trees`.
    alive, new
        Best leaves that are alive, and new targets.
    """
    place = np.searchsorted(alive.id, leaves.targets.id)
    keep = np.append(alive.id, -1)[place] == leaves.targets.id
    window = leaves.used.shape[1]
    n = len(new)
    used, lineage = np.full((n, window), -1), np.full((n, window), -1)
    lineage[:] = (leaves.nodes + np.arange(n))[:, None]
    return Leaves(
        targets=concatenate(select(leaves.targets, keep), new), cost=np.r_[leaves.cost[keep], np.zeros(n)],
        used=np.concatenate([leaves.used[keep], used]),
        lineage=np.concatenate([leaves.lineage[keep], lineage]),
        chosen=np.r_[leaves.chosen[keep], np.ones(n, bool)], nodes=leaves.nodes + n,
    )  # fmt: skip


def rename_trees(leaves: Leaves, old: Int[Array, "tree"], new: Int[Array, "tree"]) -> Leaves:
    """Give the trees other ids, and sort the leaves by them.

    Parameters
    ----------
    leaves
        After `prune`.
    old, new
        Ids of all trees, the old ones rising.
    """
    ids = new[np.searchsorted(old, leaves.targets.id)]
    order = np.argsort(ids, kind="stable")
    return replace(
        leaves, targets=select(replace(leaves.targets, id=ids), order), cost=leaves.cost[order],
        used=leaves.used[order], lineage=leaves.lineage[order], chosen=leaves.chosen[order],
    )  # fmt: skip
