"""Match tracks with vehicles at each epoch: which vehicles count, and which tracks are right or false.

At each epoch tracks and vehicles are matched one to one within 5 m: as many pairs as possible, and among
those the least total distance. All vehicles take part, so that a track resting on a stopped vehicle is not
lent to one that drives past. Presnar et al., Proc. SPIE 7672, 76720T (2010), §4.2.

A false track is reported, unmatched, and has no stopped or outside vehicle within the matching distance.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array, csgraph
from scipy.spatial import KDTree

from glintrack.core import schema
from glintrack.core.arrays import Array
from glintrack.core.schema import MOVING_SPEED_M_S

MATCH_DISTANCE_M = 5.0
VISIBLE_FRACTION = 0.25
AreaM = tuple[float, float, float, float]
Over = Literal["moving", "visible", "all"]


def is_moving(truth: xr.Dataset, least_m_s: float = MOVING_SPEED_M_S) -> Bool[Array, "vehicle"]:
    """Vehicles at least this fast."""
    return np.hypot(truth["east_speed"].values, truth["north_speed"].values) >= least_m_s


def is_in_window(truth: xr.Dataset, area_m: AreaM) -> Bool[Array, "vehicle"]:
    """Vehicles whose centre lies in (west, south, east, north), its edges included."""
    west, south, east, north = area_m
    x, y = truth["east"].values, truth["north"].values
    return (x >= west) & (x <= east) & (y >= south) & (y <= north)


def is_visible(truth: xr.Dataset, least: float = VISIBLE_FRACTION) -> Bool[Array, "vehicle"]:
    """Vehicles of which the camera sees this part at least (`render.visible_fraction`).

    All of them if the truth does not say.
    """
    if "visible_fraction" not in truth:
        return np.ones(truth["east"].shape, np.bool_)
    return truth["visible_fraction"].values >= least


def window_km2(area_m: AreaM) -> float:
    """Area of the window. [km²]

    Raises
    ------
    ValueError
        If it is empty.
    """
    west, south, east, north = area_m
    if not (west < east and south < north):
        raise ValueError(f"`area_m` must be (west, south, east, north) and not empty, got {tuple(area_m)}")
    return 1e-6 * (east - west) * (north - south)


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
    return EpochScore(
        vehicle_ids=vehicles.ids,
        track_ids=track_ids,
        should=should,
        visible=vehicles.visible,
        inside=vehicles.inside,
        matched_track=matched_track,
        matched_vehicle=matched_vehicle,
        distance_m=matched_distance,
        valid=valid,
        false=~matched & ~beside_others,
        near=near,
        time_s=float(time_s),
        area_km2=area_km2,
    )


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

    Returns
    -------
    Numbers of the pairs, by rising track.
    """
    if not len(near):
        return np.empty(0, int)
    alone = np.bincount(near[:, 0])[near[:, 0]] * np.bincount(near[:, 1])[near[:, 1]] == 1
    chosen, rest = np.flatnonzero(alone).tolist(), np.flatnonzero(~alone)
    for group in connected_components(*near[rest].T):
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


def connected_components(left: Int[Array, "pair"], right: Int[Array, "pair"]) -> list[Int[Array, "member"]]:
    """Groups of pairs that share an end, and of those that share one with them.

    Parameters
    ----------
    left, right
        Ends of each pair, numbered from 0 on either side.

    Returns
    -------
    Numbers of each group's pairs, rising.
    """
    if not len(left):
        return []
    first = left.max() + 1
    ends = left, first + right
    graph = coo_array((np.ones(len(left), np.bool_), ends), shape=2 * (first + right.max() + 1,))
    group = csgraph.connected_components(graph, directed=False)[1][left]
    order = np.argsort(group, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(group[order])) + 1)


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
