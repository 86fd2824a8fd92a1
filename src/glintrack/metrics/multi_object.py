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

from glintrack.core.arrays import Array
from glintrack.metrics.tracks import connected_components

SAME = 0.5  # similarity from which track and vehicle are the same, for MOTA and IDF1
ALPHAS = np.arange(0.05, 0.99, 0.05)  # of HOTA
_ROUNDING = np.finfo(float).eps
_STAY = 1000.0  # a match of the epoch before outweighs any similarity


@dataclass(frozen=True)
class Similarity:
    """Vehicles and tracks of one epoch, and their similarity.

    Parameters
    ----------
    vehicles, tracks
        Ids.
    similarity
        1 at the same position, 0 without overlap. [1]
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
    """Compute the scores of a whole run; equal to TrackEval's on the same similarities.

    Returns
    -------
    ``mota``, ``motp`` (mean similarity of matches), ``idf1``, ``hota``, ``deta``, ``assa`` [1]. Where there
    are neither vehicles nor tracks they are 0, as in TrackEval.
    """
    return {**_clear(epochs), "idf1": idf1(epochs), **_hota(epochs)}


class _Numbered:
    """Epochs whose vehicles and tracks are numbered without gaps.

    A long flight has thousands of each, few of which ever meet. Pairs are therefore counted only if they
    meet.
    """

    def __init__(self, epochs: Sequence[Similarity]) -> None:
        none = np.empty(0, int)
        vehicles = np.unique(np.concatenate([e.vehicles for e in epochs] or [none]))
        tracks = np.unique(np.concatenate([e.tracks for e in epochs] or [none]))
        self.rows = [
            (np.searchsorted(vehicles, e.vehicles), np.searchsorted(tracks, e.tracks), e.similarity)
            for e in epochs
        ]
        self.vehicles, self.tracks = len(vehicles), len(tracks)

    def pairs(self, minimum: float) -> tuple[Int[Array, "pair"], list[tuple[Array, Array, Array]]]:
        """Codes of pairs with at least this similarity; rows, columns and pairs of each epoch."""
        places = [np.nonzero(similarity >= minimum) for _, _, similarity in self.rows]
        codes = [v[i] * self.tracks + t[j] for (v, t, _), (i, j) in zip(self.rows, places, strict=True)]
        known = np.unique(np.concatenate([*codes, np.empty(0, int)]).astype(int))
        return known, [(i, j, np.searchsorted(known, c)) for (i, j), c in zip(places, codes, strict=True)]


def _clear(epochs: Sequence[Similarity]) -> dict[str, float]:
    numbered = _Numbered(epochs)
    last, before = np.full((2, numbered.vehicles), -1)  # track when last matched, and one epoch ago
    hits = misses = false = switches = 0
    total = 0.0
    for v, t, similarity in numbered.rows:
        if len(v) == 0 or len(t) == 0:
            misses, false = misses + len(v), false + len(t)
            continue
        gain = _STAY * (t[None] == before[v][:, None]) + similarity
        gain[similarity < SAME - _ROUNDING] = 0
        i, j = linear_sum_assignment(-gain)
        matched = gain[i, j] > _ROUNDING
        i, j = i[matched], j[matched]
        switches += int(((last[v[i]] >= 0) & (last[v[i]] != t[j])).sum())
        before[:] = -1
        before[v[i]] = last[v[i]] = t[j]
        hits, misses, false = hits + len(i), misses + len(v) - len(i), false + len(t) - len(i)
        total += similarity[i, j].sum()
    return {"mota": (hits - false - switches) / max(1, hits + misses), "motp": float(total / max(1, hits))}


def idf1(epochs: Sequence[Similarity]) -> float:
    """IDF1 of a whole run. [1]"""
    numbered = _Numbered(epochs)
    pairs, places = numbered.pairs(SAME)
    together = np.bincount(np.concatenate([which for _, _, which in places] or [pairs]), minlength=len(pairs))
    seen = sum(len(v) for v, _, _ in numbered.rows)
    reported = sum(len(t) for _, t, _ in numbered.rows)
    true, (vehicle, track) = 0, np.divmod(pairs, max(1, numbered.tracks))
    for one in connected_components(vehicle, track):  # one-to-one choice of pairs, group by group
        (_, i), (_, j) = (np.unique(side[one], return_inverse=True) for side in (vehicle, track))
        table = np.zeros((i.max() + 1, j.max() + 1))
        table[i, j] = together[one]
        true += int(table[linear_sum_assignment(-table)].sum())
    return float(true / max(1, 0.5 * (seen + reported)))


def _hota(epochs: Sequence[Similarity]) -> dict[str, float]:
    numbered = _Numbered(epochs)
    pairs, places = numbered.pairs(_ROUNDING)
    together, lives, lengths = (np.zeros(n) for n in (len(pairs), numbered.vehicles, numbered.tracks))
    for (v, t, similarity), (i, j, which) in zip(numbered.rows, places, strict=True):
        shared = similarity.sum(axis=0)[None] + similarity.sum(axis=1)[:, None] - similarity
        together[which] += similarity[i, j] / shared[i, j]
        lives[v] += 1
        lengths[t] += 1
    vehicle, track = np.divmod(pairs, max(1, numbered.tracks))
    either = lives[vehicle] + lengths[track]
    alignment = together / (either - together)
    hits, misses, false = (np.zeros(len(ALPHAS)) for _ in range(3))
    matched = np.zeros((len(ALPHAS), len(pairs)))
    for (v, t, similarity), (i, j, which) in zip(numbered.rows, places, strict=True):
        gain, pair = np.zeros(similarity.shape), np.full(similarity.shape, -1)
        gain[i, j], pair[i, j] = alignment[which] * similarity[i, j], which
        i, j = linear_sum_assignment(-gain)
        for a, alpha in enumerate(ALPHAS):
            hit = similarity[i, j] >= alpha - _ROUNDING
            hits[a] += hit.sum()
            misses[a] += len(v) - hit.sum()
            false[a] += len(t) - hit.sum()
            matched[a, pair[i[hit], j[hit]]] += 1
    detection = hits / np.maximum(1, hits + misses + false)
    association = np.array(
        [(m * m / np.maximum(1, either - m)).sum() / max(1, n) for m, n in zip(matched, hits, strict=True)]
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
    near, _ = _match_power(vehicle_m, track_m, cutoff_m, order)
    return float(((near + cutoff_m**order * abs(n - m)) / max(n, m)) ** (1 / order))


def gospa(
    vehicle_m: Float[Array, "vehicle 2"],
    track_m: Float[Array, "track 2"],
    cutoff_m: float = 10.0,
    order: float = 2.0,
) -> float:
    """Generalized OSPA of one epoch, α = 2: each missed vehicle and false track costs half the cutoff. [m]"""
    n, m = len(vehicle_m), len(track_m)
    total, pairs = _match_power(vehicle_m, track_m, cutoff_m, order)
    near = total - cutoff_m**order * (min(n, m) - pairs)  # pairs at the cutoff are no pairs
    return float((near + cutoff_m**order / 2 * (n + m - 2 * pairs)) ** (1 / order))


def _match_power(vehicle_m, track_m, cutoff_m: float, order: float) -> tuple[float, int]:
    """Minimum sum of limited distances to the order over an assignment, and the number below the limit."""
    if min(len(vehicle_m), len(track_m)) == 0:
        return 0.0, 0
    distance = np.hypot(*(vehicle_m[:, None] - track_m[None]).transpose(2, 0, 1))
    cost = np.minimum(distance, cutoff_m) ** order
    i, j = linear_sum_assignment(cost)
    return float(cost[i, j].sum()), int((distance[i, j] < cutoff_m).sum())
