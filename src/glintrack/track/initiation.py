"""Targets as arrays: how they are born, confirmed, kept and dropped."""

import math
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from glintrack.core.arrays import Array
from glintrack.track.design import TrackDesign
from glintrack.track.detect.detections import Detections
from glintrack.track.detect.frame import Grid
from glintrack.track.motion import COAST_DAMPING_S, Modes, Motion, combined, newborn_modes

TENTATIVE_MISSES = 1  # consecutive frames that an unconfirmed track may miss
STOPPED_SPEED_M_S = 1.5  # a slower track stands, with one mode of motion
TRUST_S = 1.2  # in which a track's trust follows its detections
MISSED_NAT = -3.0  # what a frame without one counts as
DUPLICATE_SPEED_M_S = 3.0  # two tracks on one vehicle differ less
_ROUNDING = 1e-9
APART_M = 4.0  # of a detection from every confirmed track that is another vehicle at first sight


@dataclass(frozen=True)
class Targets:
    """Everything known about each target, confirmed or not.

    Parameters
    ----------
    id
        Never reused; rising.
    mean, covariance
        Kalman state ``[east, north, east speed, north speed]``, over all modes. [m, m s⁻¹]
    mode_mean, mode_covariance, mode_probability
        The same by mode of motion, as `Modes`.
    born
        First position. [m]
    score
        Log-likelihood ratio of target against clutter since it was last 0 (Page's test). [nat]
    history
        One bit per past frame, the latest lowest; 1 where a detection was assigned.
    age_s
        Since the first detection. [s]
    unseen_s, misses
        Time and frames since a detection was assigned. [s]
    confirmed
        Reported.
    feature, spectra
        Mean spectral feature and number of spectra it comes from.
    frames_since_query
        Frames since a spectrum was asked for (or, if asked of detections, came), or since birth.
    quality
        What is left of the belief that a target out of sight still is where it is thought: 1 after it was
        followed for long, 0 when it is given up. [1]
    trust
        What its detections' likelihood ratios were lately, in the mean; frames without one count as
        `MISSED_NAT`. [nat]
    """

    id: Int[Array, "target"]
    mean: Float[Array, "target 4"]
    covariance: Float[Array, "target 4 4"]
    mode_mean: Float[Array, "target mode 4"]
    mode_covariance: Float[Array, "target mode 4 4"]
    mode_probability: Float[Array, "target mode"]
    born: Float[Array, "target 2"]
    score: Float[Array, "target"]
    history: Int[Array, "target"]
    age_s: Float[Array, "target"]
    unseen_s: Float[Array, "target"]
    misses: Int[Array, "target"]
    confirmed: Bool[Array, "target"]
    feature: Float[Array, "target feature"]
    spectra: Float[Array, "target"]
    frames_since_query: Int[Array, "target"]
    quality: Float[Array, "target"]
    trust: Float[Array, "target"]

    def __len__(self) -> int:
        """Count of targets."""
        return len(self.id)

    @property
    def position(self) -> Float[Array, "target 2"]:
        """East and north. [m]"""
        return self.mean[:, :2]

    @property
    def modes(self) -> Modes:
        """What is believed by mode of motion."""
        return Modes(self.mode_mean, self.mode_covariance, self.mode_probability)

    def moved(self, modes: Modes) -> "Targets":
        """The same targets with another belief of where they are."""
        mean, covariance = combined(modes)
        return replace(
            self, mean=mean, covariance=covariance, mode_mean=modes.mean, mode_covariance=modes.covariance,
            mode_probability=modes.probability,
        )  # fmt: skip


_NAMES = tuple(field.name for field in fields(Targets))
_NAMES_OF_ONE = tuple(name for name in _NAMES if name not in ("mean", "covariance"))


def no_targets(design: TrackDesign) -> Targets:
    """Nothing known."""
    modes = newborn_modes(np.empty((0, 2)), np.empty((0, 2, 2)), np.empty((0, 2, 2)), design.motion.modes)
    return _new_targets(np.empty(0, np.int64), modes, np.empty((0, design.identity.bins)), np.empty(0))


def _new_targets(
    ids: Int[Array, "target"],
    modes: Modes,
    spectral: Float[Array, "target feature"],
    ratio: Float[Array, "target"],
) -> Targets:
    """Unconfirmed targets detected once, with their spectra and the likelihood ratio of the detection."""
    n, (mean, covariance) = len(ids), combined(modes)
    known = np.asarray(np.isfinite(spectral).all(axis=1))
    return Targets(
        id=ids,
        mean=mean,
        covariance=covariance,
        mode_mean=modes.mean,
        mode_covariance=modes.covariance,
        mode_probability=modes.probability,
        born=mean[:, :2].copy(),
        score=np.zeros(n),
        history=np.ones(n, np.int64),
        age_s=np.zeros(n),
        unseen_s=np.zeros(n),
        misses=np.zeros(n, np.int64),
        confirmed=np.zeros(n, bool),
        feature=np.where(known[:, None], spectral, 0.0),
        spectra=known.astype(float),
        frames_since_query=np.zeros(n, np.int64),
        quality=np.zeros(n),
        trust=ratio,
    )


def confirmation(design: TrackDesign, interval_s: float) -> tuple[int, int]:
    """M and N of the confirmation at this frame rate."""
    rules = design.initiation
    fit = int(rules.confirm_s / interval_s + 1e-6) + 1 if interval_s > 0 else 1
    window = min(max(rules.confirm_window, fit), 32)
    return math.ceil(rules.confirm_hits / rules.confirm_window * window - 1e-9), window


def hits_of(history: Int[Array, "target"]) -> Int[Array, "target"]:
    """Count the frames in a history that measured the target."""
    return np.bitwise_count(history).astype(np.int64)


def prune(design: TrackDesign, targets: Targets, grid: Grid) -> Targets:
    """Targets that live on: not lost, not off the grid, not a weaker duplicate of another."""
    rules = design.initiation
    tentative = (targets.misses <= TENTATIVE_MISSES) | (targets.unseen_s <= rules.tentative_s + _ROUNDING)
    alive = np.where(targets.confirmed, targets.quality > -_ROUNDING, tentative)
    (rows, columns), (row, column) = grid.shape, grid.pixel_of(targets.position)
    alive &= (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    index = np.flatnonzero(alive)
    if len(index) > 1:
        index = index[_without_duplicates(select(targets, index), rules.duplicate_m)]
    return targets if len(index) == len(targets) else select(targets, index)


def _without_duplicates(targets: Targets, distance_m: float) -> Bool[Array, "target"]:
    """Which targets are no weaker duplicate of one that lives on.

    Two near targets that move alike are one vehicle. Better is confirmed, then measured, then older; a
    target's index rises as its age falls.
    """
    alive = np.ones(len(targets), bool)
    pair = KDTree(targets.position).query_pairs(distance_m, output_type="ndarray").reshape(-1, 2)
    apart = targets.mean[pair[:, 0], 2:] - targets.mean[pair[:, 1], 2:]
    pair = pair[np.hypot(*apart.T) <= DUPLICATE_SPEED_M_S]
    rank = (2 * ~targets.confirmed + (targets.misses > 0)) * len(targets) + np.arange(len(targets))
    better = rank[pair[:, 0]] < rank[pair[:, 1]]
    pair = np.where(better[:, None], pair, pair[:, ::-1])
    for best, other in pair[np.argsort(rank[pair[:, 0]], kind="stable")]:
        alive[other] &= not alive[best]
    return alive


def followed(
    design: TrackDesign,
    targets: Targets,
    motion: Motion,
    assigned: Int[Array, "target"],
    memory: tuple[Float[Array, "target feature"], Float[Array, "target"]],
    interval_s: float,
) -> Targets:
    """Targets after one more epoch: what counts since when they were seen, and who is confirmed.

    Parameters
    ----------
    design, motion
        Of the tracker, and over the interval.
    targets
        After their detections, with the score of this epoch and all else as it was before.
    assigned
        Detection of each, −1 for none.
    memory
        Mean feature of each and from how many spectra, after this epoch.
    interval_s
        Since the frame before. [s]
    """
    rules, (hits, window) = design.initiation, confirmation(design, interval_s)
    hit, age_s = assigned >= 0, targets.age_s + interval_s
    history = ((targets.history << 1) | hit) & ((1 << window) - 1)
    confirmed = targets.confirmed | (
        hit
        & (hits_of(history) >= hits)
        & (age_s >= rules.confirm_s - _ROUNDING)
        & (targets.score >= rules.confirm_score)
        & (np.hypot(*(targets.position - targets.born).T) >= rules.confirm_travel_m)
        & (np.hypot(*targets.mean[:, 2:].T) >= rules.confirm_speed_m_s)
    )
    frames_since_query = targets.frames_since_query
    if design.query.at == "detection":  # else `query_predictions` knows who was asked
        frames_since_query = np.where(memory[1] > targets.spectra, 0, frames_since_query + 1)
    return replace(
        targets, history=history, confirmed=confirmed, age_s=age_s, frames_since_query=frames_since_query,
        unseen_s=np.where(hit, 0.0, targets.unseen_s + interval_s),
        misses=np.where(hit, 0, targets.misses + 1),
        feature=memory[0], spectra=memory[1],
        quality=track_quality(design, targets, motion, assigned, interval_s),
    )  # fmt: skip


def trust_after(
    trust: Float[Array, "target"], found: Detections, assigned: Int[Array, "target"], interval_s: float
) -> Float[Array, "target"]:
    """`Targets.trust` after one more epoch; 0 where detections say nothing of themselves. [nat]"""
    if found.log_likelihood_ratio is None:
        return trust
    told = np.append(found.log_likelihood_ratio, MISSED_NAT)[assigned]
    return trust - math.expm1(-interval_s / TRUST_S) * (told - trust)


def track_quality(
    design: TrackDesign,
    targets: Targets,
    motion: Motion,
    assigned: Int[Array, "target"],
    interval_s: float,
) -> Float[Array, "target"]:
    """Trust after one more epoch: it fills while a target is measured and drains while it is not.

    One false blob at the place of a track that waits buys it a short wait, not all of it anew.

    Parameters
    ----------
    design, motion
        Of the tracker, and over the interval.
    targets
        After their detections, with the quality they had before.
    assigned
        Detection of each, −1 for none.
    interval_s
        Since the frame before. [s]
    """
    if motion.stopped >= 0:
        stands = targets.mode_probability[:, motion.stopped]
    else:  # damping has slowed a coasting target: what counts is how fast it was when last measured
        speed = np.hypot(targets.mean[:, 2], targets.mean[:, 3])
        slow = speed * np.exp(targets.unseen_s / COAST_DAMPING_S) < STOPPED_SPEED_M_S
        stands = slow.astype(float)
    rules = design.initiation
    drain = interval_s * (stands / max(rules.stopped_coast_s, 1e-9) + (1 - stands) / max(rules.coast_s, 1e-9))
    filled = np.minimum(targets.quality + interval_s / rules.quality_s, 1.0)
    quality = np.where(assigned >= 0, filled, targets.quality - drain)
    return np.where(targets.confirmed, quality, np.maximum(quality, 0.0))


def unclaimed(
    design: TrackDesign,
    targets: Targets,
    position: Float[Array, "detection 2"],
    assigned: Int[Array, "target"],
) -> Int[Array, "born"]:
    """Detections that none took and that are no fragment of one taken."""
    free = np.ones(len(position), bool)
    free[assigned[assigned >= 0]] = False
    measured = targets.position[targets.misses == 0]
    if len(measured) and free.any():
        distance_m, _ = KDTree(measured).query(position)
        free &= distance_m > design.initiation.duplicate_m
    return np.flatnonzero(free)


def newborn(design, found, spectral, index, next_id, roads=None, apart_from=None) -> Targets:
    """A target for each of the detections at an index; confirmed at once only if apart from other targets."""
    n, place = len(index), found.position[index]
    speed_sigma = design.initiation.speed_sigma_m_s
    speed = np.repeat(speed_sigma**2 * np.eye(2)[None], n, axis=0)
    if roads is not None:
        speed = roads.speed_covariance(place, speed_sigma)
    follows = found.velocity is not None and found.velocity_share == 1
    if follows:
        speed = np.repeat(found.velocity_sigma_m_s**2 * np.eye(2)[None], n, axis=0)
    velocity = found.velocity[index] if follows and found.velocity is not None else None
    ratio = np.zeros(n) if found.log_likelihood_ratio is None else found.log_likelihood_ratio[index]
    modes = newborn_modes(place, found.covariance[index], speed, design.motion.modes, velocity)
    new = _new_targets(np.arange(next_id, next_id + n), modes, spectral[index], ratio)
    if found.log_likelihood_ratio is None:
        return new
    sure = (ratio >= design.initiation.confirm_ratio) & _apart(apart_from, place)
    return replace(new, confirmed=sure)


def _apart(targets: Targets | None, place: Float[Array, "n 2"]) -> Bool[Array, "n"]:
    """Places far enough from every confirmed track to be of another vehicle at first sight."""
    if targets is None or not targets.confirmed.any():
        return np.ones(len(place), bool)
    distance_m, _ = KDTree(targets.position[targets.confirmed]).query(place)
    return distance_m >= APART_M


def select(targets: Targets, index: np.ndarray) -> Targets:
    """The targets at an index or mask."""
    index = np.flatnonzero(index) if index.dtype == bool else index
    return _of({name: getattr(targets, name).take(index, axis=0) for name in _names(targets)})


def rows_among(
    ids: Int[Array, "target"], asked: Int[Array, "*any"]
) -> tuple[Int[Array, "*any"], Bool[Array, "*any"]]:
    """Row of each asked number among rising ones, any where it is not there, and whether it is."""
    if len(ids) == 0:
        return np.zeros(asked.shape, np.int64), np.zeros(asked.shape, bool)
    row = np.minimum(np.searchsorted(ids, asked), len(ids) - 1)
    return row, ids[row] == asked


def joined(a: Targets, b: Targets) -> Targets:
    """The targets of both."""
    return _of({name: np.concatenate([getattr(a, name), getattr(b, name)]) for name in _names(a)})


def _names(targets: Targets) -> tuple[str, ...]:
    """What need be copied: with one mode the state over all modes is that mode's."""
    return _NAMES if targets.mode_mean.shape[1] > 1 else _NAMES_OF_ONE


def _of(values: dict[str, Array]) -> Targets:
    if "mean" not in values:
        n = len(values["id"])
        values["mean"] = values["mode_mean"].reshape(n, 4)
        values["covariance"] = values["mode_covariance"].reshape(n, 4, 4)
    return Targets(**values)
