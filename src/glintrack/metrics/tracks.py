"""Match tracks with vehicles at each epoch: the vehicles that count, and the right and false tracks.

At each epoch tracks and vehicles are matched one to one within 5 m: as many pairs as possible, and among
those the least total distance. All vehicles take part, so that a track on a stopped vehicle is not matched
with another vehicle that drives past. Presnar et al., Proc. SPIE 7672, 76720T (2010), §4.2.

A false track is unmatched, not outside a polygon, and no stopped or outside vehicle is in matching distance.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
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
Area = tuple[float, float, float, float] | shapely.Geometry  # west, south, east, north, or corners [m]
Over = Literal["moving", "visible", "all"]


def is_moving(truth: xr.Dataset, min_m_s: float = MOVING_SPEED_M_S) -> Bool[Array, "vehicle"]:
    """Return True for vehicles at least this fast."""
    return np.hypot(truth["east_speed_m_s"].values, truth["north_speed_m_s"].values) >= min_m_s


def is_in_area(truth: xr.Dataset, area_m: Area) -> Bool[Array, "vehicle"]:
    """Return True for vehicles with their centre in the area, edges included."""
    return contains(area_m, positions_of(truth))


def contains(area_m: Area, place_m: Float[Array, "n 2"]) -> Bool[Array, "n"]:
    """Return True for places in the area, edges included."""
    x, y = place_m.T
    if isinstance(area_m, shapely.Geometry):
        return np.asarray(shapely.intersects_xy(area_m, x, y), np.bool_)
    west, south, east, north = area_m
    return (x >= west) & (x <= east) & (y >= south) & (y <= north)


def is_visible(truth: xr.Dataset, min_fraction: float = VISIBLE_FRACTION) -> Bool[Array, "vehicle"]:
    """Return True for vehicles with at least this visible fraction (`render.visible_fraction`).

    All are visible in a truth without the variable.
    """
    if "visible_fraction" not in truth:
        return np.ones(truth["east_m"].shape, np.bool_)
    return truth["visible_fraction"].values >= min_fraction


def area_km2(area_m: Area) -> float:
    """Size of the area; NaN for an empty polygon. [km²]

    Raises
    ------
    ValueError
        If a rectangle is empty.
    """
    if isinstance(area_m, shapely.Geometry):
        return 1e-6 * float(shapely.area(area_m)) or float("nan")
    west, south, east, north = area_m
    if not (west < east and south < north):
        raise ValueError(f"`area_m` must be (west, south, east, north) and not empty; got {tuple(area_m)}.")
    return 1e-6 * (east - west) * (north - south)


@dataclass(frozen=True)
class EpochScore:
    """Matches of tracks and truth at one epoch.

    Parameters
    ----------
    vehicle_ids, track_ids
        All vehicles of the truth and all tracks reported.
    should
        Vehicles that should be tracked: moving and inside the area, occluded or not.
    visible
        Those of `should` that are visible.
    inside
        Vehicles inside the area, stopped ones included.
    matched_track
        Track id matched to each vehicle, −1 for none.
    matched_vehicle
        Vehicle id matched to each track, −1 for none.
    distance_m
        Distance of each track to its matched vehicle, NaN for none. [m]
    valid, false
        Masks of the right and of the false tracks. A track matched to a stopped vehicle or one outside the
        area, or unmatched with such a vehicle within the matching distance, is neither.
    near
        Indices of track and vehicle of every pair within the matching distance.
    time_s
        Epoch; NaN if unknown. [s]
    area_km2
        Size of the area; NaN if it is empty. [km²]
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
            raise ValueError(f"`over` must be 'moving', 'visible' or 'all'; got {over!r}.") from None
        return float(np.mean(self.matched_track[counted] >= 0)) if counted.any() else float("nan")


def score_epoch(
    tracks: xr.Dataset,
    truth: xr.Dataset,
    area_m: Area,
    match_distance_m: float = MATCH_DISTANCE_M,
    moving_speed_m_s: float = MOVING_SPEED_M_S,
    visible_fraction: float = VISIBLE_FRACTION,
    time_s: float = float("nan"),
) -> EpochScore:
    """Match the tracks of one epoch with its vehicles.

    Parameters
    ----------
    tracks, truth
        Datasets of the schemas ``tracks`` and ``truth``; the truth may have ``visible_fraction``. [m]
    area_m
        Scored area: west, south, east, north, or a polygon; edges included. [m]
    match_distance_m
        Maximum distance of a track from its vehicle. [m]
    moving_speed_m_s
        Minimum speed of a moving vehicle. [m s⁻¹]
    visible_fraction
        Minimum visible fraction of a visible vehicle. [1]
    time_s
        Epoch, which scores of custody over time need. [s]

    Raises
    ------
    ValueError
        If a dataset breaks its schema or the area is empty.
    """
    schema.check(tracks, "tracks")
    schema.check(truth, "truth")
    every, inside = ids_of(truth, "vehicle"), is_in_area(truth, area_m)
    vehicles = vehicles_of(truth, every, inside, moving_speed_m_s, visible_fraction)
    ids = ids_of(tracks, "track")
    return match_epoch(ids, positions_of(tracks), vehicles, match_distance_m, time_s, area_m)


@dataclass(frozen=True)
class Vehicles:
    """Vehicles of one epoch or of many.

    Parameters
    ----------
    ids, place_m
        Ids and positions. [m]
    should, visible, inside
        See `EpochScore`.
    """

    ids: Int[Array, "vehicle"]
    place_m: Float[Array, "vehicle 2"]
    should: Bool[Array, "vehicle"]
    visible: Bool[Array, "vehicle"]
    inside: Bool[Array, "vehicle"]

    def select(self, rows: Int[Array, "chosen"]) -> "Vehicles":
        """Select the vehicles at some rows."""
        return Vehicles(**{name: values[rows] for name, values in vars(self).items()})


def vehicles_of(
    truth: xr.Dataset,
    ids: Int[Array, "vehicle"],
    inside: Bool[Array, "vehicle"],
    moving_speed_m_s: float = MOVING_SPEED_M_S,
    visible_fraction: float = VISIBLE_FRACTION,
) -> Vehicles:
    """Select what scores need of the truth, and whether each vehicle is inside; see `score_epoch`."""
    should = inside & is_moving(truth, moving_speed_m_s)
    return Vehicles(ids, positions_of(truth), should, should & is_visible(truth, visible_fraction), inside)


def match_epoch(
    track_ids: Int[Array, "track"],
    track_m: Float[Array, "track 2"],
    vehicles: Vehicles,
    match_distance_m: float,
    time_s: float,
    area_m: Area,
) -> EpochScore:
    """Match the arrays of one epoch; see `score_epoch`."""
    v, should = vehicles.place_m, vehicles.should
    near, distance = near_pairs(track_m, v, match_distance_m)
    chosen = match(near, distance, match_distance_m)
    rows, columns = near[chosen].T
    matched_track = np.full(len(v), -1)
    matched_track[columns] = track_ids[rows]
    matched_vehicle = np.full(len(track_m), -1)
    matched_vehicle[rows] = vehicles.ids[columns]
    matched_distance = np.full(len(track_m), np.nan)
    matched_distance[rows] = distance[chosen]

    matched = matched_vehicle >= 0
    valid = np.zeros(len(track_m), bool)
    valid[rows] = should[columns]
    excused = np.zeros(len(track_m), bool)
    excused[near[~should[near[:, 1]], 0]] = True
    if isinstance(area_m, shapely.Geometry):
        excused |= ~contains(area_m, track_m)
    return EpochScore(
        vehicle_ids=vehicles.ids, track_ids=track_ids, should=should, visible=vehicles.visible,
        inside=vehicles.inside, matched_track=matched_track, matched_vehicle=matched_vehicle,
        distance_m=matched_distance, valid=valid, false=~matched & ~excused, near=near,
        time_s=float(time_s), area_km2=area_km2(area_m),
    )  # fmt: skip


def near_pairs(
    track_m: Float[Array, "track 2"], vehicle_m: Float[Array, "vehicle 2"], limit_m: float
) -> tuple[Int[Array, "pair 2"], Float[Array, "pair"]]:
    """Find pairs of track and vehicle within a distance, by rising track, then vehicle, and distances."""
    if not len(track_m) or not len(vehicle_m):
        return np.empty((0, 2), int), np.empty(0)
    reach = limit_m * (1 + 1e-9)  # the tree rounds otherwise
    found = KDTree(vehicle_m).query_ball_point(track_m, reach, return_sorted=True)
    track = np.repeat(np.arange(len(track_m)), [len(one) for one in found])
    vehicle = np.concatenate([np.asarray(one, int) for one in found])
    distance_m = np.hypot(*(track_m[track] - vehicle_m[vehicle]).T)
    inside = distance_m <= limit_m
    return np.stack([track, vehicle], axis=-1)[inside], distance_m[inside]


def match(near: Int[Array, "pair 2"], distance: Float[Array, "pair"], limit: float) -> Int[Array, "chosen"]:
    """Match one to one within the limit: as many pairs as possible, then at least total distance.

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
        row, column = (np.unique(side, return_inverse=True)[1] for side in near[pairs].T)
        shape = row.max() + 1, column.max() + 1
        # one pair more always outweighs any distance
        cost, which = np.full(shape, 1.0 + 2.0 * limit * min(shape)), np.full(shape, -1)
        cost[row, column], which[row, column] = distance[pairs], pairs
        found = which[linear_sum_assignment(cost)]
        chosen += found[found >= 0].tolist()
    return np.array(sorted(chosen), int)


def connected_components(left: Int[Array, "pair"], right: Int[Array, "pair"]) -> list[Int[Array, "member"]]:
    """Group pairs that share an end, directly or through other pairs.

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
    """Ids along a dim, all different."""
    if dim not in dataset.coords:
        raise ValueError(f"`{dim}` must be a coordinate of integer ids; got none.")
    return check_ids(np.asarray(dataset[dim].values), dim)


def check_ids(ids: Int[Array, "id"], name: str) -> Int[Array, "id"]:
    """Check that ids are integers and all different, and return them."""
    if ids.size and not (np.issubdtype(ids.dtype, np.integer) and ids.min() >= 0):
        raise ValueError(f"`{name}` must hold integer ids of 0 or more; got {ids[:4]}.")
    repeated = len(ids) - len(np.unique(ids))
    if repeated:
        raise ValueError(f"`{name}` must hold each id once; got {repeated} repeated.")
    return ids.astype(np.int64)


def positions_of(dataset: xr.Dataset) -> Float[Array, "n 2"]:
    """East and north. [m]"""
    return np.stack([dataset["east_m"].values, dataset["north_m"].values], axis=-1).astype(float)
