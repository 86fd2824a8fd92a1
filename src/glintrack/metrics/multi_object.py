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


def idf1(epochs: Sequence[Similarity]) -> float:
    """IDF1 alone, as `multi_object_scores` has it. [1]"""
    return _identity(epochs)["idf1"]


@dataclass(frozen=True)
class _Numbered:
    """Epochs whose vehicles and tracks are numbered without gaps.

    A long flight has thousands of each, few of which ever meet: what is counted of pairs is counted of those
    that do, never of all.

    Parameters
    ----------
    rows
        Vehicle and track numbers of each epoch, and their similarity.
    vehicles, tracks
        How many there are.
    """

    rows: list[tuple[Array, Array, Array]]
    vehicles: int
    tracks: int

    def met(self, least: float) -> tuple[Int[Array, "pair"], list[tuple[Array, Array, Array]]]:
        """Codes of pairs that are ever so similar, rising; of each epoch rows, columns, and which pairs."""
        places = [np.nonzero(similarity >= least) for _, _, similarity in self.rows]
        codes = [v[i] * self.tracks + t[j] for (v, t, _), (i, j) in zip(self.rows, places, strict=True)]
        known = np.unique(np.concatenate([*codes, np.empty(0, int)]).astype(int))
        return known, [
            (i, j, np.searchsorted(known, code)) for (i, j), code in zip(places, codes, strict=True)
        ]


def _numbered(epochs: Sequence[Similarity]) -> _Numbered:
    vehicle_ids = np.unique(np.concatenate([e.vehicles for e in epochs] or [np.empty(0, int)]))
    track_ids = np.unique(np.concatenate([e.tracks for e in epochs] or [np.empty(0, int)]))
    rows = [
        (np.searchsorted(vehicle_ids, e.vehicles), np.searchsorted(track_ids, e.tracks), e.similarity)
        for e in epochs
    ]
    return _Numbered(rows, len(vehicle_ids), len(track_ids))


def _clear(epochs: Sequence[Similarity]) -> dict[str, float]:
    numbered = _numbered(epochs)
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
    numbered = _numbered(epochs)
    pairs, places = numbered.met(SAME)
    together = np.bincount(np.concatenate([which for _, _, which in places] or [pairs]), minlength=len(pairs))
    seen = sum(len(v) for v, _, _ in numbered.rows)
    reported = sum(len(t) for _, t, _ in numbered.rows)
    true = _most_together(*np.divmod(pairs, max(1, numbered.tracks)), together)
    return {"idf1": float(true / max(1, 0.5 * (seen + reported)))}


def _most_together(
    vehicle: Int[Array, "pair"], track: Int[Array, "pair"], together: Int[Array, "pair"]
) -> int:
    """Most epochs that a one-to-one choice of pairs is together; groups that no pair joins one by one."""
    most = 0
    for one in connected_components(vehicle, track):
        (_, i), (_, j) = (np.unique(side[one], return_inverse=True) for side in (vehicle, track))
        table = np.zeros((i.max() + 1, j.max() + 1))
        table[i, j] = together[one]
        most += int(table[linear_sum_assignment(-table)].sum())
    return most


def _hota(epochs: Sequence[Similarity]) -> dict[str, float]:
    numbered = _numbered(epochs)
    pairs, places = numbered.met(_ROUNDING)
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
            kept = similarity[i, j] >= alpha - _ROUNDING
            hits[a] += kept.sum()
            misses[a] += len(v) - kept.sum()
            false[a] += len(t) - kept.sum()
            matched[a, pair[i[kept], j[kept]]] += 1
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
