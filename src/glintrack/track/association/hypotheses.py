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

import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.core.arrays import Array
from glintrack.track.association import associate, update
from glintrack.track.association import hypothesis_kernels as kernels
from glintrack.track.initiation import Targets, joined, no_targets, select

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


def step(state, motion, targets, seen, found, density, evidence, interval_s):
    """Leaves after an epoch, the detection of each best one, and the populations of features.

    Parameters
    ----------
    state, motion, targets, seen, found, density, evidence, interval_s
        As of `update.advanced`; the targets are those of all leaves, predicted.
    """
    design, leaves = state.design, state.leaves
    costs = update.association_costs(state, motion, targets, seen, found, density, evidence)
    new = branch(leaves, costs, len(found), state.frame, design.association.branches)
    hit = np.flatnonzero(new.detection >= 0)
    rows = select(targets, new.parent)
    rows = replace(rows, score=np.maximum(rows.score + new.earned, 0.0))
    choice = update.Choice(new.detection, hit, new.detection[hit], np.ones(len(hit)))
    # spectra are learnt once, from the best hypothesis
    best, whose = select(rows, new.chosen), new.detection[new.chosen]
    population, polarized = update.update_features(state, best, evidence, whose)[2], state.polarized
    rows, _ = update.update_targets(
        state, rows, motion, seen[new.parent], found, evidence, choice, interval_s
    )
    if design.identity.polarization:
        rows, _ = update.update_polarization(rows, polarized, evidence.polarized, new.detection)
        _, polarized = update.update_polarization(best, polarized, evidence.polarized, whose)
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
    starts, parent, pair, total, safe = kernels.children(
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
    keep, chosen = kernels.descendants(starts, best, lineage[:, -1], most)
    return Branches(
        parent[keep], detection[keep], earned[keep], total[keep], used.take(keep, axis=0),
        lineage.take(keep, axis=0), chosen,
    )  # fmt: skip


def _one_to_one(
    chosen: Bool[Array, "leaf"], costs: update.AssociationCosts, count: int
) -> Int[Array, "leaf"]:
    """Detection of each chosen leaf by one-to-one association of those alone: a first hypothesis.

    −1 is a miss; −2 stands at leaves that are not chosen.
    """
    row = np.cumsum(chosen) - 1  # of each chosen leaf among them
    mine = np.flatnonzero(chosen[costs.tracks])
    assigned = np.full(len(chosen), -2)
    assigned[chosen] = associate.assign(
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
    items, count = kernels.numbered(used)
    if count == 0:
        return answer
    row, scan = np.nonzero(items >= 0)
    item, trees = items[row, scan], len(answer)
    tree_of_row = np.repeat(np.arange(trees), np.diff(starts))[row]
    part = associate.components(tree_of_row, item, trees, trees + count)
    group = np.arange(trees)  # a tree that never saw anything is alone
    group[tree_of_row] = part
    order, ends = associate.grouped(group, trees)
    kernels.search_all(order, ends, starts, cost, items, np.zeros(count, np.bool_), answer)
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
