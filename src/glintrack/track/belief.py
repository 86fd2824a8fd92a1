"""Whether a track is a vehicle: log odds from what the tracker observes, by which tracks are reported.

Confirming asks whether there is something to follow, and may be generous; reporting asks whether it is a
vehicle where it is thought to be, and may change its mind every frame. What is followed beside vehicles
differs in what the detections say over time, in how it moves, and in that it goes beside another track: ends
and shadows of long vehicles, and tracks that lost theirs. The law is of the detector `mosaic`; ``python
tools/calibrate_belief.py`` fits it.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from scipy.special import expit

from glintrack.core.arrays import Array
from glintrack.track.initiation import Targets

FEATURES = (
    "misses", "trust", "surety", "slow", "escorted", "crowded", "trust · crowded", "stray · crowded", "age",
    "stray · age",
)  # fmt: skip
# calibrated: of each channel an intercept, and a weight of each of `FEATURES`
LAW = {
    "pan": (1.75, -0.18, 1.03, -0.56, -0.23, -1.51, -2.06, -0.68, 0.36, 0.23, -0.11),
    "dolp": (1.12, -0.38, 0.91, -0.33, -0.21, -1.28, -2.17, -0.76, 0.36, 0.27, -0.07),
    "all": (1.91, -0.39, 0.79, -0.31, -0.27, -1.65, -1.55, -0.88, 0.37, 0.16, -0.10),
}
# end of what is calibrated
LEAST_ODDS = -0.7  # no track is reported that is twice as likely to be false
MOST_MISSES = 2.0  # a track missed for longer is in no worse a state
SLOW_M_S, OLDEST_S = 6.0, 5.0
NEAR_M, ALIKE_M_S = 12.0, 4.0
_NEIGHBOURS = 8  # of a track, at most, that are looked at


def log_odds(channel: str, targets: Targets) -> Float[Array, "target"]:
    """Log odds that each target is a vehicle which moves about where it is thought to be. [nat]

    Parameters
    ----------
    channel
        ``pan``, ``dolp`` or ``all``.
    targets
        All: what is confirmed among them counts as their neighbours.
    """
    intercept, *weights = LAW[channel]
    return intercept + features(targets) @ np.array(weights)


def led_odds(channel: str, targets: Targets, leader: Int[Array, "target"]) -> Float[Array, "target"]:
    """Log odds of each target, of one that is reported for others those of the likeliest of them. [nat]

    Parameters
    ----------
    channel, targets
        As of `log_odds`.
    leader
        Index of the one that is reported for all on its vehicle (`companions.leaders`).
    """
    own = log_odds(channel, targets)
    odds = own.copy()
    np.maximum.at(odds, leader, own)
    return odds


def surest(
    odds: Float[Array, "target"], candidate: Bool[Array, "target"], false_share: float
) -> Bool[Array, "target"]:
    """Which targets to report: the likeliest, as long as no greater share of them is expected to be false.

    Parameters
    ----------
    odds
        Log odds that each is a vehicle. [nat]
    candidate
        Which of them may be reported.
    false_share
        Expected share of false ones among those reported.
    """
    order = np.flatnonzero(candidate & (odds >= LEAST_ODDS))
    order = order[np.argsort(-odds[order], kind="stable")]
    out = np.zeros(len(odds), bool)
    told = np.arange(1, len(order) + 1)
    out[order[np.cumsum(expit(-odds[order])) <= false_share * told]] = True
    return out


def features(targets: Targets) -> Float[Array, "target feature"]:
    """`FEATURES` of each target.

    Frames since it was measured; what its detections said lately (`Targets.trust`), and that where it speaks
    for a vehicle; by how much it is slower than 6 m/s; how near the nearest confirmed track is that moves
    alike, and the nearest of any, from 0 at 12 m to 1; its age up to 5 s; and by how much its way from where
    it began is shorter than 6 m/s would make it (stray), which counts more the older it is.
    """
    speed = np.hypot(targets.mean[:, 2], targets.mean[:, 3])
    way_m = np.hypot(*(targets.position - targets.born).T)
    stray = np.maximum(SLOW_M_S - way_m / np.maximum(targets.age_s, 1.0), 0.0)
    age, trust = np.minimum(targets.age_s, OLDEST_S), targets.trust
    escorted, crowded = _nearness(targets)
    columns = [
        np.minimum(targets.misses, MOST_MISSES), trust, np.maximum(trust, 0.0),
        np.maximum(SLOW_M_S - speed, 0.0), escorted, crowded, trust * crowded, stray * crowded, age,
        stray * age,
    ]  # fmt: skip
    return np.stack(columns, axis=-1).astype(float)


def _nearness(targets: Targets) -> tuple[Float[Array, "target"], Float[Array, "target"]]:
    """Of each target to the nearest other confirmed one that moves alike, and to the nearest of any."""
    alike, any_ = np.zeros(len(targets)), np.zeros(len(targets))
    there = np.flatnonzero(targets.confirmed & (targets.misses <= 1))
    if len(there) == 0:
        return alike, any_
    nearest: Any = np.arange(1, min(_NEIGHBOURS + 1, len(there)) + 1)
    tree = KDTree(targets.position[there])
    distance, which = tree.query(targets.position, k=nearest, distance_upper_bound=NEAR_M)
    found = np.isfinite(distance)
    other = there[np.where(found, which, 0)]
    found &= other != np.arange(len(targets))[:, None]
    nearness = np.where(found, 1 - distance / NEAR_M, 0.0)
    apart = targets.mean[other, 2:] - targets.mean[:, None, 2:]
    same = np.hypot(apart[..., 0], apart[..., 1]) < ALIKE_M_S
    return np.where(same, nearness, 0.0).max(axis=1), nearness.max(axis=1)
