"""Which detection belongs to which track: gating by a sorted sweep, assignment by connected components."""

import numba as nb
import numpy as np
from jaxtyping import Float, Int

Array = np.ndarray


@nb.njit(cache=True)
def gate(mean, covariance, measured, measured_covariance, gate_distance2):
    """Pairs of track and detection near enough to belong together.

    Parameters
    ----------
    mean : (track, 4)
        Predicted states. [m, m s⁻¹]
    covariance : (track, 4, 4)
        Of the states.
    measured : (detection, 2)
        East and north. [m]
    measured_covariance : (detection, 2, 2)
        Of the positions. [m²]
    gate_distance2 : float
        Largest squared Mahalanobis distance. [1]

    Returns
    -------
    Track and detection index of each pair, and −ln N(measured; predicted) of its innovation. [nat]
    """
    n, m = len(mean), len(measured)
    order = np.argsort(measured[:, 0])
    widest = 0.0
    for j in range(m):
        widest = max(widest, measured_covariance[j, 0, 0])
    size = 8 * max(n, m) + 16
    tracks, detections = np.empty(size, np.int64), np.empty(size, np.int64)
    surprise = np.empty(size)
    count = 0
    for i in range(n):
        reach = np.sqrt(gate_distance2 * (covariance[i, 0, 0] + widest))
        low, high = 0, m
        while low < high:  # first detection not west of the gate
            middle = (low + high) // 2
            if measured[order[middle], 0] < mean[i, 0] - reach:
                low = middle + 1
            else:
                high = middle
        for q in range(low, m):
            j = order[q]
            dx = measured[j, 0] - mean[i, 0]
            if dx > reach:
                break
            dy = measured[j, 1] - mean[i, 1]
            s00 = covariance[i, 0, 0] + measured_covariance[j, 0, 0]
            s01 = covariance[i, 0, 1] + measured_covariance[j, 0, 1]
            s11 = covariance[i, 1, 1] + measured_covariance[j, 1, 1]
            determinant = s00 * s11 - s01 * s01
            distance2 = (dx * dx * s11 - 2 * dx * dy * s01 + dy * dy * s00) / determinant
            if distance2 > gate_distance2:
                continue
            if count == size:
                size *= 2
                tracks, detections, surprise = _grown(tracks), _grown(detections), _grown(surprise)
            tracks[count], detections[count] = i, j
            surprise[count] = 0.5 * distance2 + 0.5 * np.log(determinant) + np.log(2 * np.pi)
            count += 1
    return tracks[:count], detections[:count], surprise[:count]


@nb.njit(cache=True)
def _grown(values):
    out = np.empty(2 * len(values), values.dtype)
    out[: len(values)] = values
    return out


def assign(
    tracks: Int[Array, "pair"],
    detections: Int[Array, "pair"],
    cost: Float[Array, "pair"],
    miss_cost: Float[Array, "track"],
    detection_count: int,
) -> Int[Array, "track"]:
    """One-to-one assignment of least total cost, each track paying its miss cost if left alone.

    Parameters
    ----------
    tracks, detections, cost
        Possible pairs and what each costs; may be negative. [nat]
    miss_cost
        Of leaving each track without a detection. [nat]
    detection_count
        Number of detections.

    Returns
    -------
    Detection index of each track, −1 for none.

    Notes
    -----
    Components of the graph of pairs are solved apart: in traffic nearly all hold one or two tracks.
    """
    return _assign(
        np.asarray(tracks, np.int64),
        np.asarray(detections, np.int64),
        np.asarray(cost, np.float64),
        np.asarray(miss_cost, np.float64),
        int(detection_count),
    )


@nb.njit(cache=True)
def _assign(tracks, detections, cost, miss_cost, detection_count):
    n, pairs = len(miss_cost), len(cost)
    parent = np.arange(n + detection_count)
    for e in range(pairs):
        a, b = _root(parent, tracks[e]), _root(parent, n + detections[e])
        if a != b:
            parent[max(a, b)] = min(a, b)
    component = np.empty(pairs, np.int64)
    for e in range(pairs):
        component[e] = _root(parent, tracks[e])
    order = np.argsort(component, kind="mergesort")
    local = np.full(n + detection_count, -1, np.int64)
    answer = np.full(n, -1, np.int64)
    start = 0
    while start < pairs:
        stop = start + 1
        while stop < pairs and component[order[stop]] == component[order[start]]:
            stop += 1
        _assign_component(order[start:stop], tracks, detections, cost, miss_cost, local, answer)
        start = stop
    return answer


@nb.njit(cache=True)
def _root(parent, i):
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@nb.njit(cache=True)
def _assign_component(edges, tracks, detections, cost, miss_cost, local, answer):
    """Solve one component of the graph; writes its rows of ``answer``, ``local`` is scratch."""
    n = len(answer)
    rows, columns = np.empty(len(edges), np.int64), np.empty(len(edges), np.int64)
    row_count = column_count = 0
    for e in edges:
        i, j = tracks[e], detections[e]
        if local[i] < 0:
            local[i] = row_count
            rows[row_count] = i
            row_count += 1
        if local[n + j] < 0:
            local[n + j] = column_count
            columns[column_count] = j
            column_count += 1
    # each row has its own 'miss' column; what is impossible costs more than any whole solution
    never = 1.0
    for e in edges:
        never += 2 * abs(cost[e])
    for r in range(row_count):
        never += 2 * abs(miss_cost[rows[r]])
    table = np.full((row_count, column_count + row_count), never)
    for e in edges:
        table[local[tracks[e]], local[n + detections[e]]] = cost[e]
    for r in range(row_count):
        table[r, column_count + r] = miss_cost[rows[r]]
    chosen = shortest_augmenting_paths(table)
    for r in range(row_count):
        if chosen[r] < column_count:
            answer[rows[r]] = columns[chosen[r]]


@nb.njit(cache=True)
def shortest_augmenting_paths(table):
    """Column of each row in the assignment of least total cost; at least as many columns as rows.

    References
    ----------
    Jonker and Volgenant, Computing 38, 325 (1987): the augmentation phase, by Dijkstra on reduced costs.
    """
    rows, columns = table.shape
    row_price, column_price = np.zeros(rows), np.zeros(columns)
    row_of = np.full(columns, -1, np.int64)
    column_of = np.full(rows, -1, np.int64)
    for first in range(rows):
        distance = np.full(columns, np.inf)
        came_from = np.full(columns, -1, np.int64)
        settled = np.zeros(columns, np.bool_)
        row, length, sink = first, 0.0, -1
        while sink < 0:
            nearest, best = -1, np.inf
            for c in range(columns):
                if settled[c]:
                    continue
                through = length + table[row, c] - row_price[row] - column_price[c]
                if through < distance[c]:
                    distance[c] = through
                    came_from[c] = row
                if distance[c] < best:
                    best, nearest = distance[c], c
            length = best
            settled[nearest] = True
            if row_of[nearest] < 0:
                sink = nearest
            else:
                row = row_of[nearest]
        row_price[first] += length
        for c in range(columns):
            if settled[c] and c != sink:
                row_price[row_of[c]] += length - distance[c]
                column_price[c] -= length - distance[c]
        while True:  # flip the path
            row = came_from[sink]
            row_of[sink] = row
            sink, column_of[row] = column_of[row], sink
            if row == first:
                break
    return column_of
