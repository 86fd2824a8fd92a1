"""Existence model: find the tracks that are vehicles, duplicates, and tracks that changed vehicles.

Confirmation decides whether a target is tracked, and may be generous. Reporting decides whether it is a
vehicle near its estimated position, and may change at every epoch. The log odds of existence are a logistic
model of the tracker's observations (``data/calibration/existence.toml``), fitted for the detector `mosaic` by
``python tools/calibrate.py``.

A long or tall vehicle is detected in more than one place, and each place gets a track. Two vehicles in one
lane keep a distance, and two side by side soon differ in velocity. Two tracks of one vehicle stay close with
the same velocity. Such duplicates are tracked separately and reported as one track, at their mean position,
under the oldest id.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from scipy.special import expit, logit

from glintrack.core.arrays import Array
from glintrack.track.calibration import read_calibration
from glintrack.track.flow import Flow, count_votes
from glintrack.track.initiation import Targets, find_rows, is_stopped

MIN_LOG_ODDS = -0.7  # a track with lower odds is never reported
MAX_MISSES = 2.0  # limit of the misses
MIN_SPEED_M_S, MAX_AGE_S = 6.0, 5.0  # slower motion lowers the odds; limit of the age
MAX_SPEED_M_S = 15.0  # limit of the speed of young tracks
NEIGHBOUR_M, SAME_SPEED_M_S = 12.0, 4.0
QUEUE_M, QUEUE = 40.0, 4  # distance and number of the tracks of a queue
_ITERATIONS = 30  # of expectation maximization
_MAX_NEIGHBOURS = 24


def group_log_odds(
    channel: str, targets: Targets, primary: Int[Array, "target"], flow: Flow, time_s: float
) -> Float[Array, "target"]:
    """Log odds that each target is a vehicle near its position. [nat]

    A primary target has the greatest odds of its group.

    Parameters
    ----------
    channel
        ``pan``, ``dolp`` or ``all``.
    targets
        All targets; the confirmed ones count as neighbours.
    primary
        Index of the target that is reported for each target (`primary_targets`).
    flow, time_s
        Flow of traffic, and the epoch. [s]
    """
    features = existence_features(targets, flow, time_s, primary)
    own = read_calibration("existence").models[channel].log_odds(features)
    odds = own.copy()
    np.maximum.at(odds, primary, own)
    return odds


def adapt_log_odds(channel: str, log_odds: Float[Array, "target"]) -> Float[Array, "target"]:
    """Raise log odds of existence where more of the targets are vehicles than usual.

    The model has one intercept for all traffic. Where nearly all targets are vehicles, as on a dense road, it
    doubts too many. Their share is estimated by expectation maximization: Saerens, Latinne and Decaestecker,
    Neural Computation 14, 21 (2002). Log odds never fall, because the estimate is too low in slow traffic.

    Parameters
    ----------
    channel
        ``pan``, ``dolp`` or ``all``.
    log_odds
        Log odds by the model. [nat]
    """
    known = read_calibration("existence").constants
    share, prior = known["usual_share"][channel], known["prior_tracks"]
    rise = 0.0
    for _ in range(_ITERATIONS):
        here = (expit(log_odds + rise).sum() + prior * share) / (len(log_odds) + prior)
        rise = float(np.clip(logit(here) - logit(share), 0.0, known["max_rise"]))
    return log_odds + rise


def select_reported_tracks(
    log_odds: Float[Array, "target"],
    candidate: Bool[Array, "target"],
    moving: Bool[Array, "target"],
    max_false_share: float,
) -> Bool[Array, "target"]:
    """Select the most likely vehicles, limited by the expected false tracks per moving one.

    Scores count no vehicle that stands as right: many tracks of such must not make room for false ones. A
    track that stands is also selected if it is as sure as the share asks.

    Parameters
    ----------
    log_odds
        Log odds of existence. [nat]
    candidate
        Mask of the targets that may be reported.
    moving
        Mask of the targets that move.
    max_false_share
        Largest expected share of false tracks. [1]
    """
    order = np.flatnonzero(candidate & (log_odds >= MIN_LOG_ODDS))
    order = order[np.argsort(-log_odds[order], kind="stable")]
    out = np.zeros(len(log_odds), bool)
    false, moves = expit(-log_odds[order]), moving[order]
    allowed = np.flatnonzero(np.cumsum(false) <= max_false_share * np.cumsum(moves))
    rank = np.arange(len(order))
    sure = ~moves & (false <= max_false_share)
    out[order[sure | (rank <= allowed.max(initial=-1))]] = True
    return out


def existence_features(
    targets: Targets, flow: Flow, time_s: float, primary: Int[Array, "target"]
) -> Float[Array, "target feature"]:
    """Features of the existence model, in the order of its calibration; parameters as in `group_log_odds`.

    - frames since the last measurement;
    - recent mean likelihood ratio (`Targets.recent_ratio`), and its positive part;
    - speed deficit to 6 m/s;
    - proximity of the nearest confirmed track with a similar velocity, and of the nearest of any: 1 at its
      position, 0 from 12 m on;
    - that of any times the ratio, and times the deficit to 6 m/s of the mean speed since the first position;
    - age up to 5 s, and times that deficit;
    - number of tracks in the queue, from 0 to 1 for `QUEUE`, times both proximities and the deficit, too: a
      near track with a similar velocity is another vehicle in a queue, else probably the same one;
    - logarithm of the number of other vehicles that had the track's velocity on its line;
    - speed up to 15 m/s over 1 s plus the age, which is large for a fast young track;
    - 1 for a track that stands after a drive (`is_stopped`): misses are no evidence against it.
    """
    speed = np.hypot(targets.mean[:, 2], targets.mean[:, 3])
    deficit_m_s = np.maximum(MIN_SPEED_M_S - targets.travel_m / np.maximum(targets.age_s, 1.0), 0.0)
    age, recent_ratio = np.minimum(targets.age_s, MAX_AGE_S), targets.recent_ratio
    co_moving, near, count = _neighbours(targets, primary)
    queue = np.minimum(count / QUEUE, 1.0)
    slow = np.maximum(MIN_SPEED_M_S - speed, 0.0)
    votes = np.log1p(count_votes(flow, targets.position, targets.mean[:, 2:], time_s))
    columns = [
        np.minimum(targets.misses, MAX_MISSES), recent_ratio, np.maximum(recent_ratio, 0.0), slow, co_moving,
        near, recent_ratio * near, deficit_m_s * near, age, deficit_m_s * age,
        queue, queue * co_moving, queue * near, queue * slow, votes,
        np.minimum(speed, MAX_SPEED_M_S) / (1 + targets.age_s), is_stopped(targets),
    ]  # fmt: skip
    return np.stack(columns, axis=-1).astype(float)


class Neighbours(NamedTuple):
    """Other confirmed tracks around a target.

    Parameters
    ----------
    co_moving, any_near
        Proximity of the nearest one with a similar velocity, and of the nearest of any, from 0 at
        `NEIGHBOUR_M` to 1.
    count
        Number of those with a similar velocity within `QUEUE_M`.
    """

    co_moving: Float[Array, "target"]
    any_near: Float[Array, "target"]
    count: Float[Array, "target"]


def _neighbours(targets: Targets, primary: Int[Array, "target"]) -> Neighbours:
    """Neighbours of each target among the confirmed ones on other vehicles."""
    present = np.flatnonzero(targets.confirmed & (targets.misses <= 1))
    if len(present) == 0:
        return Neighbours(*np.zeros((3, len(targets))))
    nearest: Any = np.arange(1, min(_MAX_NEIGHBOURS + 1, len(present)) + 1)
    tree = KDTree(targets.position[present])
    distance, which = tree.query(targets.position, k=nearest, distance_upper_bound=QUEUE_M)
    found = np.isfinite(distance)
    other = present[np.where(found, which, 0)]
    found &= primary[other] != primary[:, None]
    proximity = np.where(found, np.maximum(1 - distance / NEIGHBOUR_M, 0.0), 0.0)
    difference = targets.mean[other, 2:] - targets.mean[:, None, 2:]
    same = found & (np.hypot(difference[..., 0], difference[..., 1]) < SAME_SPEED_M_S)
    return Neighbours(
        np.where(same, proximity, 0.0).max(axis=1), proximity.max(axis=1), same.sum(axis=1).astype(float)
    )


def duplicate_limits() -> Mapping[str, float]:
    """Distances, speeds and counts at which two tracks follow one vehicle (``existence.toml``)."""
    return read_calibration("existence").constants["duplicates"]


@dataclass(frozen=True)
class Duplicates:
    """Pairs of tracks that follow the same vehicle.

    Parameters
    ----------
    pair
        Ids, the older first; rows rise.
    frames
        Frames in which each pair was found, less those in which it was not since, at most ``frames``
        of `duplicate_limits`.
    """

    pair: Int[Array, "pair 2"]
    frames: Int[Array, "pair"]


def no_duplicates() -> Duplicates:
    """No pair."""
    return Duplicates(np.empty((0, 2), np.int64), np.empty(0, np.int64))


def update_duplicates(before: Duplicates, targets: Targets, flow: Flow, time_s: float) -> Duplicates:
    """Update the pairs with an epoch: those found in it, and those mostly found in the last ones.

    Parameters
    ----------
    before
        Pairs after the epoch before.
    targets
        Targets after this epoch.
    flow, time_s
        Flow of traffic, and the epoch. [s]
    """
    limits = duplicate_limits()
    found = targets.id[_find_pairs(targets, flow, time_s)]
    pair, which = np.unique(np.concatenate([found, before.pair]), axis=0, return_inverse=True)
    which = which.reshape(-1)
    change = np.r_[np.full(len(found), 2), before.frames - 1]  # one more if found, else one less
    frames = np.minimum(np.bincount(which, change, len(pair)), limits["frames"]).astype(np.int64)
    frames[np.bincount(which[len(found) :], minlength=len(pair)) == 0] = 1
    row, found_rows = find_rows(targets.id, pair)
    alive, near = found_rows.all(axis=1), np.zeros(len(pair), bool)
    apart = targets.position[row[alive, 0]] - targets.position[row[alive, 1]]
    near[alive] = np.hypot(*apart.T) < limits["end_m"]
    lasting = alive & near & (frames > 0)
    return Duplicates(pair[lasting], frames[lasting])


def primary_targets(duplicates: Duplicates, targets: Targets) -> Int[Array, "target"]:
    """Index of the oldest target on each target's vehicle; of a target without duplicates its own."""
    of = np.arange(len(targets))
    row, found = find_rows(targets.id, duplicates.pair)
    row = row[found.all(axis=1)]
    for older, younger in row[np.lexsort((row[:, 0], row[:, 1]))]:
        if of[younger] == younger:
            of[younger] = of[older]
    return of


def move_to_mean_position(targets: Targets, primary: Int[Array, "target"]) -> Targets:
    """Move each primary target to the mean position of its duplicates and itself."""
    many = np.maximum(np.bincount(primary, minlength=len(targets)), 1)
    sums = [np.bincount(primary, targets.position[:, k], len(targets)) for k in range(2)]
    is_primary = primary == np.arange(len(targets))
    shift = np.where(is_primary[:, None], np.stack(sums, axis=-1) / many[:, None] - targets.position, 0.0)
    shift[many == 1] = 0.0  # to the last digit
    mean, mode_mean = targets.mean.copy(), targets.mode_mean.copy()
    mean[:, :2] += shift
    mode_mean[..., :2] += shift[:, None]
    return replace(targets, mean=mean, mode_mean=mode_mean)


def _find_pairs(targets: Targets, flow: Flow, time_s: float) -> Int[Array, "pair 2"]:
    """Find pairs of confirmed targets that move together at this epoch; indices, the older first."""
    limits = duplicate_limits()
    present = np.flatnonzero(targets.confirmed & (targets.misses <= limits["max_misses"]))
    if len(present) < 2:
        return np.empty((0, 2), np.int64)
    tree = KDTree(targets.position[present])
    near = tree.query_pairs(limits["follower_m"], output_type="ndarray").reshape(-1, 2)
    a, b = np.sort(present[near], axis=1).T
    velocity = 0.5 * (targets.mean[a, 2:] + targets.mean[b, 2:])
    speed, apart = np.hypot(*velocity.T), targets.position[b] - targets.position[a]
    unit = velocity / np.maximum(speed, 1e-9)[:, None]
    along_m = np.abs((apart * unit).sum(axis=1))
    across_m = np.abs(apart[:, 1] * unit[:, 0] - apart[:, 0] * unit[:, 1])
    alike = np.hypot(*(targets.mean[a, 2:] - targets.mean[b, 2:]).T) < limits["speed_difference_m_s"]
    alike &= speed > limits["min_speed_m_s"]
    in_line, in_lane = (alike & (across_m <= limits[name]) for name in ("across_m", "lane_m"))
    beside = alike & (across_m <= limits["beside_m"])
    others = np.bincount(np.concatenate([a[beside], b[beside]]), minlength=len(targets))
    too_close = in_lane & (along_m <= limits["car_m"] + limits["headway_s"] * speed)
    too_close &= (others[a] == 1) & (others[b] == 1)
    count = _neighbours(targets, np.arange(len(targets))).count
    alone = np.minimum(count[a], count[b]) <= limits["max_alike"]
    votes = count_votes(flow, targets.position, targets.mean[:, 2:], time_s)
    alone &= np.minimum(votes[a], votes[b]) <= limits["max_votes"]
    alone &= np.hypot(*apart.T) <= limits["distance_m"]
    alone &= in_line | (alike & (along_m <= limits["along_m"]))
    return np.stack([a, b], axis=-1)[too_close | alone]


def reassign_ids(before: Targets, after: Targets, interval_s: float, next_id: int) -> Int[Array, "target"]:
    """Assign a new id to each track that probably changed vehicles in an epoch.

    A track found again far from its predicted position belongs to another vehicle more often than to its own.
    A track that was measured throughout keeps its id, since such a jump is mostly a wrong detection.

    Parameters
    ----------
    before, after
        Targets of the epoch before, by rising id, and of this one.
    interval_s
        Time between them. [s]
    next_id
        First free id.
    """
    ids = after.id.copy()
    if len(before) == 0:
        return ids
    row, known = find_rows(before.id, after.id)
    expected = before.position[row] + before.mean[row, 2:4] * interval_s
    far = np.hypot(*(after.position - expected).T) > read_calibration("existence").constants["reassigned_m"]
    found = known & (before.misses[row] > 0) & (after.misses == 0)
    new = np.flatnonzero(after.confirmed & found & far)
    ids[new] = next_id + np.arange(len(new))
    return ids
