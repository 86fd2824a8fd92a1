"""Which vehicles detections found, and P_D at a stated number of false detections a frame."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.core.arrays import Array

REACH_M = 4.0  # of a detection from its vehicle's middle, or half its length and a metre
FALSE_M = 5.0  # farther from every vehicle a detection is false


class Scored(NamedTuple):
    """Best score among the detections of each vehicle (−∞ for none), and the scores of false detections."""

    vehicle: Float[Array, "vehicle"]
    false: Float[Array, "detection"]


def score_detections(
    position: Float[Array, "detection 2"],
    score: Float[Array, "detection"],
    vehicle_m: Float[Array, "vehicle 2"],
    length_m: Float[Array, "vehicle"],
) -> Scored:
    """Give each detection to the nearest vehicle in reach; it is false if no vehicle, moving or not, is near.

    Parameters
    ----------
    position, score
        Of the detections. [m, 1]
    vehicle_m, length_m
        Middles and lengths of all vehicles of the truth. [m]
    """
    best = np.full(len(vehicle_m), -np.inf)
    owner, false = owners(position, vehicle_m, length_m)
    owned = owner >= 0
    np.maximum.at(best, owner[owned], np.asarray(score, float)[owned])
    return Scored(best, np.asarray(score, float)[false])


def owners(
    position: Float[Array, "detection 2"],
    vehicle_m: Float[Array, "vehicle 2"],
    length_m: Float[Array, "vehicle"],
) -> tuple[Int[Array, "detection"], Bool[Array, "detection"]]:
    """Nearest vehicle in reach of each detection, −1 for none; and whether none is near: it is false."""
    if not len(position) or not len(vehicle_m):
        return np.full(len(position), -1), np.ones(len(position), np.bool_)
    distance = np.hypot(*(position[:, None] - vehicle_m[None]).transpose(2, 0, 1))
    within = distance <= np.maximum(REACH_M, length_m / 2 + 1.0)
    owner = np.where(within, distance, np.inf).argmin(axis=1)
    near = distance <= np.maximum(FALSE_M, length_m / 2 + 1.0)
    return np.where(within.any(axis=1), owner, -1), ~near.any(axis=1)


class Threshold(NamedTuple):
    """A score to detect above, and which part of those that score just that counts as detected too."""

    least: float
    tied: float

    def detected(self, scores: Float[Array, "_"]) -> Float[Array, "_"]:
        """1 for what is detected, 0 for what is not, a part for a tie. [1]"""
        scores = np.asarray(scores, float)
        return np.where(scores > self.least, 1.0, np.where(scores == self.least, self.tied, 0.0))


def threshold(false: list[Float[Array, "detection"]], false_per_frame: float) -> Threshold:
    """Score above which so many detections a frame are false; −∞ if there are fewer.

    Of detections that all score the same, a detector's capped contrast, a part is taken: that of the line
    between the two points of its receiver operating characteristic.

    Raises
    ------
    ValueError
        If no false detection is allowed.
    """
    if not false_per_frame > 0:
        raise ValueError(f"`false_per_frame` must be greater than 0, got {false_per_frame:g}")
    scores = np.sort(np.concatenate(false))[::-1]
    allowed = int(false_per_frame * len(false))
    if allowed >= len(scores):
        return Threshold(-np.inf, 0.0)
    least = float(scores[allowed])
    above, same = int((scores > least).sum()), int((scores == least).sum())
    return Threshold(least, (allowed - above) / same)


def held_by_oracle(
    detected: Bool[Array, "time"], times_s: Float[Array, "time"], hits: int, window: int, age_s: float,
    coast_s: float,
) -> Bool[Array, "time"]:  # fmt: skip
    """When a vehicle is held if its detections are associated by truth under a tracker's own rules.

    Confirmed when so many of the last frames, this one with them, detected it over at least the least age;
    then until it was not detected for longer than the track may coast.

    Parameters
    ----------
    detected, times_s
        Whether each frame detected it. [s]
    hits, window
        Of a confirmation: M of N frames.
    age_s, coast_s
        Least age at confirmation, and how long a track coasts. [s]
    """
    out = np.zeros(len(detected), np.bool_)
    since = last = None
    held = False
    for k, found in enumerate(detected):
        if last is not None and times_s[k] - last > coast_s + 1e-9 and not found:
            since, held = None, False
        if found:
            last = times_s[k]
            since = last if since is None else since
        recent = detected[max(k - window + 1, 0) : k + 1]
        if found and not held and since is not None:
            held = bool(recent.sum() >= hits and times_s[k] - since >= age_s - 1e-9)
        out[k] = held
    return out
