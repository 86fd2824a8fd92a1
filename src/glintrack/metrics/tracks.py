"""Scores of tracks: completeness, Eq. (13), and purity, Eq. (14). Written down only here.

At each epoch tracks and vehicles are matched one to one within 5 m: as many pairs as possible, and among
those the least total distance. All vehicles take part, so that a track resting on a stopped vehicle is not
lent to one that drives past. Presnar et al., Proc. SPIE 7672, 76720T (2010), §4.2.

A false track is reported, unmatched, and has no stopped or outside vehicle within the matching distance.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from glintrack.core import schema
from glintrack.core.arrays import Array
from glintrack.metrics.definitions import (
    MATCH_DISTANCE_M,
    MOVING_SPEED_M_S,
    VISIBLE_FRACTION,
    AreaM,
    is_in_window,
    is_moving,
    is_visible,
    window_km2,
)
from glintrack.metrics.joined import joined_groups

Over = Literal["moving", "visible", "all"]
_TOGETHER = 1000  # pairs that are solved at once sooner than their groups one by one


@dataclass(frozen=True)
class EpochScore:
    """Tracks against truth at one epoch.

    Parameters
    ----------
    vehicle_ids, track_ids
        All vehicles of the truth and all tracks reported.
    should
        Vehicles that should be tracked: moving and inside the area, occluded or not.
    visible
        Those of `should` that can be seen (all of them if the truth does not say).
    inside
        Vehicles inside the area, stopped ones included.
    matched_track
        Track id matched to each vehicle, −1 for none.
    matched_vehicle
        Vehicle id matched to each track, −1 for none.
    distance_m
        Of each track to its matched vehicle, NaN for none. [m]
    valid, false
        Of each track. A track matched to a stopped vehicle or one outside the area, or unmatched with such a
        vehicle within the matching distance, is neither.
    near
        Track and vehicle, by their places in the arrays above, of every pair within the matching distance.
    time_s
        When; NaN if nobody said. [s]
    area_km2
        Of the window. [km²]
    """

    vehicle_ids: Int[Array, "vehicle"]
    track_ids: Int[Array, "track"]
    should: Bool[Array, "vehicle"]
    visible: Bool[Array, "vehicle"]
    inside: Bool[Array, "vehicle"]
    matched_track: Int[Array, "vehicle"]
    matched_vehicle: Int[Array, "track"]
    distance_m: Float[Array, "track"]
    valid: Bool[Array, "track"]
    false: Bool[Array, "track"]
    near: Int[Array, "pair 2"]
    time_s: float
    area_km2: float

    def completeness(self, over: Over = "moving") -> float:
        """Share of the vehicles that have a track, Eq. (13); NaN if there are none. [1]

        Parameters
        ----------
        over
            ``"moving"``, the primary figure: moving vehicles inside the area, occluded or not;
            ``"visible"``: those of them in view; ``"all"``: all vehicles inside the area.
        """
        try:
            counted = {"moving": self.should, "visible": self.visible, "all": self.inside}[over]
        except KeyError:
            raise ValueError(f"`over` must be 'moving', 'visible' or 'all', got {over!r}") from None
        return float(np.mean(self.matched_track[counted] >= 0)) if counted.any() else float("nan")


def score_epoch(
    tracks: xr.Dataset,
    truth: xr.Dataset,
    area_m: AreaM,
    match_distance_m: float = MATCH_DISTANCE_M,
    moving_speed_m_s: float = MOVING_SPEED_M_S,
    visible_fraction: float = VISIBLE_FRACTION,
    time_s: float = float("nan"),
) -> EpochScore:
    """Match the tracks of one epoch with its vehicles.

    Parameters
    ----------
    tracks, truth
        Datasets of the schemas ``tracks`` and ``truth``; the truth may carry ``visible_fraction``. [m]
    area_m
        Area of interest (west, south, east, north), its edges included. [m]
    match_distance_m
        A track farther from a vehicle is not its track. [m]
    moving_speed_m_s
        A vehicle at least this fast is moving. [m s⁻¹]
    visible_fraction
        A vehicle seen at least to this part is visible. [1]
    time_s
        When; what custody says of time needs it. [s]

    Raises
    ------
    ValueError
        If a dataset breaks its schema or the area is empty.
    """
    schema.check(tracks, "tracks")
    schema.check(truth, "truth")
    vehicles = vehicles_of(truth, ids_of(truth, "vehicle"), area_m, moving_speed_m_s, visible_fraction)
    places = ids_of(tracks, "track"), places_of(tracks)
    return match_epoch(*places, vehicles, match_distance_m, time_s, window_km2(area_m))


@dataclass(frozen=True)
class Vehicles:
    """Vehicles of one epoch or of many.

    Parameters
    ----------
    ids, place_m
        Who, and where. [m]
    should, visible, inside
        As of `EpochScore`.
    """

    ids: Int[Array, "vehicle"]
    place_m: Float[Array, "vehicle 2"]
    should: Bool[Array, "vehicle"]
    visible: Bool[Array, "vehicle"]
    inside: Bool[Array, "vehicle"]

    def only(self, rows: Int[Array, "chosen"]) -> "Vehicles":
        """Some of them."""
        every = self.ids, self.place_m, self.should, self.visible, self.inside
        return Vehicles(*(values[rows] for values in every))


def vehicles_of(
    truth: xr.Dataset,
    ids: Int[Array, "vehicle"],
    area_m: AreaM,
    moving_speed_m_s: float = MOVING_SPEED_M_S,
    visible_fraction: float = VISIBLE_FRACTION,
) -> Vehicles:
    """What scores need of the truth; arguments as of `score_epoch`."""
    inside = is_in_window(truth, area_m)
    should = inside & is_moving(truth, moving_speed_m_s)
    return Vehicles(ids, places_of(truth), should, should & is_visible(truth, visible_fraction), inside)


def match_epoch(
    track_ids: Int[Array, "track"],
    track_m: Float[Array, "track 2"],
    vehicles: Vehicles,
    match_distance_m: float,
    time_s: float,
    area_km2: float,
) -> EpochScore:
    """`score_epoch` of arrays that are known to be right."""
    v, should = vehicles.place_m, vehicles.should
    near, distance = near_pairs(track_m, v, match_distance_m)
    kept = match(near, distance, match_distance_m)
    rows, columns = near[kept].T
    matched_track = np.full(len(v), -1)
    matched_track[columns] = track_ids[rows]
    matched_vehicle = np.full(len(track_m), -1)
    matched_vehicle[rows] = vehicles.ids[columns]
    matched_distance = np.full(len(track_m), np.nan)
    matched_distance[rows] = distance[kept]

    matched = matched_vehicle >= 0
    valid = np.zeros(len(track_m), bool)
    valid[rows] = should[columns]
    beside_others = np.zeros(len(track_m), bool)
    beside_others[near[~should[near[:, 1]], 0]] = True
    false = ~matched & ~beside_others
    return EpochScore(
        vehicles.ids, track_ids, should, vehicles.visible, vehicles.inside,
        matched_track, matched_vehicle, matched_distance, valid, false, near, float(time_s), area_km2,
    )  # fmt: skip


def near_pairs(
    track_m: Float[Array, "track 2"], vehicle_m: Float[Array, "vehicle 2"], limit_m: float
) -> tuple[Int[Array, "pair 2"], Float[Array, "pair"]]:
    """Track and vehicle of every pair within a distance, by rising track, then vehicle; their distances."""
    if not len(track_m) or not len(vehicle_m):
        return np.empty((0, 2), int), np.empty(0)
    reach = limit_m * (1 + 1e-9)  # the tree rounds otherwise
    found = KDTree(vehicle_m).query_ball_point(track_m, reach, return_sorted=True)
    track = np.repeat(np.arange(len(track_m)), [len(one) for one in found])
    vehicle = np.concatenate([np.asarray(one, int) for one in found])
    distance_m = np.hypot(*(track_m[track] - vehicle_m[vehicle]).T)
    kept = distance_m <= limit_m
    return np.stack([track, vehicle], axis=-1)[kept], distance_m[kept]


def match(near: Int[Array, "pair 2"], distance: Float[Array, "pair"], limit: float) -> Int[Array, "chosen"]:
    """One-to-one pairs of those within the limit: as many as possible, then at least total distance.

    Of many, groups that no pair joins are solved each by itself.

    Returns
    -------
    Which pairs, by rising track.
    """
    if not len(near):
        return np.empty(0, int)
    alone = np.bincount(near[:, 0])[near[:, 0]] * np.bincount(near[:, 1])[near[:, 1]] == 1
    chosen, rest = np.flatnonzero(alone).tolist(), np.flatnonzero(~alone)
    if not len(rest):
        return np.array(chosen)
    if len(rest) <= _TOGETHER:
        return np.array(sorted(chosen + _best(rest, near[rest], distance[rest], limit)), int)
    for group in joined_groups(*near[rest].T):
        pairs = rest[group]
        chosen += _best(pairs, near[pairs], distance[pairs], limit)
    return np.array(sorted(chosen), int)


def _best(
    pairs: Int[Array, "pair"], near: Int[Array, "pair 2"], distance: Float[Array, "pair"], limit: float
) -> list[int]:
    """Those chosen of a group's pairs."""
    row, column = (np.unique(side, return_inverse=True)[1] for side in near.T)
    shape = row.max() + 1, column.max() + 1
    # one pair more always outweighs all the distance there can be
    cost = np.full(shape, 1.0 + 2.0 * limit * min(shape))
    which = np.full(shape, -1)
    cost[row, column], which[row, column] = distance, pairs
    found = which[linear_sum_assignment(cost)]
    return found[found >= 0].tolist()


def completeness(epochs: Sequence[EpochScore] | EpochScore, over: Over = "moving") -> Float[Array, "time"]:
    """Completeness of each epoch, Eq. (13); NaN where no vehicle should be tracked. [1]

    Parameters
    ----------
    epochs
        Scores in the order of time.
    over
        Which vehicles count; see `EpochScore.completeness`.
    """
    return np.array([epoch.completeness(over) for epoch in as_sequence(epochs)], dtype=float)


def purity(epochs: Sequence[EpochScore] | EpochScore) -> float:
    """Mean over vehicles of the purity of their tracks, Eq. (14); NaN if no track was matched twice. [1]

    A vehicle's purity is the epoch-weighted mean over the tracks whose majority vehicle it is.
    """
    by_vehicle = vehicle_purity(epochs)
    return float(np.mean(list(by_vehicle.values()))) if by_vehicle else float("nan")


def running_purity(epochs: Sequence[EpochScore] | EpochScore) -> Float[Array, "time"]:
    """`purity` of the epochs up to and with each, the last of which is the whole run's; NaN at first. [1]"""
    counts: dict[int, Counter[int]] = {}
    out = []
    for epoch in as_sequence(epochs):
        for track, vehicle in zip(epoch.track_ids.tolist(), epoch.matched_vehicle.tolist(), strict=True):
            if vehicle >= 0:
                counts.setdefault(track, Counter())[vehicle] += 1
        by_vehicle = _purity_by_vehicle(counts)
        out.append(float(np.mean(list(by_vehicle.values()))) if by_vehicle else float("nan"))
    return np.array(out, dtype=float)


def track_purity(epochs: Sequence[EpochScore] | EpochScore) -> dict[int, tuple[int, int, int]]:
    """Majority vehicle, epochs matched to it and epochs matched at all, of each track matched twice or more.

    A tie goes to the smallest vehicle id.
    """
    return _majorities({track: Counter(v) for track, v in _matches_by_track(epochs).items()})


def vehicle_purity(epochs: Sequence[EpochScore] | EpochScore) -> dict[int, float]:
    """Purity of each vehicle that is the majority vehicle of a track, epoch-weighted. [1]"""
    return _purity_by_vehicle({track: Counter(v) for track, v in _matches_by_track(epochs).items()})


def _majorities(counts: Mapping[int, Counter[int]]) -> dict[int, tuple[int, int, int]]:
    """Majority vehicle, its count and the total of each track matched twice or more."""
    out = {}
    for track, vehicles in counts.items():
        total = sum(vehicles.values())
        if total >= 2:
            majority, count = min(vehicles.items(), key=lambda item: (-item[1], item[0]))
            out[track] = (majority, count, total)
    return out


def _purity_by_vehicle(counts: Mapping[int, Counter[int]]) -> dict[int, float]:
    majority, matched = Counter(), Counter()
    for vehicle, count, total in _majorities(counts).values():
        majority[vehicle] += count
        matched[vehicle] += total
    return {vehicle: majority[vehicle] / matched[vehicle] for vehicle in sorted(matched)}


def identity_switches(epochs: Sequence[EpochScore] | EpochScore) -> int:
    """How often a vehicle is matched to another track than when it was last matched."""
    last: dict[int, int] = {}
    switches = 0
    for epoch in as_sequence(epochs):
        for vehicle, track in zip(epoch.vehicle_ids.tolist(), epoch.matched_track.tolist(), strict=True):
            if track >= 0:
                switches += last.get(vehicle, track) != track
                last[vehicle] = track
    return switches


def as_sequence(epochs: Sequence[EpochScore] | EpochScore) -> Sequence[EpochScore]:
    """Epochs in a sequence, one alone too."""
    return [epochs] if isinstance(epochs, EpochScore) else list(epochs)


def _matches_by_track(epochs: Sequence[EpochScore] | EpochScore) -> dict[int, list[int]]:
    out: dict[int, list[int]] = {}
    for epoch in as_sequence(epochs):
        for track, vehicle in zip(epoch.track_ids.tolist(), epoch.matched_vehicle.tolist(), strict=True):
            if vehicle >= 0:
                out.setdefault(track, []).append(vehicle)
    return out


def ids_of(dataset: xr.Dataset, dim: str) -> Int[Array, "id"]:
    """Numbers of what lies along a dim, each there once."""
    if dim not in dataset.coords:
        raise ValueError(f"`{dim}` must be a coordinate of integer ids, got none")
    return unlike(np.asarray(dataset[dim].values), dim)


def unlike(ids: Int[Array, "id"], name: str) -> Int[Array, "id"]:
    """Numbers that must all be different."""
    if ids.size and not (np.issubdtype(ids.dtype, np.integer) and ids.min() >= 0):
        raise ValueError(f"`{name}` must hold integer ids of 0 or more, got {ids[:4]}")
    repeated = len(ids) - len(np.unique(ids))
    if repeated:
        raise ValueError(f"`{name}` must hold each id once, got {repeated} repeated")
    return ids.astype(np.int64)


def places_of(dataset: xr.Dataset) -> Float[Array, "n 2"]:
    """East and north. [m]"""
    return np.stack([dataset["east"].values, dataset["north"].values], axis=-1).astype(float)
