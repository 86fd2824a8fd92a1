"""Which detection belongs to which track: gating by sorted bands, then one-to-one or by probability."""

import math

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.track.motion import Modes
from glintrack.track.motion_kernels import normal_density

LEAST_DENSITY_M2 = 1e-300  # what a double can still take the logarithm of
_BAND_M, _MOST_BANDS = 30.0, 1000  # some gates wide; few, wherever a stray detection lies
_MOST_SWEEPS, _SETTLED = 200, 1e-10  # belief propagation ends when no message changes by more


def gate(
    mean: Float[Array, "track state"],
    covariance: Float[Array, "track state state"],
    measured: Float[Array, "detection 2"],
    measured_covariance: Float[Array, "detection 2 2"],
    gate_distance2: float,
) -> tuple[Int[Array, "pair"], Int[Array, "pair"]]:
    """Pairs of track and detection near enough to belong together.

    Parameters
    ----------
    mean, covariance
        Predicted states, of which only the positions, in front, count. [m]
    measured, measured_covariance
        East and north of the detections. [m]
    gate_distance2
        Largest squared Mahalanobis distance. [1]

    Returns
    -------
    Track and detection index of each pair, by rising track.
    """
    if len(measured) == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    south, band_m = _bands(measured[:, 1])
    by_east = np.argsort(measured[:, 0], kind="stable")
    order, first = _banded(measured, by_east, south, band_m)
    measured, noise = measured[order], measured_covariance[order]
    room = 8 * max(len(mean), len(measured)) + 16
    while True:
        tracks, detections = np.empty(room, np.int64), np.empty(room, np.int64)
        count = _gate(
            mean, covariance, measured, noise, float(gate_distance2), order, first, south, band_m, tracks,
            detections,
        )  # fmt: skip
        if count <= room:
            return tracks[:count], detections[:count]
        room = count


def _bands(north: Float[Array, "detection"]) -> tuple[float, float]:
    """Southern edge and width of the bands that detections are sorted into. [m]"""
    south = float(north.min())
    return south, max(_BAND_M, (float(north.max()) - south) / _MOST_BANDS)


@nb.njit(cache=True)
def _banded(measured, by_east, south, band_m):
    """Order of the detections by band and, within each, by rising east; and where each band starts."""
    count = len(measured)
    band, last = np.empty(count, np.int64), 0
    for k in range(count):
        band[k] = int((measured[k, 1] - south) / band_m)
        last = max(last, band[k])
    first = np.zeros(last + 2, np.int64)
    for k in range(count):
        first[band[k] + 1] += 1
    for b in range(last + 1):
        first[b + 1] += first[b]
    order, place = np.empty(count, np.int64), first.copy()
    for k in by_east:
        order[place[band[k]]] = k
        place[band[k]] += 1
    return order, first


@nb.njit(cache=True)
def _gate(
    mean, covariance, measured, noise, gate2, order, first, south, band_m, tracks, detections
):  # fmt: skip
    """Count the pairs, and write as many as there is room for into the last two arguments.

    Detections lie in bands from south to north, in each by rising east.
    """
    widest_east = widest_north = 0.0
    for j in range(len(measured)):
        widest_east = max(widest_east, noise[j, 0, 0])
        widest_north = max(widest_north, noise[j, 1, 1])
    count = 0
    for i in range(len(mean)):
        reach = math.sqrt(gate2 * (covariance[i, 0, 0] + widest_east))
        up = math.sqrt(gate2 * (covariance[i, 1, 1] + widest_north))
        lowest = max(int(max(mean[i, 1] - up - south, 0.0) / band_m), 0)
        highest = min(int(max(mean[i, 1] + up - south, 0.0) / band_m), len(first) - 2)
        for band in range(lowest, highest + 1):
            low, high = first[band], first[band + 1]
            while low < high:  # first detection not west of the gate
                middle = (low + high) // 2
                if measured[middle, 0] < mean[i, 0] - reach:
                    low = middle + 1
                else:
                    high = middle
            for q in range(low, first[band + 1]):
                dx = measured[q, 0] - mean[i, 0]
                if dx > reach:
                    break
                dy = measured[q, 1] - mean[i, 1]
                if abs(dy) > up:
                    continue
                s00 = covariance[i, 0, 0] + noise[q, 0, 0]
                s01 = covariance[i, 0, 1] + noise[q, 0, 1]
                s11 = covariance[i, 1, 1] + noise[q, 1, 1]
                determinant = s00 * s11 - s01 * s01
                distance2 = (dx * dx * s11 - 2 * dx * dy * s01 + dy * dy * s00) / determinant
                if distance2 > gate2:
                    continue
                if count < len(tracks):
                    tracks[count], detections[count] = i, order[q]
                count += 1
    return count


def negative_log_likelihood(
    modes: Modes,
    detection: Float[Array, "mode"],
    tracks: Int[Array, "pair"],
    detections: Int[Array, "pair"],
    measured: Float[Array, "detection 2"],
    measured_covariance: Float[Array, "detection 2 2"],
) -> Float[Array, "pair"]:
    """−ln of the density with which each pair's target is detected where the detection is. [nat]

    Parameters
    ----------
    modes
        Predicted.
    detection
        Probability that a target in each mode is detected. [1]
    tracks, detections
        Of each pair.
    measured, measured_covariance
        East and north of the detections. [m, m²]
    """
    out = np.empty(len(tracks))
    _negative_log_likelihood(
        modes.mean, modes.covariance, modes.probability * detection, tracks, detections, measured,
        measured_covariance, out,
    )  # fmt: skip
    return out


@nb.njit(cache=True)
def _negative_log_likelihood(mean, covariance, weight, tracks, detections, measured, noise, out):
    for q in range(len(tracks)):
        i, j = tracks[q], detections[q]
        density = 0.0
        for m in range(mean.shape[1]):
            density += weight[i, m] * normal_density(measured, noise, j, mean, covariance, i, m)
        out[q] = -math.log(max(density, LEAST_DENSITY_M2))


def marginals(
    tracks: Int[Array, "pair"],
    detections: Int[Array, "pair"],
    cost: Float[Array, "pair"],
    miss_cost: Float[Array, "track"],
    detection_count: int,
) -> Float[Array, "pair"]:
    """Probability that each pair belongs together, by loopy belief propagation; arguments as in `assign`. [1]

    References
    ----------
    Williams and Lau, IEEE Trans. AES 50, 2942 (2014), Eqs. (24)–(26): exact where the graph of pairs is a
    tree, and close to exact where it is not.
    """
    ratio = np.exp(np.clip(miss_cost[tracks] - cost, -700.0, 700.0))
    return _marginals(tracks, detections, ratio, len(miss_cost), detection_count)


@nb.njit(cache=True)
def _marginals(tracks, detections, ratio, track_count, detection_count):
    pairs = len(tracks)
    to_track, to_detection = np.ones(pairs), np.empty(pairs)
    sums, loads = np.empty(track_count), np.empty(detection_count)
    for _ in range(_MOST_SWEEPS):
        sums[:] = 0.0
        for q in range(pairs):
            sums[tracks[q]] += ratio[q] * to_track[q]
        loads[:] = 0.0
        for q in range(pairs):
            to_detection[q] = ratio[q] / (1.0 + max(sums[tracks[q]] - ratio[q] * to_track[q], 0.0))
            loads[detections[q]] += to_detection[q]
        change = 0.0
        for q in range(pairs):
            message = 1.0 / (1.0 + max(loads[detections[q]] - to_detection[q], 0.0))
            change = max(change, abs(message - to_track[q]))
            to_track[q] = message
        if change < _SETTLED:
            break
    sums[:] = 0.0
    for q in range(pairs):
        sums[tracks[q]] += ratio[q] * to_track[q]
    out = np.empty(pairs)
    for q in range(pairs):
        out[q] = ratio[q] * to_track[q] / (1.0 + sums[tracks[q]])
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
    tracks, detections = np.asarray(tracks, np.int64), np.asarray(detections, np.int64)
    cost, miss_cost = np.asarray(cost, np.float64), np.asarray(miss_cost, np.float64)
    n, pairs = len(miss_cost), len(cost)
    answer = np.full(n, -1, np.int64)
    if pairs == 0:
        return answer
    order, starts = grouped(components(tracks, detections, n, n + detection_count), n)
    local = np.full(n + detection_count, -1, np.int64)
    _assign_components(order, starts, tracks, detections, cost, miss_cost, local, answer)
    return answer


@nb.njit(cache=True)
def grouped(component, count):
    """Order by component, and where each component starts and the last ends; numbers lie under ``count``."""
    first = np.zeros(count + 1, np.int64)
    for c in component:
        first[c + 1] += 1
    groups = 0
    for c in range(count):
        groups += first[c + 1] > 0
        first[c + 1] += first[c]
    starts = np.empty(groups + 1, np.int64)
    groups = 0
    for c in range(count):
        if first[c + 1] > first[c]:
            starts[groups] = first[c]
            groups += 1
    starts[groups] = len(component)
    order = np.empty(len(component), np.int64)
    for q in range(len(component)):
        order[first[component[q]]] = q
        first[component[q]] += 1
    return order, starts


@nb.njit(cache=True)
def components(tracks, detections, track_count, count):
    """Component of each pair in the graph of tracks and detections: its least member."""
    parent = np.arange(count)
    for q in range(len(tracks)):
        a, b = tracks[q], track_count + detections[q]
        while parent[a] != a:
            parent[a] = parent[parent[a]]
            a = parent[a]
        while parent[b] != b:
            parent[b] = parent[parent[b]]
            b = parent[b]
        parent[max(a, b)] = min(a, b)
    out = np.empty(len(tracks), np.int64)
    for q in range(len(tracks)):
        a = tracks[q]
        while parent[a] != a:
            a = parent[a]
        out[q] = a
    return out


@nb.njit(cache=True)
def _assign_components(order, starts, tracks, detections, cost, miss_cost, local, answer):
    for k in range(len(starts) - 1):
        edges = order[starts[k] : starts[k + 1]]
        i, least, alone = tracks[edges[0]], miss_cost[tracks[edges[0]]], True
        for e in edges:
            alone &= tracks[e] == i
            if cost[e] < least:
                least, answer[i] = cost[e], detections[e]
        if alone:  # nobody to share with
            continue
        answer[i] = -1
        _assign_component(edges, tracks, detections, cost, miss_cost, local, answer)


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
    starts = np.zeros(row_count + 1, np.int64)
    for e in edges:
        starts[local[tracks[e]] + 1] += 1
    for r in range(row_count):
        starts[r + 1] += starts[r] + 1  # each row has its own 'miss' column
    total = starts[row_count]
    place, price = np.empty(total, np.int64), np.empty(total)
    following = starts[:-1].copy()
    for e in edges:
        r = local[tracks[e]]
        place[following[r]], price[following[r]] = local[n + detections[e]], cost[e]
        following[r] += 1
    for r in range(row_count):
        place[following[r]], price[following[r]] = column_count + r, miss_cost[rows[r]]
    chosen = shortest_augmenting_paths(starts, place, price, column_count + row_count)
    for r in range(row_count):
        if chosen[r] < column_count:
            answer[rows[r]] = columns[chosen[r]]


@nb.njit(cache=True)
def shortest_augmenting_paths(starts, place, price, columns):
    """Column of each row in the assignment of least total cost.

    Parameters
    ----------
    starts : (row + 1,)
        Entries ``starts[r]`` to ``starts[r + 1]`` are those of row r.
    place, price : (entry,)
        Column and cost of each; an assignment of all rows must exist.
    columns : int
        How many there are.

    References
    ----------
    Jonker and Volgenant, Computing 38, 325 (1987): the augmentation phase, by Dijkstra on reduced costs. Of
    columns equally near the first is taken.
    """
    rows = len(starts) - 1
    row_price, column_price = np.zeros(rows), np.zeros(columns)
    row_of, column_of = np.full(columns, -1), np.full(rows, -1)
    distance, came_from = np.full(columns, np.inf), np.empty(columns, np.int64)
    settled = np.zeros(columns, np.bool_)
    reached = np.empty(columns, np.int64)  # those settled, then those whose distance may still fall
    for first in range(rows):
        row, length, done, count = first, 0.0, 0, 0
        while True:
            for k in range(starts[row], starts[row + 1]):
                c = place[k]
                through = length + price[k] - row_price[row] - column_price[c]
                if not settled[c] and through < distance[c]:
                    if distance[c] == np.inf:
                        reached[count] = c
                        count += 1
                    distance[c] = through
                    came_from[c] = row
            at = done
            for k in range(done + 1, count):
                c, nearest = reached[k], reached[at]
                if distance[c] < distance[nearest] or (distance[c] == distance[nearest] and c < nearest):
                    at = k
            reached[done], reached[at] = reached[at], reached[done]
            sink = reached[done]
            length = distance[sink]
            if row_of[sink] < 0:
                break
            settled[sink] = True
            row = row_of[sink]
            done += 1
        row_price[first] += length
        for c in reached[:done]:
            row_price[row_of[c]] += length - distance[c]
            column_price[c] -= length - distance[c]
        for c in reached[:count]:
            distance[c], settled[c] = np.inf, False
        while True:  # flip the path
            row = came_from[sink]
            row_of[sink] = row
            sink, column_of[row] = column_of[row], sink
            if row == first:
                break
    return column_of
