"""Flow of traffic: velocities that vehicles had at a place, learnt from detections during the flight.

Three detections on a straight line with equal steps are probably one vehicle. Their velocity is a vote for
the velocity of other vehicles ahead and behind on the same lane. Where most votes agree on a fast motion, a
new track starts with it: on a motorway a vehicle moves farther between two frames than the next one is away,
so that a new track cannot tell them apart. No map is needed. Limits and the range in which they were chosen
are in ``data/calibration/flow.toml``.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from glintrack.core.arrays import Array
from glintrack.track.calibration import read_calibration


@dataclass(frozen=True)
class Flow:
    """Votes for velocities, and the recent detections that later votes need.

    Parameters
    ----------
    place, velocity
        Position and velocity of each vote. [m, m s⁻¹]
    time_s
        Time at which the vote's vehicle was there. [s]
    recent
        Times and positions of recent detections, the oldest first. [s, m]
    """

    place: Float[Array, "vote 2"]
    velocity: Float[Array, "vote 2"]
    time_s: Float[Array, "vote"]
    recent: tuple[tuple[float, Float[Array, "detection 2"]], ...] = ()


def no_flow() -> Flow:
    """Return a flow without votes."""
    return Flow(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))


def update_flow(flow: Flow, position: Float[Array, "detection 2"], time_s: float) -> Flow:
    """Add the votes of the straight triplets that end in this epoch.

    Parameters
    ----------
    flow
        Flow before the epoch.
    position
        Positions of the epoch's detections. [m]
    time_s
        Epoch. [s]
    """
    middle = _earlier(flow.recent, time_s)
    first = None if middle is None else _earlier(flow.recent, middle[0])
    oldest_s = -np.inf if first is None else first[0]
    recent = tuple(one for one in flow.recent if one[0] >= oldest_s) + ((time_s, position),)
    place, velocity = np.empty((0, 2)), np.empty((0, 2))
    if middle is not None and first is not None and all(map(len, (position, middle[1], first[1]))):
        place, velocity = _straight_triplets(first, middle, (time_s, position))
    at_s = np.full(len(place), middle[0] if middle is not None else time_s)
    young = time_s - flow.time_s <= _limits()["memory_s"]
    return Flow(
        np.concatenate([flow.place[young], place]),
        np.concatenate([flow.velocity[young], velocity]),
        np.concatenate([flow.time_s[young], at_s]),
        recent,
    )


def _earlier(recent, time_s: float):
    """Latest detections that are at least ``step_s`` before a time."""
    before = [one for one in recent if time_s - one[0] >= _limits()["step_s"]]
    return before[-1] if before else None


def _straight_triplets(first, middle, last) -> tuple[Float[Array, "vote 2"], Float[Array, "vote 2"]]:
    """Position in the middle, and velocity, of the straight triplets of three epochs."""
    limits, interval_s = _limits(), last[0] - middle[0]
    near = KDTree(last[1]).query_ball_tree(KDTree(middle[1]), limits["max_speed_m_s"] * interval_s)
    now = np.repeat(np.arange(len(near)), [len(one) for one in near])
    before = np.array([k for one in near for k in one], int)
    velocity = (last[1][now] - middle[1][before]) / interval_s
    expected = middle[1][before] - velocity * (middle[0] - first[0])
    if not len(expected):
        return np.empty((0, 2)), np.empty((0, 2))
    straight = KDTree(first[1]).query(expected)[0] <= limits["straight_m"]
    straight &= np.hypot(*velocity.T) >= limits["min_vote_m_s"]
    return middle[1][before[straight]], velocity[straight]


def birth_velocity(
    flow: Flow, position: Float[Array, "track 2"]
) -> tuple[Float[Array, "track 2"], Bool[Array, "track"]]:
    """Velocity of the flow at positions, and the mask of the positions where it can be trusted. [m s⁻¹]

    The votes on the lane of a position are compared. Their most frequent velocity is trusted if it is fast,
    has ``min_votes``, and ``min_ratio`` times as many as the most frequent other one.
    """
    limits, velocity, trusted = _limits(), np.zeros((len(position), 2)), np.zeros(len(position), bool)
    if len(flow.time_s) < limits["min_votes"] or not len(position):
        return velocity, trusted
    unit = flow.velocity / np.hypot(*flow.velocity.T)[:, None]
    for k, near in enumerate(KDTree(flow.place).query_ball_point(position, limits["reach_m"])):
        votes = flow.velocity[near][_is_on_lane(position[k], flow.place[near], unit[near])]
        if len(votes) < limits["min_votes"]:
            continue
        count = KDTree(votes).query_ball_point(votes, limits["same_m_s"], return_length=True)
        best = int(np.argmax(count))
        apart = np.hypot(*(votes - votes[best]).T)
        velocity[k] = votes[apart < limits["same_m_s"]].mean(axis=0)
        others = count[apart > limits["other_m_s"]].max(initial=0)
        trusted[k] = count[best] >= max(limits["min_votes"], limits["min_ratio"] * others)
    return velocity, trusted & (np.hypot(*velocity.T) > limits["min_flow_m_s"])


def _is_on_lane(
    position: Float[Array, "2"], place: Float[Array, "vote 2"], unit: Float[Array, "vote 2"]
) -> Bool[Array, "vote"]:
    """Return True for votes with a line that passes a position."""
    off = position - place
    return np.abs(off[:, 0] * unit[:, 1] - off[:, 1] * unit[:, 0]) < _limits()["across_m"]


def count_votes(
    flow: Flow, position: Float[Array, "track 2"], velocity: Float[Array, "track 2"], time_s: float
) -> Float[Array, "track"]:
    """Count the votes of other vehicles for the velocity of a track, on its line. [1]

    A vote whose vehicle would now be at the track's position is the track's own.
    """
    limits, out = _limits(), np.zeros(len(position))
    if not len(flow.time_s) or not len(position):
        return out
    scale = np.repeat([limits["reach_m"], limits["same_m_s"]], 2)
    tree = KDTree(np.c_[flow.place, flow.velocity] / scale)
    now = flow.place + flow.velocity * (time_s - flow.time_s)[:, None]
    unit = flow.velocity / np.hypot(*flow.velocity.T)[:, None]
    near = tree.query_ball_point(np.c_[position, velocity] / scale, 1.0, p=np.inf)
    for k, votes in enumerate(near):
        lane = _is_on_lane(position[k], flow.place[votes], unit[votes])
        out[k] = np.sum(lane & (np.hypot(*(now[votes] - position[k]).T) > limits["own_m"]))
    return out


def _limits() -> Mapping[str, float]:
    return read_calibration("flow").constants
