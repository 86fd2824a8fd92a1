"""Data association: gating, then one-to-one assignment or association probabilities."""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import min_weight_full_bipartite_matching
from scipy.spatial import KDTree

from glintrack.core.arrays import Array
from glintrack.track.motion import mahalanobis_squared

MIN_DENSITY_M2 = 1e-300  # a smaller one has no logarithm in double precision
_MAX_SWEEPS, _MAX_CHANGE = 200, 1e-10  # message passing ends when no message changes by more


def gate(
    mean: Float[Array, "track state"],
    covariance: Float[Array, "track state state"],
    measured: Float[Array, "detection 2"],
    measured_covariance: Float[Array, "detection 2 2"],
    gate_distance2: float,
) -> tuple[Int[Array, "pair"], Int[Array, "pair"]]:
    """Gate the pairs of track and detection.

    Parameters
    ----------
    mean, covariance
        Predicted states; only their positions, the first two entries, count. [m]
    measured, measured_covariance
        East and north of the detections. [m]
    gate_distance2
        Largest squared Mahalanobis distance. [1]

    Returns
    -------
    Track and detection index of each pair, by rising track.
    """
    if len(measured) == 0 or len(mean) == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    widest_m2 = np.trace(measured_covariance, axis1=1, axis2=2).max()
    reach_m = np.sqrt(gate_distance2 * (covariance[:, 0, 0] + covariance[:, 1, 1] + widest_m2))
    near = KDTree(measured).query_ball_point(mean[:, :2], reach_m, return_sorted=True)
    tracks = np.repeat(np.arange(len(mean)), [len(one) for one in near])
    detections = np.array([one for of_track in near for one in of_track], np.int64)
    apart, spread = measured[detections] - mean[tracks, :2], covariance[tracks, :2, :2]
    inside = mahalanobis_squared(apart, spread + measured_covariance[detections])[0] <= gate_distance2
    return tracks[inside], detections[inside]


def marginals(
    tracks: Int[Array, "pair"],
    detections: Int[Array, "pair"],
    cost: Float[Array, "pair"],
    miss_cost: Float[Array, "track"],
    detection_count: int,
) -> Float[Array, "pair"]:
    """Probability that each pair belongs together, by loopy message passing; arguments as in `assign`. [1]

    References
    ----------
    Williams and Lau, IEEE Trans. AES 50, 2942 (2014), Eqs. (24)–(26): exact where the graph of pairs is a
    tree, and close to exact where it is not.
    """
    if len(tracks) == 0:
        return np.empty(0)
    ratio = np.exp(np.clip(miss_cost[tracks] - cost, -700.0, 700.0))
    to_track, count = np.ones(len(tracks)), len(miss_cost)
    for _ in range(_MAX_SWEEPS):
        weight = ratio * to_track
        others = np.maximum(np.bincount(tracks, weight, count)[tracks] - weight, 0.0)
        to_detection = ratio / (1.0 + others)
        load = np.bincount(detections, to_detection, detection_count)[detections]
        before, to_track = to_track, 1.0 / (1.0 + np.maximum(load - to_detection, 0.0))
        if np.abs(to_track - before).max() < _MAX_CHANGE:
            break
    weight = ratio * to_track
    return weight / (1.0 + np.bincount(tracks, weight, count)[tracks])


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
        Possible pairs and the cost of each; may be negative. [nat]
    miss_cost
        Cost of leaving each track without a detection. [nat]
    detection_count
        Number of detections.

    Returns
    -------
    Detection index of each track, −1 for none.
    """
    tracks, detections = np.asarray(tracks, np.int64), np.asarray(detections, np.int64)
    miss_cost = np.asarray(miss_cost, np.float64)
    n, every = len(miss_cost), np.arange(len(miss_cost))
    if len(tracks) == 0:
        return np.full(n, -1, np.int64)
    # a column of its own for each track's miss; the solver takes weights above 0 alone
    weight = np.concatenate([np.asarray(cost, np.float64), miss_cost])
    weight += 1.0 - weight.min()
    row, column = np.concatenate([tracks, every]), np.concatenate([detections, detection_count + every])
    graph = csr_array((weight, (row, column)), shape=(n, detection_count + n))
    _, chosen = min_weight_full_bipartite_matching(graph)
    return np.where(chosen < detection_count, chosen, -1).astype(np.int64)
