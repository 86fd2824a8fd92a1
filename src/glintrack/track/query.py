"""Which targets to ask spectra for in the next frame: one pixel per column, so one query per column.

A target that spans several columns may be asked in any of them. The sets of targets that can be asked at once
are then the independent sets of a transversal matroid, cut off at the budget, which leaves it a matroid: the
greedy choice by falling priority is optimal, where a target is taken if an augmenting path gives every one
taken so far a column of its own (Edmonds and Fulkerson, J. Res. NBS 69B, 147, 1965).
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from glintrack.records import SpectralQuery
from glintrack.track import associate

Array = np.ndarray
COASTING_GAIN = 0.3  # nat; a known vehicle that comes back must be recognised
UNKNOWN_GAIN = 0.5  # nat; of a track's first spectrum, falling with the count
CONTENTION_GAIN = 1.0  # nat a rival
MOST_RIVALS = 1.5  # in a queue one spectrum does not tell them all apart
HEADING_M_S = 0.5  # slower, a velocity does not say whither
YOUNG_S = 2.0  # a younger track is as likely as not to be no vehicle


def association_entropy(
    tracks: Int[Array, "pair"], cost: Float[Array, "pair"], miss_cost: Float[Array, "track"]
) -> Float[Array, "track"]:
    """Entropy of each track's choice among its gated detections and none. [nat]

    Parameters
    ----------
    tracks, cost
        Track of each gated pair and its cost, as in `associate.assign`. [nat]
    miss_cost
        Of no detection. [nat]
    """
    best = miss_cost.copy()
    np.minimum.at(best, tracks, cost)
    weight, alone = np.exp(best[tracks] - cost), np.exp(best - miss_cost)
    total = alone.copy()
    np.add.at(total, tracks, weight)
    share, none = weight / total[tracks], alone / total
    with np.errstate(divide="ignore", invalid="ignore"):
        entropy = -np.where(none > 0, none * np.log(none), 0.0)
        np.add.at(entropy, tracks, -np.where(share > 0, share * np.log(share), 0.0))
    return entropy


def contention(
    mean: Float[Array, "track 4"], covariance: Float[Array, "track 4 4"], gate_distance2: float
) -> Float[Array, "track"]:
    """How many others each track may be confused with at the next look: where it will be, they may be too.

    Parameters
    ----------
    mean, covariance
        Predicted. [m, m s⁻¹]
    gate_distance2
        Squared Mahalanobis distance beyond which nobody is confused. [1]

    Returns
    -------
    Sum over the others of exp(−d²/2), d their Mahalanobis distance; at most `MOST_RIVALS`.
    """
    place, spread = mean[:, :2], np.ascontiguousarray(covariance[:, :2, :2])
    one, other = associate.gate(mean, covariance, place, spread, gate_distance2)
    one, other = one[one != other], other[one != other]
    apart, joint = place[one] - place[other], spread[one] + spread[other]
    determinant = joint[:, 0, 0] * joint[:, 1, 1] - joint[:, 0, 1] ** 2
    dx, dy = apart.T
    distance2 = (dx**2 * joint[:, 1, 1] - 2 * dx * dy * joint[:, 0, 1] + dy**2 * joint[:, 0, 0]) / determinant
    return np.minimum(np.bincount(one, np.exp(-0.5 * distance2), len(mean)), MOST_RIVALS)


def gain(
    entropy: Float[Array, "track"],
    spectra: Float[Array, "track"],
    coasting: np.ndarray,
    contended: Float[Array, "track"] | float = 0.0,
    age_s: Float[Array, "track"] | float = np.inf,
) -> Float[Array, "track"]:
    """Expected worth of one more spectrum of each track. [nat]

    A spectrum resolves an ambiguous association only if the track has a spectrum to compare it with. A young
    track is often no vehicle, and then its spectrum is lost.

    Parameters
    ----------
    entropy, contended
        From `association_entropy` and `contention`.
    spectra
        How many the track has.
    coasting
        True where it was not measured last.
    age_s
        Since it was first seen. [s]
    """
    known = spectra > 0
    believed = 1.0 - YOUNG_S / (YOUNG_S + np.asarray(age_s, float))
    resolved = known * (entropy + CONTENTION_GAIN * contended)
    return resolved + believed * UNKNOWN_GAIN / (1 + spectra) + COASTING_GAIN * (known & coasting)


def places(
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
    speed = np.hypot(*velocity_m_s.T)
    along = velocity_m_s / np.maximum(speed, 1e-9)[:, None] * (speed >= HEADING_M_S)[:, None]
    return np.stack([position_m, position_m + reach_m * along, position_m - reach_m * along], axis=1)


def transversal(
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
    column_of: Callable[[Float[Array, "target 3"]], Int[Array, "target"]],
    budget: int,
) -> tuple[SpectralQuery, ...]:
    """The queries of greatest total priority, at most one per column and ``budget`` in all.

    Parameters
    ----------
    place_m
        From `places`, of where each target will be at the next epoch. [m]
    track_id
        Of each target.
    priority
        Of each target; those of no worth (0 or less) are not asked for. [nat]
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
    count, spots, _ = place_m.shape
    ground = np.column_stack([place_m.reshape(-1, 2), np.zeros(count * spots)])
    columns = np.asarray(column_of(ground))
    if columns.shape != (len(ground),):
        raise ValueError(f"`column_of` must return one column per point, got shape {columns.shape}")
    # ids rise from west to east when many are born at once: scattered, ties favour no side
    order = np.lexsort((track_id * 2654435761 % 2**32, -priority))
    chosen = np.full(count, -1)
    chosen[order] = transversal(columns.reshape(count, spots)[order], priority[order], budget)
    taken = [(k, place_m[k, chosen[k]].tolist()) for k in order if chosen[k] >= 0]
    return tuple(
        SpectralQuery(east, north, 0.0, int(track_id[k]), float(priority[k])) for k, (east, north) in taken
    )
