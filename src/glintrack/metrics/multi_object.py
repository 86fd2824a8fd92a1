"""Scores of other communities: MOTA, IDF1, HOTA, OSPA and GOSPA.

References
----------
Bernardin and Stiefelhagen, EURASIP J. Image Video Process. 2008, 246309 (CLEAR MOT); Ristani et al., ECCV
Workshops 2016 (IDF1); Luiten et al., IJCV 129, 548 (2021) (HOTA); Schuhmacher, Vo and Vo, IEEE Trans. Signal
Process. 56, 3447 (2008) (OSPA); Rahmathullah et al., FUSION 2017 (GOSPA, α = 2).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from glintrack.arrays import Array

SAME = 0.5  # similarity from which track and vehicle are the same, for MOTA and IDF1
ALPHAS = np.arange(0.05, 0.99, 0.05)  # of HOTA
_ROUNDING = np.finfo(float).eps
_STAY = 1000.0  # a match of the epoch before outweighs any similarity


@dataclass(frozen=True)
class Similarity:
    """Vehicles and tracks of one epoch, and how alike they are.

    Parameters
    ----------
    vehicles, tracks
        Ids.
    similarity
        1 where they coincide, 0 where they have nothing in common. [1]
    """

    vehicles: Int[Array, "vehicle"]
    tracks: Int[Array, "track"]
    similarity: Float[Array, "vehicle track"]


def point_similarity(
    vehicles: Int[Array, "vehicle"],
    vehicle_m: Float[Array, "vehicle 2"],
    tracks: Int[Array, "track"],
    track_m: Float[Array, "track 2"],
    match_distance_m: float,
) -> Similarity:
    """Similarity of points: 1 at distance 0, ½ at the matching distance, 0 from twice that on."""
    distance = np.hypot(*(vehicle_m[:, None] - track_m[None]).transpose(2, 0, 1))
    return Similarity(vehicles, tracks, np.maximum(0.0, 1 - distance / (2 * match_distance_m)))


def multi_object_scores(epochs: Sequence[Similarity]) -> dict[str, float]:
    """Scores of a whole run; the same as TrackEval's on the same similarities.

    Returns
    -------
    ``mota``, ``motp`` (mean similarity of matches), ``idf1``, ``hota``, ``deta``, ``assa`` [1]. Where there
    are neither vehicles nor tracks they are 0, as TrackEval has it.
    """
    return {**_clear(epochs), **_identity(epochs), **_hota(epochs)}


def _numbered(epochs: Sequence[Similarity]) -> tuple[list[tuple[Array, Array, Array]], int, int]:
    """Vehicle and track numbers without gaps, with the similarity of each epoch; and how many there are."""
    vehicle_ids = np.unique(np.concatenate([e.vehicles for e in epochs] or [np.empty(0, int)]))
    track_ids = np.unique(np.concatenate([e.tracks for e in epochs] or [np.empty(0, int)]))
    rows = [
        (np.searchsorted(vehicle_ids, e.vehicles), np.searchsorted(track_ids, e.tracks), e.similarity)
        for e in epochs
    ]
    return rows, len(vehicle_ids), len(track_ids)


def _clear(epochs: Sequence[Similarity]) -> dict[str, float]:
    rows, vehicles, _ = _numbered(epochs)
    last, before = np.full(vehicles, -1), np.full(vehicles, -1)  # track when last matched, and one epoch ago
    hits = misses = false = switches = 0
    total = 0.0
    for v, t, similarity in rows:
        if len(v) == 0 or len(t) == 0:
            misses, false = misses + len(v), false + len(t)
            continue
        gain = _STAY * (t[None] == before[v][:, None]) + similarity
        gain[similarity < SAME - _ROUNDING] = 0
        i, j = linear_sum_assignment(-gain)
        kept = gain[i, j] > _ROUNDING
        i, j = i[kept], j[kept]
        switches += int(((last[v[i]] >= 0) & (last[v[i]] != t[j])).sum())
        before[:] = -1
        before[v[i]] = last[v[i]] = t[j]
        hits, misses, false = hits + len(i), misses + len(v) - len(i), false + len(t) - len(i)
        total += similarity[i, j].sum()
    return {
        "mota": (hits - false - switches) / max(1, hits + misses),
        "motp": float(total / max(1, hits)),
    }


def _identity(epochs: Sequence[Similarity]) -> dict[str, float]:
    rows, vehicles, tracks = _numbered(epochs)
    together = np.zeros((vehicles, tracks))
    seen = reported = 0
    for v, t, similarity in rows:
        together[v[:, None], t[None]] += similarity >= SAME
        seen, reported = seen + len(v), reported + len(t)
    true = together[linear_sum_assignment(-together)].sum()
    return {"idf1": float(true / max(1, 0.5 * (seen + reported)))}


def _hota(epochs: Sequence[Similarity]) -> dict[str, float]:
    rows, vehicles, tracks = _numbered(epochs)
    together, lives, lengths = np.zeros((vehicles, tracks)), np.zeros((vehicles, 1)), np.zeros((1, tracks))
    for v, t, similarity in rows:
        shared = similarity.sum(axis=0)[None] + similarity.sum(axis=1)[:, None] - similarity
        together[v[:, None], t[None]] += np.where(
            shared > _ROUNDING, similarity / np.where(shared > 0, shared, 1), 0
        )
        lives[v, 0] += 1
        lengths[0, t] += 1
    with np.errstate(invalid="ignore"):
        alignment = together / (lives + lengths - together)
    hits, misses, false = (np.zeros(len(ALPHAS)) for _ in range(3))
    matched = np.zeros((len(ALPHAS), vehicles, tracks))
    for v, t, similarity in rows:
        i, j = linear_sum_assignment(-alignment[v[:, None], t[None]] * similarity)
        for a, alpha in enumerate(ALPHAS):
            kept = similarity[i, j] >= alpha - _ROUNDING
            hits[a] += kept.sum()
            misses[a] += len(v) - kept.sum()
            false[a] += len(t) - kept.sum()
            matched[a, v[i[kept]], t[j[kept]]] += 1
    detection = hits / np.maximum(1, hits + misses + false)
    association = np.array(
        [
            (m * m / np.maximum(1, lives + lengths - m)).sum() / max(1, n)
            for m, n in zip(matched, hits, strict=True)
        ]
    )
    return {
        "hota": float(np.sqrt(detection * association).mean()),
        "deta": float(detection.mean()),
        "assa": float(association.mean()),
    }


def ospa(
    vehicle_m: Float[Array, "vehicle 2"],
    track_m: Float[Array, "track 2"],
    cutoff_m: float = 10.0,
    order: float = 2.0,
) -> float:
    """Optimal subpattern assignment distance of one epoch; 0 if both sets are empty. [m]"""
    n, m = len(vehicle_m), len(track_m)
    if max(n, m) == 0:
        return 0.0
    near, _ = _matched_power(vehicle_m, track_m, cutoff_m, order)
    return float(((near + cutoff_m**order * abs(n - m)) / max(n, m)) ** (1 / order))


def gospa(
    vehicle_m: Float[Array, "vehicle 2"],
    track_m: Float[Array, "track 2"],
    cutoff_m: float = 10.0,
    order: float = 2.0,
) -> float:
    """Generalized OSPA of one epoch, α = 2: each missed vehicle and false track costs half the cutoff. [m]"""
    n, m = len(vehicle_m), len(track_m)
    total, pairs = _matched_power(vehicle_m, track_m, cutoff_m, order)
    near = total - cutoff_m**order * (min(n, m) - pairs)  # pairs at the cutoff are no pairs
    return float((near + cutoff_m**order / 2 * (n + m - 2 * pairs)) ** (1 / order))


def _matched_power(vehicle_m, track_m, cutoff_m: float, order: float) -> tuple[float, int]:
    """Least sum of cut-off distances to the order over a one-to-one assignment, and how many are nearer."""
    if min(len(vehicle_m), len(track_m)) == 0:
        return 0.0, 0
    distance = np.hypot(*(vehicle_m[:, None] - track_m[None]).transpose(2, 0, 1))
    cost = np.minimum(distance, cutoff_m) ** order
    i, j = linear_sum_assignment(cost)
    return float(cost[i, j].sum()), int((distance[i, j] < cutoff_m).sum())
