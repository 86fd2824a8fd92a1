"""Which targets to ask spectra for: one pixel per column, so one query per column.

A target that spans several columns may be asked in any of them. The sets of targets that can be asked at once
are then the independent sets of a transversal matroid, cut off at the budget, which leaves it a matroid: the
greedy choice by falling priority is optimal, where a target is taken if an augmenting path gives every one
taken so far a column of its own (Edmonds and Fulkerson, J. Res. NBS 69B, 147, 1965).
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int
from scipy.special import expit

from glintrack.core.arrays import Array
from glintrack.core.records import SpectralQuery
from glintrack.track.association import associate
from glintrack.track.design import TrackDesign
from glintrack.track.identity import features
from glintrack.track.initiation import Targets
from glintrack.track.queries import kernels as kernels

ColumnOf = Callable[[Float[Array, "point 3"]], Int[Array, "point"]]
FRAMES_AHEAD = 1.0  # at which a spectrum will be held against later ones
BIRTH_SCORE = 4.0  # nat; score at which a track is as likely as not to be a vehicle
GROUND_AHEAD_M, GROUND_CLEAR_M, GROUND_SPEED_M_S = 8.0, 6.0, 3.0
GROUND_SHARE, MOST_GROUND = 5, 4  # one query in so many is the ground's, and not more than so many a frame
FIRST_TRIED, TRIED_PER_QUERY = 64, 4  # candidates that are looked at first
HEADING_M_S = 0.5  # slower, a velocity does not say whither


def information_gain(
    targets: Targets, detected: Float[Array, "target"], population: features.Population, design: TrackDesign
) -> Float[Array, "target"]:
    """Association entropy that a spectrum of each target at the next look is expected to take away. [nat]

    The spectrum is of use if the target is there, is detected and lies where it is asked. Two tracks that
    contend for detections are told apart by where they are and by what they look like (`association_risk`);
    the worth of a spectrum at once is the fall of that risk's entropy, summed over the rivals. Later it is
    a reference, for the contention there is about the target and, since that changes, about all: the share
    of it that one spectrum more serves falls as the variance of their mean does.

    Parameters
    ----------
    targets
        Predicted to the next look.
    detected
        Probability that each is detected then. [1]
    population
        Of spectral features.
    design
        Of the tracker.
    """
    if len(targets) == 0:
        return np.empty(0)
    place = np.ascontiguousarray(targets.position)
    spread = np.ascontiguousarray(targets.covariance[:, :2, :2])
    spread += design.detect.sigma_m**2 * np.eye(2)
    one, other = associate.gate(place, spread, place, spread, design.association.gate)
    believed, count = existence(targets), targets.spectra
    along, ratio = features.along_axes(population, targets.feature, count, design.identity.sigma)
    blind, gain = kernels.contention(
        one, other, place, spread, believed, detected, along, count, ratio,
        design.identity.cap,
    )  # fmt: skip
    return kernels.information_gain(
        blind, gain, spread, believed, detected, count, design.association.clutter_density_m2,
        design.identity.radius_m, FRAMES_AHEAD,
    )  # fmt: skip


def association_risk(
    apart2: Float[Array, "pair"], alike2: Float[Array, "pair"], rival_detected: Float[Array, "pair"]
) -> Float[Array, "pair"]:
    """Probability that a detected target's detection goes to its rival. [1]

    The log-likelihood ratio of the right and the wrong association of Gaussian tracks is Gaussian, of a
    variance twice its mean. Where both are detected, and exchanged, the mean is Δᵀ S⁻¹ Δ, of Δ the distance
    and S each one's covariance, which is twice ``apart2``; where the rival is missed and takes what is not
    its own, half of that. One spectrum adds ``alike2``/2 to either.

    Parameters
    ----------
    apart2, alike2
        Squared Mahalanobis distances of the two tracks' positions, by the sum of their covariances, and of
        their spectra (`features.separation2`). [1]
    rival_detected
        Probability that the rival is detected. [1]
    """
    return kernels.risks(apart2, alike2, rival_detected)


def existence(targets: Targets) -> Float[Array, "target"]:
    """Probability that a target is a vehicle, by its score, a log-likelihood ratio. [1]"""
    return np.where(targets.confirmed, 1.0, expit(targets.score - BIRTH_SCORE))


def ground_points(targets: Targets, count: int, rng: np.random.Generator) -> Float[Array, "point 2"]:
    """Points of bare road: ahead of moving targets, in an order of chance, where no other target is. [m]

    A spectrum asked of a vehicle shows the road where the prediction errs; these say what that looks like.

    Parameters
    ----------
    targets
        Predicted to the next look.
    count
        Most points.
    rng
        Of the order.
    """
    velocity = targets.mean[:, 2:]
    speed = np.hypot(*velocity.T)
    moving = rng.permutation(np.flatnonzero(targets.confirmed & (speed >= GROUND_SPEED_M_S)))
    return kernels.clear_ahead(targets.mean, moving, GROUND_AHEAD_M, GROUND_CLEAR_M, count)


def candidate_points(
    position_m: Float[Array, "target 2"], velocity_m_s: Float[Array, "target 2"], reach_m: float
) -> Float[Array, "target place 2"]:
    """Points of each target that may be looked at, the centre first, then before and behind it. [m]

    Parameters
    ----------
    position_m, velocity_m_s
        Of the centre, and whither: a vehicle is long along its way.
    reach_m
        Distance of the other two; 0 for the centre alone. [m]
    """
    if reach_m == 0:
        return position_m[:, None]
    return kernels.before_and_behind(position_m, velocity_m_s, float(reach_m), HEADING_M_S)


def match_columns(
    columns: Int[Array, "target place"], priority: Float[Array, "target"], budget: int
) -> Int[Array, "target"]:
    """Place of each target chosen, −1 for none: the choice of greatest total priority.

    Parameters
    ----------
    columns
        Column of each place of each target; −1 for none.
    priority
        Of each target; what is 0 or less is not chosen. Equal ones are taken by rising index.
    budget
        Most targets chosen.
    """
    owner: dict[int, int] = {}  # target of each column taken
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
    """The queries of greatest total priority, at most one per column and ``budget`` in all.

    Parameters
    ----------
    place_m
        From `candidate_points`, of where each target will be at the next epoch. [m]
    track_id
        Of each target.
    priority
        Of each target; those of no gain (0 or less) are not asked for. [nat]
    column_of
        Superpixel column that sees each ground point (east, north, up), −1 off the array.
    budget
        Most queries in a frame.

    Returns
    -------
    Queries by falling priority, ties in an order scattered over the track ids.
    """
    if len(place_m) == 0 or budget == 0:
        return ()
    # nearly always the first few serve, and the rest need neither order nor columns
    most = FIRST_TRIED + TRIED_PER_QUERY * budget
    while True:
        index, whole = _highest(priority, most)
        queries = _planned(place_m[index], track_id[index], priority[index], column_of, budget)
        if whole or len(queries) == budget:
            return queries
        most *= 8


def _highest(priority: Float[Array, "target"], most: int) -> tuple[Int[Array, "best"], bool]:
    """Targets of the highest priorities, with all that equal the last of them; and whether that is all."""
    if len(priority) <= most:
        return np.arange(len(priority)), True
    least = np.partition(priority, len(priority) - most)[len(priority) - most]
    return np.flatnonzero(priority >= least), False


def _planned(place_m, track_id, priority, column_of, budget) -> tuple[SpectralQuery, ...]:
    """As `plan`, among all that are given."""
    count, spots, _ = place_m.shape
    ground = np.zeros((count * spots, 3))
    ground[:, :2] = place_m.reshape(-1, 2)
    columns = np.asarray(column_of(ground))
    if columns.shape != (len(ground),):
        raise ValueError(f"`column_of` must return one column per point, got shape {columns.shape}")
    # ids rise from west to east when many are born at once: scattered, ties favour no side
    order = np.lexsort((track_id * 2654435761 % 2**32, -priority))
    chosen = match_columns(columns.reshape(count, spots)[order], priority[order], budget)
    taken = [(order[k], place_m[order[k], chosen[k]].tolist()) for k in np.flatnonzero(chosen >= 0)]
    return tuple(
        SpectralQuery(east, north, 0.0, int(track_id[k]), float(priority[k])) for k, (east, north) in taken
    )
