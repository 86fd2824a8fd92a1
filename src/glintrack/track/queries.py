"""Plan queries for spectra: of predictions in the next frame, or of detections at once.

One pixel of a column serves one query. A target that spans several columns may be queried in any of them. The
sets of targets that can be queried together are then the independent sets of a transversal matroid, limited
by the budget. The greedy choice by falling priority is optimal. A target is chosen if an augmenting path
gives each chosen target its own column (Edmonds and Fulkerson, J. Res. NBS 69B, 147, 1965).
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from scipy.special import entr, expit, ndtr

from glintrack.core.arrays import Array
from glintrack.core.records import SpectralQuery
from glintrack.track import assignment, identity, update
from glintrack.track.design import TrackDesign
from glintrack.track.frame_detections import FrameDetections, TrackerState, predict_targets
from glintrack.track.initiation import Targets, select
from glintrack.track.motion import mahalanobis_squared, motion_model

ColumnOf = Callable[[Float[Array, "point 3"]], Int[Array, "point"]]
FRAMES_AHEAD = 1.0  # at which a spectrum will be compared with later ones
BIRTH_SCORE = 4.0  # nat; score at which a track is as likely as not to be a vehicle
GROUND_AHEAD_M, GROUND_CLEAR_M, GROUND_SPEED_M_S = 8.0, 6.0, 3.0
GROUND_SHARE, MAX_GROUND = 5, 4  # one query in so many is of the ground, with so many a frame at most
REACH_M = 1.2  # from a target's centre along its track to its other two candidate points
MIN_HEADING_M_S = 0.5  # slower, a velocity does not give a heading


def query_predictions(state: TrackerState, column_of: ColumnOf | None) -> tuple[SpectralQuery, ...]:
    """Plan the queries of the next frame, expected one interval later; `step` does this itself.

    Parameters
    ----------
    state
        `TrackerState` from `step_detections`.
    column_of
        See `step`.

    Returns
    -------
    The queries: none if the design queries detections (`query_detections`).
    """
    design = state.design
    asks = design.query.policy != "none" and design.query.at == "prediction"
    if column_of is None or state.interval_s == 0 or not asks:
        return ()
    promising = np.bitwise_count(state.targets.history) >= 2
    motion = motion_model(design, state.interval_s)
    targets = predict_targets(select(state.targets, promising), motion)
    if design.query.policy == "entropy":
        detected = targets.mode_probability @ motion.detection
        priority = prediction_gain(targets, detected, state.population, design)
    else:
        priority = _random_priority(state, len(targets))
    spots = candidate_points(targets.position, targets.mean[:, 2:])
    return _plan_with_ground(state, targets, spots, targets.id, priority, column_of)


def query_detections(
    state: TrackerState, seen: FrameDetections, column_of: ColumnOf | None
) -> tuple[SpectralQuery, ...]:
    """Plan the queries of a frame's detections, before their association.

    Parameters
    ----------
    state
        `TrackerState` before the frame, of a design with ``query.at = "detection"``; other designs have no
        queries here.
    seen
        The frame, from `detect_frame`; `step` takes it, and the spectra, next.
    column_of
        See `step`.

    Raises
    ------
    ValueError
        If the detections are of another state.

    Notes
    -----
    With multi-hypothesis tracking only the best hypothesis has queries.
    """
    seen.check(state)
    design, found = state.design, seen.found
    if design.query.policy == "none" or column_of is None or design.query.at != "detection" or not len(found):
        return ()
    targets, share_seen = seen.predicted, seen.in_view
    if state.leaves is not None:
        targets, share_seen = select(targets, state.leaves.chosen), share_seen[state.leaves.chosen]
    no_spectra = np.full((len(found), len(state.population.mean)), np.nan)
    evidence = update.spectral_evidence(state, no_spectra)
    costs = update.association_costs(state, seen, targets, share_seen, evidence)
    share = assignment.marginals(costs.tracks, costs.partners, costs.cost, costs.miss_cost, len(found))
    owner, order = np.full(len(found), -1), np.argsort(share, kind="stable")
    owner[costs.partners[order]] = costs.tracks[order]  # the most probable target is written last
    owned = owner >= 0
    if not owned.any():
        return ()
    if design.query.policy == "entropy":
        priority = detection_gain(targets, state.population, costs, share, len(found))
    else:
        priority = np.where(owned, _random_priority(state, len(found)), 0.0)
    velocity = np.where(owned[:, None], targets.mean[owner, 2:], 0.0)
    spots = candidate_points(found.position + np.array(found.displacement_m), velocity)
    known = select(targets, np.bitwise_count(targets.history) >= 2)
    return _plan_with_ground(state, known, spots, np.where(owned, targets.id[owner], -1), priority, column_of)


def _random_priority(state: TrackerState, count: int) -> Float[Array, "target"]:
    """Priorities of the policy `random`."""
    return np.random.default_rng((state.seed, state.frame)).random(count)


def _plan_with_ground(
    state: TrackerState, targets: Targets, spots, track_id, priority, column_of
) -> tuple[SpectralQuery, ...]:
    """Plan the queries of greatest priority, and some of the road ahead of targets."""
    design, bare = state.design, np.empty((0, 2))
    if design.identity.outlier_share:
        rng = np.random.default_rng((state.seed, state.frame, 1))
        most = min(MAX_GROUND, design.query.budget // GROUND_SHARE)
        bare = ground_points(targets, most, rng)
    queries = plan(spots, track_id, priority, column_of, design.query.budget - len(bare))
    return queries + tuple(SpectralQuery(float(east), float(north)) for east, north in bare)


def prediction_gain(
    targets: Targets, detected: Float[Array, "target"], population: identity.Population, design: TrackDesign
) -> Float[Array, "target"]:
    """Predict how far a spectrum of each target in the next frame reduces the association entropy. [nat]

    The spectrum is useful if the target exists, is detected and is at the queried position. Two tracks that
    compete for detections are separated by their positions and by their spectra (`association_risk`). The
    immediate value of a spectrum is the reduction of that risk's entropy, summed over the rivals. Later it is
    a reference, for the contention about the target and, since that changes, about all. This value falls with
    the number of spectra as the variance of their mean does.

    Parameters
    ----------
    targets
        Predicted to the next frame.
    detected
        Probability that each is detected then. [1]
    population
        Population of spectral features.
    design
        Design of the tracker.
    """
    if len(targets) == 0:
        return np.empty(0)
    place, count = targets.position, targets.spectra
    spread = targets.covariance[:, :2, :2] + design.detect.sigma_m**2 * np.eye(2)
    one, other = assignment.gate(place, spread, place, spread, design.association.gate)
    one, other = one[one != other], other[one != other]
    probability = existence_probability(targets)
    apart2 = mahalanobis_squared(place[one] - place[other], spread[one] + spread[other])[0]
    without = _binary_entropy(probability[other] * association_risk(apart2, 0.0, detected[other]))
    blind, gain = np.bincount(one, without, len(targets)), np.zeros(len(targets))
    along, ratio = identity.along_axes(population, targets.feature, count)
    if len(ratio):
        pair = (along[one], count[one]), (along[other], count[other])
        alike2 = identity.divergence2(*pair, ratio)
        then = _binary_entropy(probability[other] * association_risk(apart2, alike2, detected[other]))
        gain = np.bincount(one, without - then, len(targets))
    area = np.sqrt(np.linalg.det(spread))
    # a false detection where a missed target was
    clutter = -np.expm1(-2 * np.pi * area * design.association.clutter_density_m2)
    contention = blind + _binary_entropy((1 - detected) * clutter)
    later = FRAMES_AHEAD * (contention + contention.mean()) / ((count + 1) * (count + 2))
    met = -np.expm1(-0.5 * identity.ATTACH_RADIUS_M**2 / area)  # the spectrum is of the vehicle
    return probability * detected * met * (gain + later)


def association_risk(
    apart2: Float[Array, "pair"], alike2: Float[Array, "pair"] | float, rival_detected: Float[Array, "pair"]
) -> Float[Array, "pair"]:
    """Probability that a detected target's detection goes to its rival. [1]

    The log-likelihood ratio of the right and the wrong association of Gaussian tracks is Gaussian, of a
    variance twice its mean. Where both are detected, and exchanged, the mean is Δᵀ S⁻¹ Δ, with the distance Δ
    and the covariance S of each, which is twice ``apart2``; where the rival is missed and takes the other's
    detection, half of that. One spectrum adds ``alike2``/2 to either.

    Parameters
    ----------
    apart2, alike2
        Squared Mahalanobis distances of the two tracks' positions, by the sum of their covariances, and of
        their spectra (`identity.divergence2`). [1]
    rival_detected
        Probability that the rival is detected. [1]
    """
    exchanged = ndtr(-np.sqrt(apart2 + alike2 / 4))
    taken = ndtr(-np.sqrt(apart2 / 2 + alike2 / 4))
    return rival_detected * exchanged + (1 - rival_detected) * taken


def _binary_entropy(probability: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Entropy of a choice between two. [nat]"""
    return entr(probability) + entr(1 - probability)


def existence_probability(targets: Targets) -> Float[Array, "target"]:
    """Probability that a target is a vehicle, by its score, a log-likelihood ratio. [1]"""
    return np.where(targets.confirmed, 1.0, expit(targets.score - BIRTH_SCORE))


def ground_points(targets: Targets, count: int, rng: np.random.Generator) -> Float[Array, "point 2"]:
    """Points of the road: ahead of moving targets, in random order, away from all targets. [m]

    A query of a vehicle shows the road where the prediction errs; these points measure its spectrum.

    Parameters
    ----------
    targets
        Predicted to the next frame.
    count
        Maximum number of points.
    rng
        Generator of the order.
    """
    velocity = targets.mean[:, 2:]
    speed = np.hypot(*velocity.T)
    moving = rng.permutation(np.flatnonzero(targets.confirmed & (speed >= GROUND_SPEED_M_S)))
    ahead = targets.position[moving] + GROUND_AHEAD_M * velocity[moving] / speed[moving, None]
    if len(ahead) == 0:
        return ahead
    clear = KDTree(targets.position).query(ahead)[0] >= GROUND_CLEAR_M
    return ahead[clear][:count]


def candidate_points(
    position_m: Float[Array, "target 2"], velocity_m_s: Float[Array, "target 2"]
) -> Float[Array, "target place 2"]:
    """Points of each target that may be queried: its centre, and ahead of and behind it. [m]"""
    speed = np.hypot(*velocity_m_s.T)[:, None]
    way = np.where(speed >= MIN_HEADING_M_S, REACH_M * velocity_m_s / np.maximum(speed, MIN_HEADING_M_S), 0.0)
    return np.stack([position_m, position_m + way, position_m - way], axis=1)


def match_columns(
    columns: Int[Array, "target place"], priority: Float[Array, "target"], budget: int
) -> Int[Array, "target"]:
    """Choose the targets of greatest total priority: the place of each, −1 for none.

    Parameters
    ----------
    columns
        Column of each place of each target; −1 for none.
    priority
        Priority of each target; one of 0 or less is not chosen. Equal ones are chosen by rising index.
    budget
        Maximum number of targets.
    """
    owner: dict[int, int] = {}  # target of each chosen column
    place = np.full(len(columns), -1)

    def augment(target: int, tried: set[int]) -> bool:
        for k in range(columns.shape[1]):
            column = int(columns[target, k])
            if column < 0 or column in tried:
                continue
            tried.add(column)
            if column not in owner or augment(owner[column], tried):
                owner[column], place[target] = target, k
                return True
        return False

    chosen = 0
    for target in np.argsort(-priority, kind="stable"):
        if chosen == budget or not priority[target] > 0:
            break
        chosen += augment(int(target), set())
    return place


def plan(
    place_m: Float[Array, "target place 2"],
    track_id: Int[Array, "target"],
    priority: Float[Array, "target"],
    column_of: ColumnOf,
    budget: int,
) -> tuple[SpectralQuery, ...]:
    """Plan the queries of greatest total priority, at most one per column and ``budget`` in all.

    Parameters
    ----------
    place_m
        `candidate_points` of each target's position at the next epoch. [m]
    track_id, priority
        Id and priority of each target; one of 0 or less is not queried. [nat]
    column_of
        Superpixel column that sees each ground point (east, north, up), −1 off the array.
    budget
        Maximum number of queries in a frame.

    Returns
    -------
    Queries by falling priority; ties are in a scattered order of track ids.
    """
    if len(place_m) == 0 or budget == 0:
        return ()
    count, spots, _ = place_m.shape
    ground = np.zeros((count * spots, 3))
    ground[:, :2] = place_m.reshape(-1, 2)
    columns = np.asarray(column_of(ground))
    if columns.shape != (len(ground),):
        raise ValueError(f"`column_of` must return one column per point; got shape {columns.shape}.")
    # ids rise from west to east when many tracks start together: scattered, ties favour no side
    order = np.lexsort((track_id * 2654435761 % 2**32, -priority))
    chosen = match_columns(columns.reshape(count, spots)[order], priority[order], budget)
    taken = [(order[k], place_m[order[k], chosen[k]].tolist()) for k in np.flatnonzero(chosen >= 0)]
    return tuple(
        SpectralQuery(east, north, 0.0, int(track_id[k]), float(priority[k])) for k, (east, north) in taken
    )


def detection_gain(
    targets: Targets,
    population: identity.Population,
    costs: update.AssociationCosts,
    share: Float[Array, "pair"],
    count: int,
) -> Float[Array, "detection"]:
    """Predict how far a spectrum of each detection reduces the entropy, now and later. [nat]

    The owner of a detection has the probabilities of the association, times the probability that its target
    exists; the rest is a new vehicle or clutter. *Now* is the mutual information of owner and spectrum, which
    includes evidence on whether a young target is one object. *Later* the spectrum is a reference for its
    owner, for the owner's contention and, since that changes, the mean of all: the variance of the mean of n
    spectra falls by 1/(n + 1) − 1/(n + 2). Outliers (`track.identity.outlier_share`) are neglected.

    Parameters
    ----------
    targets
        Predicted to the frame.
    population
        Population of spectral features.
    costs, share
        Costs and probabilities of the gated pairs, without spectra: from `update.association_costs` and
        `assignment.marginals`.
    count
        Number of detections.
    """
    owned = share * existence_probability(targets)[costs.tracks]
    along, ratio = identity.along_axes(population, targets.feature, targets.spectra)
    order = np.argsort(costs.partners, kind="stable")
    first = np.searchsorted(costs.partners[order], np.arange(count + 1))
    contention = np.bincount(costs.tracks, _binary_entropy(np.clip(share, 0.0, 1.0)), len(targets))
    spectra = targets.spectra[costs.tracks]
    later = (contention[costs.tracks] + contention.mean()) / ((spectra + 1) * (spectra + 2))
    later = FRAMES_AHEAD * later[order] * owned[order]
    mean, variance = identity.next_spectrum(along[:, : len(ratio)], targets.spectra, ratio)
    out = np.zeros(count)
    for k, (low, high) in enumerate(pairwise(first.tolist())):
        owners = costs.tracks[order[low:high]]
        information = _mutual_information(owned[order[low:high]], mean[owners], variance[owners])
        out[k] = later[low:high].sum() + information
    return out


def _mutual_information(
    owned: Float[Array, "owner"], mean: Float[Array, "owner axis"], variance: Float[Array, "owner axis"]
) -> float:
    """Mutual information of the owner of a detection and its spectrum. [nat]

    By the bound of Kolchinsky and Tracey, Entropy 19, 361 (2017), Eq. (10) with α = ½:
    −Σᵢ wᵢ ln Σₖ wₖ exp(−Bᵢₖ), with the Bhattacharyya distances B; exact where all are alike or all apart,
    except that distances are limited to half of `identity.MAX_RATIO_NAT`.
    """
    share = np.append(owned, 1 - owned.sum())  # the last is a new vehicle or clutter
    mean = np.concatenate([mean, np.zeros((1, mean.shape[1]))])
    variance = np.concatenate([variance, np.ones((1, variance.shape[1]))])
    total = variance[:, None] + variance
    spread = 0.5 * np.log(0.5 * total / np.sqrt(variance[:, None] * variance))
    apart = (0.25 * (mean[:, None] - mean) ** 2 / total + spread).sum(axis=2)
    alike = np.exp(-np.minimum(apart, 0.5 * identity.MAX_RATIO_NAT)) @ np.maximum(share, 0.0)
    likely = share > 0
    return float(-(share[likely] * np.log(np.minimum(alike[likely], 1.0))).sum())
