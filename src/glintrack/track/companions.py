"""Tracks that follow one vehicle: the ends of a lorry or a bus, or its roof and its shadow.

A long or tall vehicle is detected in more than one place, and each place gets a track. Two vehicles that
drive keep a distance in line, and abreast they do not stay alike; two tracks of one vehicle do. Such tracks
are followed apart, since detections of both come, and reported as one, in their middle, under the oldest's
id. What goes together for two frames stays together while it is near, for the speeds of two ends differ by
what is detected of each.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from glintrack.core.arrays import Array
from glintrack.track.initiation import Targets, rows_among

# chosen on quickstart 11 and 12 and braunschweig 11: of pairs so near and so alike three in four are of one
# vehicle there
FOUND_M, ALIKE_M_S, SLOWEST_M_S = 8.0, 6.0, 6.0
ASIDE_M, AHEAD_M = 3.0, 4.0  # a pair in line is no farther aside, one abreast no farther ahead
SURE_FRAMES, KEPT_M = 2, 12.0
MOST_MISSES = 1  # what is out of sight for longer begins no pair


@dataclass(frozen=True)
class Companions:
    """Pairs of tracks that follow one vehicle.

    Parameters
    ----------
    pair
        Ids, the older first; rows rise.
    frames
        In how many frames each was found to go together.
    """

    pair: Int[Array, "pair 2"]
    frames: Int[Array, "pair"]


def no_companions() -> Companions:
    """No pair."""
    return Companions(np.empty((0, 2), np.int64), np.empty(0, np.int64))


def after(before: Companions, targets: Targets) -> Companions:
    """The pairs after an epoch: those found in it, and sure ones that are still near.

    Parameters
    ----------
    before
        Pairs after the epoch before.
    targets
        After this one.
    """
    found = targets.id[_found(targets)]
    pair, which = np.unique(np.concatenate([found, before.pair]), axis=0, return_inverse=True)
    which = which.reshape(-1)
    frames = np.bincount(which, np.r_[np.ones(len(found)), before.frames], len(pair)).astype(np.int64)
    now = np.bincount(which[: len(found)], minlength=len(pair)) > 0
    row, alive = _rows(targets, pair)
    near = np.zeros(len(pair), bool)
    near[alive] = np.hypot(*(targets.position[row[alive, 0]] - targets.position[row[alive, 1]]).T) < KEPT_M
    kept = alive & (now | ((frames >= SURE_FRAMES) & near))
    return Companions(pair[kept], frames[kept])


def leaders(companions: Companions, targets: Targets) -> Int[Array, "target"]:
    """Index of the oldest target on each one's vehicle; its own for most."""
    of = np.arange(len(targets))
    row, alive = _rows(targets, companions.pair)
    row = row[alive]
    for older, younger in row[np.lexsort((row[:, 0], row[:, 1]))]:
        if of[older] == older and of[younger] == younger:
            of[younger] = older
    return of


def in_the_middle(targets: Targets, leader: Int[Array, "target"]) -> Targets:
    """The targets, each leader moved to the mean place of all that it leads, itself with them."""
    many = np.maximum(np.bincount(leader, minlength=len(targets)), 1)
    sums = [np.bincount(leader, targets.position[:, k], len(targets)) for k in range(2)]
    led = leader == np.arange(len(targets))
    shift = np.where(led[:, None], np.stack(sums, axis=-1) / many[:, None] - targets.position, 0.0)
    shift[many == 1] = 0.0  # to the last digit
    return replace(targets, mean=_moved(targets.mean, shift), mode_mean=_moved(targets.mode_mean, shift))


def _moved(mean: Float[Array, "target *mode 4"], shift: Float[Array, "target 2"]):
    out = mean.copy()
    out[..., :2] += shift if mean.ndim == 2 else shift[:, None]
    return out


def _found(targets: Targets) -> Int[Array, "pair 2"]:
    """Indices of the confirmed targets that go together at this epoch, the older first."""
    there = np.flatnonzero(targets.confirmed & (targets.misses <= MOST_MISSES))
    if len(there) < 2:
        return np.empty((0, 2), np.int64)
    near = KDTree(targets.position[there]).query_pairs(FOUND_M, output_type="ndarray").reshape(-1, 2)
    a, b = np.sort(there[near], axis=1).T
    velocity = 0.5 * (targets.mean[a, 2:] + targets.mean[b, 2:])
    speed, apart = np.hypot(*velocity.T), targets.position[b] - targets.position[a]
    unit = velocity / np.maximum(speed, 1e-9)[:, None]
    ahead_m = np.abs((apart * unit).sum(axis=1))
    aside_m = np.abs(apart[:, 1] * unit[:, 0] - apart[:, 0] * unit[:, 1])
    alike = np.hypot(*(targets.mean[a, 2:] - targets.mean[b, 2:]).T) < ALIKE_M_S
    together = alike & (speed > SLOWEST_M_S) & ((ahead_m <= AHEAD_M) | (aside_m <= ASIDE_M))
    return np.stack([a, b], axis=-1)[together]


def _rows(targets: Targets, pair: Int[Array, "pair 2"]):
    """Index of both targets of each pair, and whether both live."""
    row, alive = rows_among(targets.id, pair)
    return row, alive.all(axis=1)
