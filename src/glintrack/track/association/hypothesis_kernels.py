"""Kernels of many hypotheses: children of leaves, and the least costly choice of one a tree."""

import numba as nb
import numpy as np

_MOST_NODES = 20_000  # of the search in one component; what is best so far then counts
_GAIN_NAT = 1e-9  # a difference this small is rounding


@nb.njit(cache=True)
def children(tree, leaf_cost, pairs, partners, cost, miss_cost, safe_of_leaf, reach):
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
def descendants(starts, best, root, most):
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
def numbered(used):
    """Detections numbered from 0, −1 for none, and how many numbers there may be.

    A detection is given by the number of its scan in the upper 32 bits and its own in the lower.
    """
    first = last = -1
    for code in used.flat:
        if code >= 0:
            scan = code >> 32
            first = scan if first < 0 else min(first, scan)
            last = max(last, scan)
    items = np.full(used.shape, -1, np.int64)
    if last < 0:
        return items, 0
    size = np.zeros(last - first + 2, np.int64)
    for code in used.flat:
        if code >= 0:
            scan = (code >> 32) - first
            size[scan + 1] = max(size[scan + 1], (code & 0xFFFFFFFF) + 1)
    for scan in range(1, len(size)):
        size[scan] += size[scan - 1]
    for r in range(used.shape[0]):
        for c in range(used.shape[1]):
            if used[r, c] >= 0:
                items[r, c] = size[(used[r, c] >> 32) - first] + (used[r, c] & 0xFFFFFFFF)
    return items, size[len(size) - 1]


@nb.njit(cache=True)
def search_all(order, ends, starts, cost, items, taken, answer):
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
