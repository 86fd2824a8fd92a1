"""Association by many hypotheses: each target a tree of what it may have been over the last scans.

Every scan each leaf of a tree branches into a miss and one branch for each gated detection. Of all trees
together the least costly choice of leaves is sought in which no detection of the window serves two targets;
what does not descend from the choice's nodes at the end of the window is cut off (N-scan pruning). The leaves
are rows of `Targets`, predicted, weighed and updated by the same code as one-to-one association; with a
window of one scan this is one-to-one association.

References
----------
Reid, IEEE Trans. Automatic Control 24, 843 (1979); track-oriented trees and N-scan pruning: Blackman, IEEE
Aerospace and Electronic Systems Magazine 19, 5 (2004).
"""

from dataclasses import dataclass, replace

import numba as nb
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from glintrack.core.arrays import Array
from glintrack.track import assignment, identity, update
from glintrack.track.initiation import Targets, joined, no_targets, select

_MAX_NODES = 20_000  # of the search in one component; what is best so far then counts
_GAIN_NAT = 1e-9  # a difference this small is rounding
_REACH_NAT = 15.0  # a leaf this much dearer than the best of its tree will not come back


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
    window = np.empty((0, design.association.scans), np.int64)
    return Leaves(no_targets(design), np.empty(0), window, window, np.empty(0, bool), 0)


def all_of(leaves: Leaves, best: Targets) -> Targets:
    """The targets of all leaves, with what is remembered of each tree whatever its leaf."""
    tree = np.searchsorted(best.id, leaves.targets.id)
    return replace(leaves.targets, frames_since_query=best.frames_since_query[tree])


def advance_trees(
    state, seen, evidence: update.Evidence
) -> tuple[Leaves, Int[Array, "tree"], identity.Population]:
    """Leaves after an epoch, the detection of each best one, and the population of features.

    Parameters
    ----------
    state, seen, evidence
        As in `update.advance_targets`; the targets are those of all leaves, predicted.
    """
    design, leaves, targets = state.design, state.leaves, seen.predicted
    costs = update.association_costs(state, seen, targets, seen.in_view, evidence)
    new = branch(leaves, costs, len(seen.found), state.frame, design.association.branches)
    hit = np.flatnonzero(new.detection >= 0)
    rows = select(targets, new.parent)
    rows = replace(rows, score=np.maximum(rows.score + new.earned, 0.0))
    choice = update.Choice(new.detection, hit, new.detection[hit], np.ones(len(hit)))
    # spectra are learnt once, from the best hypothesis
    best, whose = select(rows, new.chosen), new.detection[new.chosen]
    population = update.update_features(state, best, evidence, whose)[2]
    rows, _ = update.update_targets(state, seen, rows, seen.in_view[new.parent], evidence, choice)
    return grown(leaves, new, rows), whose, population


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


def branch(leaves: Leaves, costs: update.AssociationCosts, count: int, scan: int, most: int) -> Branches:
    """Children of all leaves, the best hypothesis among them, and only what descends from it.

    Parameters
    ----------
    leaves
        Before the scan.
    costs, count
        Of leaves and their gated detections, and the number of detections.
    scan
        Number of the scan.
    most
        Leaves kept of a tree.
    """
    safe_of_leaf = _one_to_one(leaves.chosen, costs, count)
    starts, parent, pair, total, safe = _children(
        leaves.tree, leaves.cost, costs.tracks, costs.partners, costs.cost, costs.miss_cost, safe_of_leaf,
        _REACH_NAT,
    )  # fmt: skip
    missed = pair < 0
    detection = np.where(missed, -1, np.append(costs.partners, -1)[pair])
    earned = -np.where(
        missed, costs.miss_cost[parent], np.append(costs.cost + costs.feature_ratio, 0.0)[pair]
    )
    # a detection of this scan has a number that no other scan's has
    used = np.empty((len(parent), leaves.used.shape[1]), np.int64)
    used[:, 0] = np.where(detection >= 0, scan * 2**32 + detection, -1)
    used[:, 1:] = leaves.used[parent, :-1]
    lineage = np.empty_like(used)
    lineage[:, 0] = leaves.nodes + np.arange(len(parent))
    lineage[:, 1:] = leaves.lineage[parent, :-1]
    best = best_rows(starts, total, used, np.flatnonzero(safe))
    keep, chosen = _descendants(starts, best, lineage[:, -1], most)
    return Branches(
        parent=parent[keep],
        detection=detection[keep],
        earned=earned[keep],
        cost=total[keep],
        used=used.take(keep, axis=0),
        lineage=lineage.take(keep, axis=0),
        chosen=chosen,
    )


def _one_to_one(
    chosen: Bool[Array, "leaf"], costs: update.AssociationCosts, count: int
) -> Int[Array, "leaf"]:
    """Detection of each chosen leaf by one-to-one association of those alone: a first hypothesis.

    −1 is a miss; −2 stands at leaves that are not chosen.
    """
    row = np.cumsum(chosen) - 1  # of each chosen leaf among them
    mine = np.flatnonzero(chosen[costs.tracks])
    assigned = np.full(len(chosen), -2)
    assigned[chosen] = assignment.assign(
        row[costs.tracks[mine]], costs.partners[mine], costs.cost[mine], costs.miss_cost[chosen], count
    )
    return assigned


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
    starts, used = np.asarray(starts, np.int64), np.asarray(used, np.int64)
    items = np.full(used.shape, -1)
    code, items[used >= 0] = np.unique(used[used >= 0], return_inverse=True)
    if len(code) == 0:
        return answer
    row, scan = np.nonzero(items >= 0)
    trees = len(answer)
    tree = np.repeat(np.arange(trees), np.diff(starts))[row]
    edges = (np.ones(len(row)), (tree, trees + items[row, scan]))
    graph = coo_array(edges, shape=(trees + len(code), trees + len(code)))
    part = connected_components(graph, directed=False)[1][:trees]
    order = np.argsort(part, kind="stable")
    ends = np.flatnonzero(np.diff(part[order], prepend=-1, append=-2))
    _search_all(order, ends, starts, cost, items, np.zeros(len(code), np.bool_), answer)
    return answer


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
    first = np.searchsorted(tree, np.arange(len(best)))
    least = np.minimum.reduceat(branches.cost, first) if len(best) else np.empty(0)
    return Leaves(
        replace(targets, confirmed=known[tree]),
        branches.cost - least[tree],
        branches.used,
        branches.lineage,
        branches.chosen,
        int(branches.lineage[:, 0].max(initial=leaves.nodes)) + 1,
    )


def prune(leaves: Leaves, alive: Targets, born: Targets, detection: Int[Array, "born"], scan: int) -> Leaves:
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
    place = np.searchsorted(alive.id, leaves.targets.id)
    keep = np.append(alive.id, -1)[place] == leaves.targets.id
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


def renamed(leaves: Leaves, old: Int[Array, "tree"], new: Int[Array, "tree"]) -> Leaves:
    """The leaves with other ids of their trees, by rising id again.

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


@nb.njit(cache=True)
def _children(tree, leaf_cost, pairs, partners, cost, miss_cost, safe_of_leaf, reach):
    """Children of all leaves, by tree, rising cost and detection, less those far dearer than the tree's best.

    Parameters
    ----------
    tree, leaf_cost : (leaf,)
        Rising number, and cost so far. [nat]
    pairs, partners, cost : (pair,)
        Leaf, rising, and detection of each gated pair, and its cost. [nat]
    miss_cost, safe_of_leaf : (leaf,)
        Of a miss [nat], and the detection with which a leaf's child is safe: −1 its miss, −2 none.
    reach : float
        What is dearer than the best by more goes, but for the safe. [nat]

    Returns
    -------
    Where the children of each tree start; leaf and pair (−1 for a miss) of each, its whole cost, and whether
    it is safe.
    """
    leaves, room = len(tree), len(tree) + len(pairs)
    parent, chosen, detection = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room, np.int64)
    total, safe = np.empty(room), np.empty(room, np.bool_)
    trees = tree[leaves - 1] + 1 if leaves else 0
    starts = np.zeros(trees + 1, np.int64)
    n = leaf = following = 0
    while leaf < leaves:
        low, best, number = n, np.inf, tree[leaf]
        while leaf < leaves and tree[leaf] == number:
            pair, partner, whole = -1, -1, leaf_cost[leaf] + miss_cost[leaf]
            while True:
                best = min(best, whole)
                k = n
                while k > low and (
                    whole < total[k - 1] or (whole == total[k - 1] and partner < detection[k - 1])
                ):
                    parent[k], chosen[k], detection[k] = parent[k - 1], chosen[k - 1], detection[k - 1]
                    total[k], safe[k] = total[k - 1], safe[k - 1]
                    k -= 1
                parent[k], chosen[k], detection[k], total[k] = leaf, pair, partner, whole
                safe[k] = partner == safe_of_leaf[leaf]
                n += 1
                if following == len(pairs) or pairs[following] != leaf:
                    break
                pair, partner, whole = following, partners[following], leaf_cost[leaf] + cost[following]
                following += 1
            leaf += 1
        high, n = n, low
        for k in range(low, high):
            if total[k] <= best + reach or safe[k]:
                parent[n], chosen[n], total[n], safe[n] = parent[k], chosen[k], total[k], safe[k]
                n += 1
        starts[number + 1] = n
    return starts, parent[:n], chosen[:n], total[:n], safe[:n]


@nb.njit(cache=True)
def _descendants(starts, best, root, most):
    """Index of the children kept, each tree's best and the first that share its root, and which are best."""
    keep, chosen = np.empty(len(root), np.int64), np.zeros(len(root), np.bool_)
    n = 0
    for t in range(len(best)):
        for k in range(starts[t], starts[t + 1]):
            if k == best[t] or (root[k] == root[best[t]] and k - starts[t] < most):
                keep[n] = k
                chosen[n] = k == best[t]
                n += 1
    return keep[:n], chosen[:n]


@nb.njit(cache=True)
def _search_all(order, ends, starts, cost, items, taken, answer):
    """Search each component of trees, ``order[ends[k]]`` to ``order[ends[k + 1]]``, and write its answer."""
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
    while depth >= 0 and nodes < _MAX_NODES:
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
