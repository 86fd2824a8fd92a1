"""Association by many hypotheses: each target a tree of what it may have been over the last scans.

Every scan each leaf of a tree branches into a miss and one branch for each gated detection. Of all trees
together the least costly choice of leaves is sought in which no detection of the window serves two targets;
what does not descend from the choice's nodes at the end of the window is cut off (N-scan pruning). The leaves
are rows of `Targets`, moved, priced and updated by the same code as one-to-one association; with a window of
one scan this is one-to-one association.

References
----------
Reid, IEEE Trans. Automatic Control 24, 843 (1979); track-oriented trees and N-scan pruning: Blackman, IEEE
Aerospace and Electronic Systems Magazine 19, 5 (2004).
"""

from dataclasses import dataclass, replace

import numba as nb
import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.track import associate, belief
from glintrack.track.targets import Targets, joined, no_targets, select

Array = np.ndarray
_REACH_NAT = 15.0  # a leaf this much dearer than the best of its tree will not come back
_MOST_NODES = 20_000  # of the search in one component; what is best so far then counts
_GAIN_NAT = 1e-9  # a difference this small is rounding


@dataclass(frozen=True)
class Leaves:
    """What every target may be.

    Parameters
    ----------
    targets
        A row a leaf; those of one tree share their id and lie together.
    cost
        Of the associations that lead to each leaf, relative to its tree's best. [nat]
    used
        Detection of each leaf in the scans of the window, the latest first; −1 for a miss.
    lineage
        Node of each leaf in the scans of the window, the latest first.
    chosen
        One leaf a tree: together the best hypothesis.
    nodes
        How many nodes there have been.
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


def no_leaves(design) -> Leaves:
    """Nothing known."""
    window = np.empty((0, design.mht_scans), np.int64)
    return Leaves(no_targets(design), np.empty(0), window, window, np.empty(0, bool), 0)


def all_of(leaves: Leaves, best: Targets) -> Targets:
    """The targets of all leaves, with what is remembered of each tree whatever its leaf."""
    tree = np.searchsorted(best.id, leaves.targets.id)
    return replace(leaves.targets, waited=best.waited[tree])


def advanced(state, motion, targets, seen, found, density, told, interval_s):
    """Leaves after an epoch, the detection of each best one, and the populations of features.

    Parameters
    ----------
    state, motion, targets, seen, found, density, told, interval_s
        As of `belief.advanced`; the targets are those of all leaves, predicted.
    """
    design, leaves = state.design, state.leaves
    prices = belief.priced(state, motion, targets, seen, found, density, told)
    new = branch(leaves, prices, len(found), state.frame, design.mht_branches)
    hit = np.flatnonzero(new.detection >= 0)
    rows = select(targets, new.parent)
    rows = replace(rows, score=np.maximum(rows.score + new.earned, 0.0))
    choice = belief.Choice(new.detection, hit, new.detection[hit], np.ones(len(hit)))
    # spectra are learnt once, from the best hypothesis
    best, whose = select(rows, new.chosen), new.detection[new.chosen]
    population, polarized = belief.remembered(state, best, told, whose)[2], state.polarized
    rows, _ = belief.updated(state, rows, motion, seen[new.parent], found, told, choice, interval_s)
    if design.feature_polarization:
        rows, _ = belief.polarized(rows, polarized, told.polarized, new.detection)
        _, polarized = belief.polarized(best, polarized, told.polarized, whose)
    return grown(leaves, new, rows), whose, (population, polarized)


@dataclass(frozen=True)
class Branches:
    """The children of all leaves that are worth keeping, by tree and rising cost.

    Parameters
    ----------
    parent, detection
        Leaf and detection, −1 for a miss.
    earned, cost
        Score for the last association, and cost from the root of the window. [nat]
    used, lineage, chosen
        As of `Leaves`.
    """

    parent: Int[Array, "branch"]
    detection: Int[Array, "branch"]
    earned: Float[Array, "branch"]
    cost: Float[Array, "branch"]
    used: Int[Array, "branch scan"]
    lineage: Int[Array, "branch scan"]
    chosen: Bool[Array, "branch"]


def branch(leaves: Leaves, prices: belief.Prices, count: int, scan: int, most: int) -> Branches:
    """Children of all leaves, the best hypothesis among them, and only what descends from it.

    Parameters
    ----------
    leaves
        Before the scan.
    prices, count
        Of leaves and their gated detections, and the number of detections.
    scan
        Number of the scan.
    most
        Leaves kept of a tree.
    """
    pairs, partners, cost, miss_cost = prices.tracks, prices.partners, prices.cost, prices.miss_cost
    rows = len(miss_cost)
    tree = leaves.tree
    parent = np.r_[np.arange(rows), pairs]
    detection = np.r_[np.full(rows, -1), partners]
    earned = -np.r_[miss_cost, cost + prices.likeness]
    total = leaves.cost[parent] + np.r_[miss_cost, cost]
    safe = _one_to_one(leaves.chosen, parent, detection, pairs, partners, cost, miss_cost, count)

    order = np.lexsort((detection, total, tree[parent]))
    best = np.full(tree[-1] + 1 if rows else 0, np.inf)
    np.minimum.at(best, tree[parent], total)
    order = order[(total <= best[tree[parent]] + _REACH_NAT)[order] | safe[order]]
    parent, detection, earned, total, safe = (a[order] for a in (parent, detection, earned, total, safe))
    # a detection of this scan has a number that no other scan's has
    code = np.where(detection >= 0, scan * 2**32 + detection, -1)
    used = np.column_stack([code, leaves.used[parent, :-1]])
    lineage = np.column_stack([leaves.nodes + np.arange(len(parent)), leaves.lineage[parent, :-1]])

    starts = np.searchsorted(tree[parent], np.arange(len(best) + 1))
    chosen = np.zeros(len(parent), bool)
    chosen[best_rows(starts, total, used, np.flatnonzero(safe))] = True
    root = lineage[chosen, -1][tree[parent]]
    rank = np.arange(len(parent)) - starts[tree[parent]]
    keep = chosen | ((lineage[:, -1] == root) & (rank < most))
    return Branches(*(a[keep] for a in (parent, detection, earned, total, used, lineage, chosen)))


def _one_to_one(chosen, parent, detection, pairs, partners, cost, miss_cost, count) -> Bool[Array, "branch"]:
    """The children that one-to-one association of the best leaves alone would choose: a first hypothesis."""
    row = np.cumsum(chosen) - 1  # of each chosen leaf among them
    mine = chosen[pairs]
    assigned = np.full(len(chosen), -2)
    assigned[chosen] = associate.assign(
        row[pairs[mine]], partners[mine], cost[mine], miss_cost[chosen], count
    )
    return assigned[parent] == detection


def best_rows(
    starts: Int[Array, "tree_plus_1"],
    cost: Float[Array, "row"],
    used: Int[Array, "row scan"],
    first: Int[Array, "tree"],
) -> Int[Array, "tree"]:
    """One row a tree at least total cost, no detection in two of them.

    Parameters
    ----------
    starts
        Rows ``starts[t]`` to ``starts[t + 1]`` are those of tree t, by rising cost.
    cost
        Of each row. [nat]
    used
        Detections of each row, −1 for none.
    first
        A choice without conflict, to begin with.

    Notes
    -----
    Depth-first branch and bound on each component of trees that share detections; exact unless a component
    takes more nodes than there is patience for, and never worse than the choice given.
    """
    answer = np.asarray(first, np.int64).copy()
    row, scan = np.nonzero(used >= 0)
    if len(row) == 0:
        return answer
    _, item = np.unique(used[row, scan], return_inverse=True)
    items = np.full(used.shape, -1, np.int64)
    items[row, scan] = item
    tree_of_row = np.searchsorted(starts, np.arange(len(cost)), side="right") - 1
    trees, count = len(answer), int(item.max()) + 1
    part = associate.components(tree_of_row[row], item.astype(np.int64), trees, trees + count)
    group = np.arange(trees)  # a tree that never saw anything is alone
    group[tree_of_row[row]] = part
    order = np.argsort(group, kind="stable")
    ends = np.r_[0, np.flatnonzero(np.diff(group[order])) + 1, trees]
    _search_all(order, ends, np.asarray(starts, np.int64), cost, items, np.zeros(count, np.bool_), answer)
    return answer


@nb.njit(cache=True)
def _search_all(order, ends, starts, cost, items, taken, answer):
    for k in range(len(ends) - 1):
        _search(order[ends[k] : ends[k + 1]], starts, cost, items, taken, answer)


@nb.njit(cache=True)
def _search(trees, starts, cost, items, taken, answer):
    """Branch and bound over one component; writes its part of ``answer``, leaves ``taken`` as it was."""
    n = len(trees)
    regret = np.empty(n)
    for d in range(n):
        a, b = starts[trees[d]], starts[trees[d] + 1]
        regret[d] = cost[a + 1] - cost[a] if b > a + 1 else np.inf
    trees = trees[np.argsort(-regret, kind="mergesort")]  # what is sure first
    rest = np.zeros(n + 1)  # the least that the trees from d on can cost
    for d in range(n - 1, -1, -1):
        rest[d] = rest[d + 1] + cost[starts[trees[d]]]
    best = 0.0
    for d in range(n):
        best += cost[answer[trees[d]]]
    row, placed = np.empty(n, np.int64), np.zeros(n, np.bool_)
    spent = np.zeros(n + 1)
    depth = nodes = 0
    row[0] = starts[trees[0]] - 1
    while depth >= 0 and nodes < _MOST_NODES:
        nodes += 1
        if placed[depth]:
            _mark(items[row[depth]], taken, False)
            placed[depth] = False
        last, allowed = starts[trees[depth] + 1], best - _GAIN_NAT - spent[depth] - rest[depth + 1]
        r = row[depth] + 1
        while r < last and cost[r] < allowed and _clashes(items[r], taken):
            r += 1
        if r == last or cost[r] >= allowed:  # rows rise in cost: one too dear ends the tree
            depth -= 1
            continue
        row[depth] = r
        spent[depth + 1] = spent[depth] + cost[r]
        if depth == n - 1:
            best = spent[n]
            for d in range(n):
                answer[trees[d]] = row[d]
            continue
        _mark(items[r], taken, True)
        placed[depth] = True
        depth += 1
        row[depth] = starts[trees[depth]] - 1
    for d in range(n):
        if placed[d]:
            _mark(items[row[d]], taken, False)


@nb.njit(cache=True)
def _mark(items, taken, value):
    for item in items:
        if item >= 0:
            taken[item] = value


@nb.njit(cache=True)
def _clashes(items, taken):
    for item in items:
        if item >= 0 and taken[item]:
            return True
    return False


def grown(leaves: Leaves, branches: Branches, targets: Targets) -> Leaves:
    """The leaves after a scan; a tree is confirmed as soon as its best leaf is.

    Parameters
    ----------
    leaves, branches
        Before the scan, and what became of them.
    targets
        Of each branch, after its detection.
    """
    tree, best = leaves.tree[branches.parent], np.flatnonzero(branches.chosen)
    known = leaves.targets.confirmed[leaves.chosen] | targets.confirmed[best]
    least = np.full(len(best), np.inf)
    np.minimum.at(least, tree, branches.cost)
    return Leaves(
        replace(targets, confirmed=known[tree]),
        branches.cost - least[tree],
        branches.used,
        branches.lineage,
        branches.chosen,
        int(branches.lineage[:, 0].max(initial=leaves.nodes)) + 1,
    )


def settled(
    leaves: Leaves, alive: Targets, born: Targets, detection: Int[Array, "born"], scan: int
) -> Leaves:
    """Only the trees whose best leaf lives on, and a tree of one leaf for each newborn.

    Parameters
    ----------
    leaves
        From `grown`.
    alive, born
        Best leaves that live on, and newborn targets.
    detection
        That each newborn was born of.
    scan
        Number of the scan.
    """
    keep = np.isin(leaves.targets.id, alive.id)
    window = leaves.used.shape[1]
    n = len(born)
    used, lineage = np.full((n, window), -1), np.full((n, window), -1)
    used[:, 0] = scan * 2**32 + detection
    lineage[:] = (leaves.nodes + np.arange(n))[:, None]
    return Leaves(
        joined(select(leaves.targets, keep), born),
        np.r_[leaves.cost[keep], np.zeros(n)],
        np.concatenate([leaves.used[keep], used]),
        np.concatenate([leaves.lineage[keep], lineage]),
        np.r_[leaves.chosen[keep], np.ones(n, bool)],
        leaves.nodes + n,
    )
