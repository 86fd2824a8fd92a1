"""Targets as arrays: track initiation, confirmation, coasting and deletion."""

import math
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from glintrack.core.arrays import Array
from glintrack.track.calibration import read_calibration
from glintrack.track.design import InitiationRules, TrackDesign
from glintrack.track.detect.detections import no_detections
from glintrack.track.detect.frame import Grid
from glintrack.track.flow import Flow, birth_velocity, no_flow
from glintrack.track.motion import COAST_DAMPING_S, Modes, combine_modes, initial_modes

TENTATIVE_MISSES = 1  # consecutive frames that an unconfirmed track may miss
STOPPED_SPEED_M_S = 1.5  # a slower track stands, with one mode of motion
SLOW_SPEED_M_S = 4.0  # a slower vehicle may come to stand
STOPPED_TRAVEL_M = 15.0  # a track that stands nearer to its first position may be no vehicle
STOPPED_RATIO = -1.5  # nor may one with a lower mean ratio [nat]: a roof or crown in parallax
RECENT_RATIO_S = 1.2  # time constant of a track's mean likelihood ratio
MISSED_NAT = -3.0  # likelihood ratio of a frame without a detection
DUPLICATE_SPEED_M_S = 3.0  # two tracks on one vehicle differ less
_ROUNDING = 1e-9
SURE_AGE_S, PRIOR_TRACKS = 2.0, 10  # age of the tracks that tell the speed of traffic; see `speed_sigma`
APART_M = 4.0  # a first detection farther from every confirmed track is of another vehicle


@dataclass(frozen=True)
class Targets:
    """State of each target, confirmed or not.

    Parameters
    ----------
    id
        Identity. Identities rise and are never reused.
    mean, covariance
        Kalman state ``[east, north, east speed, north speed]``, over all modes. [m, m s⁻¹]
    mode_mean, mode_covariance, mode_probability
        The same by mode of motion, as `Modes`.
    first_position
        First position. [m]
    score
        Log-likelihood ratio of target against clutter since it was last 0 (Page's test). [nat]
    history
        One bit per past frame, the latest lowest; 1 where a detection was assigned.
    age_s
        Time since the first detection. [s]
    unseen_s, misses
        Time and frames since a detection was assigned. [s]
    confirmed
        True for a confirmed target. With `reporting.method = "confirmation"` it is also reported; with
        "existence" it is a candidate for reporting.
    feature, spectra
        Mean spectral feature and number of spectra it comes from.
    quality
        Share of the coasting time that is left: 1 after a long time of measurements, 0 at deletion. [1]
    recent_ratio
        Recent mean of its detections' log-likelihood ratios; frames without one count as `MISSED_NAT`. It
        stays as it is while the target stands. [nat]
    """

    id: Int[Array, "target"]
    mean: Float[Array, "target 4"]
    covariance: Float[Array, "target 4 4"]
    mode_mean: Float[Array, "target mode 4"]
    mode_covariance: Float[Array, "target mode 4 4"]
    mode_probability: Float[Array, "target mode"]
    first_position: Float[Array, "target 2"]
    score: Float[Array, "target"]
    history: Int[Array, "target"]
    age_s: Float[Array, "target"]
    unseen_s: Float[Array, "target"]
    misses: Int[Array, "target"]
    confirmed: Bool[Array, "target"]
    feature: Float[Array, "target feature"]
    spectra: Float[Array, "target"]
    quality: Float[Array, "target"]
    recent_ratio: Float[Array, "target"]

    def __len__(self) -> int:
        """Count of targets."""
        return len(self.id)

    @property
    def position(self) -> Float[Array, "target 2"]:
        """East and north. [m]"""
        return self.mean[:, :2]

    @property
    def travel_m(self) -> Float[Array, "target"]:
        """Distance from the first position. [m]"""
        return np.hypot(*(self.position - self.first_position).T)

    @property
    def modes(self) -> Modes:
        """State by mode of motion."""
        return Modes(self.mode_mean, self.mode_covariance, self.mode_probability)

    def with_modes(self, modes: Modes) -> "Targets":
        """Return the targets with another state."""
        mean, covariance = combine_modes(modes)
        return replace(
            self, mean=mean, covariance=covariance, mode_mean=modes.mean, mode_covariance=modes.covariance,
            mode_probability=modes.probability,
        )  # fmt: skip


def no_targets(design: TrackDesign, features: int) -> Targets:
    """Return an empty set of targets with so many spectral features."""
    nothing = no_detections(), np.empty((0, features)), np.empty(0, np.int64)
    return initiate(design, *nothing, 0, no_flow())


def confirmation(rules: InitiationRules, interval_s: float) -> tuple[int, int]:
    """M and N of the confirmation at a frame interval. [s]"""
    fit = int(rules.confirm_min_age_s / interval_s + 1e-6) + 1 if interval_s > 0 else 1
    window = min(max(rules.confirm_window, fit), 32)
    return math.ceil(rules.confirm_hits / rules.confirm_window * window - 1e-9), window


def prune(design: TrackDesign, targets: Targets, grid: Grid) -> Targets:
    """Delete lost targets, those off the grid, and weaker duplicates of another."""
    tentative_s = design.initiation.in_use.tentative_coast_s
    tentative = (targets.misses <= TENTATIVE_MISSES) | (targets.unseen_s <= tentative_s + _ROUNDING)
    # at frame intervals of coast_s or more, a single miss does not delete a track
    first_miss = (targets.misses == 1) & (targets.unseen_s >= design.initiation.coast_s - _ROUNDING)
    alive = np.where(targets.confirmed, (targets.quality > -_ROUNDING) | first_miss, tentative)
    (rows, columns), (row, column) = grid.shape, grid.pixel_of(targets.position)
    targets = select(targets, alive & (row >= 0) & (row < rows) & (column >= 0) & (column < columns))
    if len(targets) < 2:
        return targets
    # two near targets that move alike are one vehicle; better is confirmed, then measured, then older
    alive = np.ones(len(targets), bool)
    pair = KDTree(targets.position).query_pairs(design.initiation.duplicate_m, output_type="ndarray")
    pair = pair.reshape(-1, 2)
    apart = targets.mean[pair[:, 0], 2:] - targets.mean[pair[:, 1], 2:]
    pair = pair[np.hypot(*apart.T) <= DUPLICATE_SPEED_M_S]
    rank = (2 * ~targets.confirmed + (targets.misses > 0)) * len(targets) + np.arange(len(targets))
    better = rank[pair[:, 0]] < rank[pair[:, 1]]
    pair = np.where(better[:, None], pair, pair[:, ::-1])
    for best, other in pair[np.argsort(rank[pair[:, 0]], kind="stable")]:
        alive[other] &= not alive[best]
    return select(targets, alive)


def update_status(
    design: TrackDesign,
    targets: Targets,
    seen,
    assigned: Int[Array, "target"],
    feature: Float[Array, "target feature"],
    spectra: Float[Array, "target"],
) -> Targets:
    """Update what counts since a target was measured, and confirm targets.

    Parameters
    ----------
    design
        Design in use.
    targets
        After their detections, with the score of this epoch and all else as it was before.
    seen
        `FrameDetections` of the epoch.
    assigned
        Detection of each target, −1 for none.
    feature, spectra
        Mean feature of each target and its number of spectra, after this epoch.
    """
    rules, ratio, interval_s = design.initiation.in_use, seen.found.log_likelihood_ratio, seen.interval_s
    hits, window = confirmation(rules, interval_s)
    hit, age_s, recent_ratio = assigned >= 0, targets.age_s + interval_s, targets.recent_ratio
    history = ((targets.history << 1) | hit) & ((1 << window) - 1)
    speed = np.hypot(*targets.mean[:, 2:].T)
    confirmed = targets.confirmed | (
        hit
        & (np.bitwise_count(history) >= hits)
        & (age_s >= rules.confirm_min_age_s - _ROUNDING)
        & (targets.score >= design.initiation.confirm_score)
        & (targets.travel_m >= rules.confirm_travel_m)
        & (speed >= rules.confirm_speed_m_s)
    )
    stands = standing_probability(targets, seen.motion.stopped)
    if ratio is not None:
        change = np.append(ratio, MISSED_NAT)[assigned] - recent_ratio
        # change detection forgets a vehicle that stands, and what stays at a place is often no vehicle
        change = np.where(is_stopped(targets), 0.0, change)
        recent_ratio = recent_ratio - math.expm1(-interval_s / RECENT_RATIO_S) * change
    # quality fills while a target is measured and drains while it is not: one false detection at the position
    # of a coasting track buys it a short time
    drain = interval_s * (
        stands / max(rules.stopped_coast_s, 1e-9) + (1 - stands) / max(design.initiation.coast_s, 1e-9)
    )
    quality = np.where(
        hit, np.minimum(targets.quality + interval_s / rules.coast_ramp_s, 1.0), targets.quality - drain
    )
    return replace(
        targets, history=history, confirmed=confirmed, age_s=age_s,
        unseen_s=np.where(hit, 0.0, targets.unseen_s + interval_s),
        misses=np.where(hit, 0, targets.misses + 1), feature=feature, spectra=spectra,
        recent_ratio=recent_ratio, quality=np.where(targets.confirmed, quality, np.maximum(quality, 0.0)),
    )  # fmt: skip


def standing_probability(targets: Targets, stopped: int) -> Float[Array, "target"]:
    """Probability that each target stands, given the index of that mode of motion (−1 for none). [1]"""
    if stopped >= 0:
        return targets.mode_probability[:, stopped]
    # damping has slowed a coasting target: its speed when last measured counts
    speed = np.hypot(*targets.mean[:, 2:].T) * np.exp(targets.unseen_s / COAST_DAMPING_S)
    return (speed < STOPPED_SPEED_M_S).astype(float)


def is_stopped(targets: Targets) -> Bool[Array, "target"]:
    """Return True for vehicles that probably stand after a drive."""
    stopped = targets.mode_probability.shape[1] - 1 or -1
    return (standing_probability(targets, stopped) > 0.5) & _has_driven(targets)


def is_slow(targets: Targets) -> Bool[Array, "target"]:
    """Return True for vehicles that are slow, or stand, after a drive."""
    return (np.hypot(*targets.mean[:, 2:].T) < SLOW_SPEED_M_S) & _has_driven(targets)


def _has_driven(targets: Targets) -> Bool[Array, "target"]:
    """Return True for confirmed targets that look like vehicles, far enough from their first position."""
    driven = (targets.travel_m >= STOPPED_TRAVEL_M) & (targets.recent_ratio >= STOPPED_RATIO)
    return driven & targets.confirmed


def select_unassigned(
    design: TrackDesign,
    targets: Targets,
    position: Float[Array, "detection 2"],
    assigned: Int[Array, "target"],
) -> Int[Array, "new"]:
    """Select the detections without a target that are no fragment of an assigned one."""
    free = np.ones(len(position), bool)
    free[assigned[assigned >= 0]] = False
    measured = targets.position[targets.misses == 0]
    if len(measured) and free.any():
        distance_m, _ = KDTree(measured).query(position)
        free &= distance_m > design.initiation.duplicate_m
    return np.flatnonzero(free)


def initiate(design, found, spectral, index, next_id, flow: Flow, roads=None, others=None) -> Targets:
    """Start a target for each of the detections at an index; confirm it only if apart from other targets.

    Its velocity is the detector's if that is always right, else that of the flow of traffic where it can be
    trusted, else unknown: see `speed_sigma`.
    """
    n, place, ratio = len(index), found.position[index], found.log_likelihood_ratio
    velocity = None if found.velocity is None or found.velocity_share < 1 else found.velocity[index]
    sigma_m_s = speed_sigma(design, others) if velocity is None else found.velocity_sigma_m_s
    speed = np.repeat(sigma_m_s**2 * np.eye(2)[None], n, axis=0)
    if roads is not None and velocity is None:
        speed = roads.speed_covariance(place, sigma_m_s)
    if velocity is None and design.initiation.flow_velocity:
        velocity, trusted = birth_velocity(flow, place)
        velocity[~trusted] = 0.0
        speed[trusted] = read_calibration("flow").constants["sigma_m_s"] ** 2 * np.eye(2)
    ratio = None if ratio is None else ratio[index]
    modes = initial_modes(place, found.covariance[index], speed, design.motion.modes, velocity)
    mean, covariance = combine_modes(modes)
    known = np.asarray(np.isfinite(spectral[index]).all(axis=1))
    new = Targets(
        id=np.arange(next_id, next_id + n), mean=mean, covariance=covariance, mode_mean=modes.mean,
        mode_covariance=modes.covariance, mode_probability=modes.probability,
        first_position=mean[:, :2].copy(), score=np.zeros(n), history=np.ones(n, np.int64), age_s=np.zeros(n),
        unseen_s=np.zeros(n), misses=np.zeros(n, np.int64), confirmed=np.zeros(n, bool),
        feature=np.where(known[:, None], spectral[index], 0.0), spectra=known.astype(float),
        quality=np.zeros(n),
        recent_ratio=np.zeros(n) if ratio is None else ratio,
    )  # fmt: skip
    if ratio is None:
        return new
    sure = ratio >= design.initiation.in_use.confirm_ratio
    if others is not None and others.confirmed.any():
        sure &= KDTree(others.position[others.confirmed]).query(place)[0] >= APART_M
    return replace(new, confirmed=sure)


def speed_sigma(design: TrackDesign, others: Targets | None) -> float:
    """Compute the standard deviation of each velocity component of a vehicle that is not yet known. [m s⁻¹]

    It is that of the design, or less where the confirmed tracks are slower: a wide gate reaches the next
    vehicle of a queue. The value of the design counts as `PRIOR_TRACKS` more tracks.
    """
    limit = design.initiation.speed_sigma_m_s
    if others is None:
        return limit
    known = others.mean[others.confirmed & (others.age_s >= SURE_AGE_S), 2:]
    square = (known**2).sum() / 2 + PRIOR_TRACKS * limit**2
    return min(limit, math.sqrt(square / (len(known) + PRIOR_TRACKS)))


def select(targets: Targets, index: np.ndarray) -> Targets:
    """Select the targets at an index or mask."""
    return Targets(**{field.name: getattr(targets, field.name)[index] for field in fields(Targets)})


def find_rows(
    ids: Int[Array, "target"], wanted: Int[Array, "*any"]
) -> tuple[Int[Array, "*any"], Bool[Array, "*any"]]:
    """Find the row of each wanted id among rising ids, and the mask of ids found."""
    if len(ids) == 0:
        return np.zeros(wanted.shape, np.int64), np.zeros(wanted.shape, bool)
    row = np.minimum(np.searchsorted(ids, wanted), len(ids) - 1)
    return row, ids[row] == wanted


def concatenate(first: Targets, second: Targets) -> Targets:
    """Concatenate two sets of targets."""
    names = (field.name for field in fields(Targets))
    return Targets(
        **{name: np.concatenate([getattr(one, name) for one in (first, second)]) for name in names}
    )
