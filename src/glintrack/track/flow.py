"""Flow of traffic: velocities that vehicles had at a place, learnt from detections during the flight.

Three detections on a straight line with equal steps are probably one vehicle. Their velocity is a vote for
the velocity of other vehicles ahead and behind on the same lane. Where most votes agree on a fast motion, a
new track starts with it: on a motorway a vehicle moves farther between two frames than the next one is away,
so that a new track cannot tell them apart. No map is needed.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from glintrack.core.arrays import Array

MAX_SPEED_M_S = 45.0
MIN_VOTE_M_S = 2.0  # slower triplets are mostly clutter
STEP_S = 0.45  # minimum time between the detections of a triplet
STRAIGHT_M = 2.2  # maximum distance of the first detection from the line through the others
REACH_M, ACROSS_M = 70.0, 3.0  # along its own velocity and across it, in which a vote counts
SAME_M_S = 2.5  # votes of one motion differ less
OTHER_M_S = 7.5  # votes of another motion differ more
MIN_VOTES, MIN_RATIO = 4, 1.6  # of the most frequent motion, and over the next one
MIN_FLOW_M_S = 12.0  # a slower flow does not move a vehicle to its neighbour's place
SIGMA_M_S = 3.5  # standard deviation of a velocity component in a flow
MEMORY_S = 30.0
OWN_M = 8.0  # a vote that arrives nearer to a track is its own


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
    recent = tuple(one for one in flow.recent if time_s - one[0] <= 4 * STEP_S) + ((time_s, position),)
    place, velocity = np.empty((0, 2)), np.empty((0, 2))
    if middle is not None and first is not None and all(map(len, (position, middle[1], first[1]))):
        place, velocity = _straight_triplets(first, middle, (time_s, position))
    at_s = np.full(len(place), middle[0] if middle is not None else time_s)
    young = time_s - flow.time_s <= MEMORY_S
    return Flow(
        np.concatenate([flow.place[young], place]),
        np.concatenate([flow.velocity[young], velocity]),
        np.concatenate([flow.time_s[young], at_s]),
        recent,
    )


def _earlier(recent, time_s: float):
    """Latest detections that are at least `STEP_S` before a time."""
    before = [one for one in recent if time_s - one[0] >= STEP_S]
    return before[-1] if before else None


def _straight_triplets(first, middle, last) -> tuple[Float[Array, "vote 2"], Float[Array, "vote 2"]]:
    """Position in the middle, and velocity, of the straight triplets of three epochs."""
    interval_s = last[0] - middle[0]
    near = KDTree(last[1]).query_ball_tree(KDTree(middle[1]), MAX_SPEED_M_S * interval_s)
    now = np.repeat(np.arange(len(near)), [len(one) for one in near])
    before = np.array([k for one in near for k in one], int)
    velocity = (last[1][now] - middle[1][before]) / interval_s
    expected = middle[1][before] - velocity * (middle[0] - first[0])
    straight = KDTree(first[1]).query(expected)[0] <= STRAIGHT_M if len(expected) else np.empty(0, bool)
    straight &= np.hypot(*velocity.T) >= MIN_VOTE_M_S
    return middle[1][before[straight]], velocity[straight]


def birth_velocity(
    flow: Flow, position: Float[Array, "track 2"]
) -> tuple[Float[Array, "track 2"], Bool[Array, "track"]]:
    """Velocity of the flow at positions, and the mask of the positions where it can be trusted. [m s⁻¹]

    The votes whose line passes a position are compared. Their most frequent velocity is trusted if it is
    fast, has `MIN_VOTES`, and `MIN_RATIO` times as many as the most frequent other one.
    """
    velocity, trusted = np.zeros((len(position), 2)), np.zeros(len(position), bool)
    if len(flow.time_s) < MIN_VOTES or not len(position):
        return velocity, trusted
    unit = flow.velocity / np.hypot(*flow.velocity.T)[:, None]
    for k, near in enumerate(KDTree(flow.place).query_ball_point(position, REACH_M)):
        off = position[k] - flow.place[near]
        own = unit[near]
        votes = flow.velocity[near][np.abs(off[:, 0] * own[:, 1] - off[:, 1] * own[:, 0]) < ACROSS_M]
        if len(votes) < MIN_VOTES:
            continue
        tree = KDTree(votes)
        count = tree.query_ball_point(votes, SAME_M_S, return_length=True)
        best = int(np.argmax(count))
        apart = np.hypot(*(votes - votes[best]).T)
        mean = votes[apart < SAME_M_S].mean(axis=0)
        others = count[apart > OTHER_M_S].max(initial=0)
        velocity[k] = mean
        trusted[k] = count[best] >= max(MIN_VOTES, MIN_RATIO * others) and np.hypot(*mean) > MIN_FLOW_M_S
    return velocity, trusted


def count_votes(
    flow: Flow, position: Float[Array, "track 2"], velocity: Float[Array, "track 2"], time_s: float
) -> Float[Array, "track"]:
    """Count the votes of other vehicles for the velocity of a track, on its line. [1]

    A vote whose vehicle would now be at the track's position is the track's own.
    """
    out = np.zeros(len(position))
    if not len(flow.time_s) or not len(position):
        return out
    tree = KDTree(np.c_[flow.place / REACH_M, flow.velocity / SAME_M_S])
    now = flow.place + flow.velocity * (time_s - flow.time_s)[:, None]
    unit = flow.velocity / np.hypot(*flow.velocity.T)[:, None]
    near = tree.query_ball_point(np.c_[position / REACH_M, velocity / SAME_M_S], 1.0, p=np.inf)
    for k, votes in enumerate(near):
        off, own = position[k] - flow.place[votes], unit[votes]
        line = np.abs(off[:, 0] * own[:, 1] - off[:, 1] * own[:, 0]) < ACROSS_M
        out[k] = np.sum(line & (np.hypot(*(now[votes] - position[k]).T) > OWN_M))
    return out
