"""Scores of tables: tracks and truth with one row per object and epoch."""

import math
import warnings
from collections.abc import Callable, Sequence

import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.records import Extent
from glintrack.core.schema import MOVING_SPEED_M_S
from glintrack.metrics.multi_object import gospa, multi_object_scores, ospa, point_similarity
from glintrack.metrics.summary import summarize
from glintrack.metrics.tracks import (
    MATCH_DISTANCE_M,
    Area,
    EpochScore,
    check_ids,
    contains,
    match_epoch,
    positions_of,
    vehicles_of,
)

SAME_TIME_S = 1e-3  # times in files are rounded
_REGULAR = 5  # steps between the times of tracks, all of one length, that show their rate
Areas = Area | Callable[[float], Area]  # the same at each epoch, or a function of the epoch [s]


def score_rows(
    tracks: xr.Dataset,
    truth: xr.Dataset,
    area_m: Areas | None = None,
    match_distance_m: float = MATCH_DISTANCE_M,
    moving_speed_m_s: float = MOVING_SPEED_M_S,
) -> dict[str, float]:
    """Compute all scores of a run, at the epochs of the truth.

    Parameters
    ----------
    tracks, truth
        Datasets with dim ``row``: ``time_s``, ``track_id`` or ``vehicle_id``, ``east_m``, ``north_m``; the
        truth with ``east_speed_m_s``, ``north_speed_m_s``, optionally ``visible_fraction`` and ``inside``.
    area_m
        Scored area: west, south, east, north, a polygon, or a function that gives it for an epoch. By default
        the vehicles that are ``inside`` count, and the area is the box around them, or around all. [m]
    match_distance_m, moving_speed_m_s
        See `score_epoch`.

    Returns
    -------
    Scores of `summarize`; ``mota``, ``motp``, ``idf1``, ``hota``, ``deta``, ``assa`` over all vehicles and
    tracks inside the area; ``ospa_m`` and ``gospa_m``, means over the epochs.

    Raises
    ------
    ValueError
        If no track has a row at a time of the truth.

    Warns
    -----
    UserWarning
        If only some times of tracks and truth are common: the others are not scored.
    """
    tracks, truth = _at_common_times(tracks, truth)
    area_of = _area_function(area_m, truth)
    scores = score_epochs(tracks, truth, area_m, match_distance_m, moving_speed_m_s)
    epochs, of_vehicles = _epochs_of(truth)
    of_tracks = _split(_epoch_of(tracks, epochs), len(epochs))
    (vehicles, vehicle_m), (found, track_m) = _objects(truth, "vehicle_id"), _objects(tracks, "track_id")
    alike, distances = [], []
    for track_rows, vehicle_rows, score in zip(of_tracks, of_vehicles, scores, strict=True):
        inside = contains(area_of(score.time_s), track_m[track_rows])
        # a track beyond the edge may be on a vehicle at it
        own = inside | np.isin(score.matched_vehicle, score.vehicle_ids[score.inside])
        t, v = track_rows[own], vehicle_rows[score.inside]
        alike.append(point_similarity(vehicles[v], vehicle_m[v], found[t], track_m[t], match_distance_m))
        distances.append((ospa(vehicle_m[v], track_m[t]), gospa(vehicle_m[v], track_m[t])))
    mean_ospa, mean_gospa = np.mean(distances, axis=0) if distances else (float("nan"), float("nan"))
    return {
        **summarize(scores),
        **multi_object_scores(alike),
        "ospa_m": float(mean_ospa),
        "gospa_m": float(mean_gospa),
    }


def score_epochs(
    tracks: xr.Dataset,
    truth: xr.Dataset,
    area_m: Areas | None = None,
    match_distance_m: float = MATCH_DISTANCE_M,
    moving_speed_m_s: float = MOVING_SPEED_M_S,
    first_s: float = -math.inf,
) -> list[EpochScore]:
    """Score tracks against truth at each epoch of the truth from ``first_s`` on; see `score_rows`."""
    (scores,) = score_tables([tracks], truth, area_m, match_distance_m, moving_speed_m_s, first_s)
    return scores


def score_tables(
    tables: Sequence[xr.Dataset],
    truth: xr.Dataset,
    area_m: Areas | None = None,
    match_distance_m: float = MATCH_DISTANCE_M,
    moving_speed_m_s: float = MOVING_SPEED_M_S,
    first_s: float = -math.inf,
) -> list[list[EpochScore]]:
    """Score several tables of tracks against the same truth like `score_epochs`.

    Raises
    ------
    ValueError
        If tracks are at a time that the truth does not have.
    """
    area_of, out = _area_function(area_m, truth), []
    epochs, of_vehicles = _epochs_of(truth)
    areas, vehicles = [area_of(time_s) for time_s in epochs.tolist()], []
    if len(epochs):
        ids, place_m = _objects(truth, "vehicle_id")
        inside = _marked_inside(truth) & (area_m is None)
        if area_m is not None or "inside" not in truth:
            for rows, area in zip(of_vehicles, areas, strict=True):
                inside[rows] = contains(area, place_m[rows])
        every = vehicles_of(truth, ids, inside, moving_speed_m_s)
        vehicles = [every.select(rows) for rows in of_vehicles]
    for one in vehicles:
        check_ids(one.ids, "vehicle")
    for tracks in tables:
        ids, place_m = _objects(tracks, "track_id")
        index = _epoch_of(tracks, epochs)
        if (index < 0).any():
            other = tracks["time_s"].values[index < 0][0]
            raise ValueError(f"`tracks` must have times of the truth only; got tracks at {other:g} s.")
        of_tracks = _split(index, len(epochs))
        at_epochs = zip(epochs.tolist(), of_tracks, vehicles, areas, strict=True)
        out.append(
            [
                match_epoch(check_ids(ids[rows], "track"), place_m[rows], now, match_distance_m, time_s, area)
                for time_s, rows, now, area in at_epochs
                if time_s >= first_s
            ]
        )
    return out


def _epochs_of(truth: xr.Dataset) -> tuple[Float[Array, "epoch"], list[Array]]:
    """Epochs of the truth, and its rows at each."""
    if not truth.sizes.get("row"):
        return np.empty(0), []
    epochs, now = np.unique(truth["time_s"].values, return_inverse=True)
    return epochs, _split(now, len(epochs))


def _objects(table: xr.Dataset, name: str) -> tuple[Int[Array, "row"], Float[Array, "row 2"]]:
    """Ids and positions of a table, which may be empty. [m]"""
    if not table.sizes.get("row"):
        return np.empty(0, int), np.empty((0, 2))
    return table[name].values.astype(int), positions_of(table)


def _split(index: Int[Array, "row"], count: int) -> list[Array]:
    """Rows of each value of an index, in their order."""
    if not count:
        return []
    order = np.argsort(index, kind="stable")
    return np.split(order, np.searchsorted(index[order], np.arange(1, count)))


def _epoch_of(tracks: xr.Dataset, epochs: Float[Array, "epoch"]) -> Int[Array, "row"]:
    """Index of the epoch of each row; -1 at another time."""
    if not tracks.sizes.get("row"):
        return np.empty(0, int)
    time_s = tracks["time_s"].values.astype(float)
    if len(epochs) == 0:
        raise ValueError("`truth` must have rows at the times of the tracks; got none.")
    after = np.minimum(np.searchsorted(epochs, time_s), len(epochs) - 1)
    before = np.maximum(after - 1, 0)
    index = np.where(np.abs(epochs[before] - time_s) <= np.abs(epochs[after] - time_s), before, after)
    return np.where(np.abs(epochs[index] - time_s) <= SAME_TIME_S, index, -1)


def _at_common_times(tracks: xr.Dataset, truth: xr.Dataset) -> tuple[xr.Dataset, xr.Dataset]:
    """Select the rows of tracks and truth at common times, and warn of the others.

    An epoch of the truth without tracks counts, unless the tracks are at every nth epoch and it is between.
    """
    epochs, _ = _epochs_of(truth)
    index = _epoch_of(tracks, epochs)
    times_s = np.unique(tracks["time_s"].values) if tracks.sizes.get("row") else np.empty(0)
    common = np.unique(index[index >= 0])
    if len(times_s) and not len(common):
        raise ValueError(
            f"`tracks` must have times of the truth; got {times_s[0]:g} to {times_s[-1]:g} s, and the "
            f"truth's {len(epochs):,} times from {epochs[0]:g} to {epochs[-1]:g} s are others. Do both count "
            "from the same second?"
        )
    steps, selected = np.diff(common), np.ones(len(epochs), bool)
    every = int(np.gcd.reduce(steps)) if len(steps) >= _REGULAR and np.median(steps) == steps.min() else 1
    if every > 1 and every == steps.min():
        selected = (np.arange(len(epochs)) - common[0]) % every == 0
    strays = len(times_s) - len(common)
    if strays > 0:
        warnings.warn(
            f"tracks have {len(times_s):,} times, {strays:,} of which are not the truth's: not scored",
            stacklevel=3,
        )
    if not selected.all():
        warnings.warn(
            f"tracks are at one in {every} of the truth's {len(epochs):,} times: scored at "
            f"{selected.sum():,} of them",
            stacklevel=3,
        )
        truth = truth.isel(row=selected[np.searchsorted(epochs, truth["time_s"].values)])
    return (tracks if (index >= 0).all() else tracks.isel(row=index >= 0)), truth


def _area_function(area_m: Areas | None, truth: xr.Dataset) -> Callable[[float], Area]:
    """Scored area at each epoch."""
    if callable(area_m):
        return area_m
    area = _area(truth) if area_m is None else area_m
    return lambda time_s: area


def _area(truth: xr.Dataset) -> Extent:
    """Box around the vehicles that are inside, or around all."""
    if not truth.sizes.get("row"):
        return Extent(-1.0, -1.0, 1.0, 1.0)
    inside, place = _marked_inside(truth), positions_of(truth)
    if inside.any():  # the truth of a run has vehicles outside its window too
        place = place[inside]
    low, high = place.min(axis=0), place.max(axis=0)
    room_m = 0.0 if inside.any() and (high > low).all() else 1.0
    return Extent(*(low - room_m).tolist(), *(high + room_m).tolist())


def _marked_inside(truth: xr.Dataset) -> Array:
    """Return True for each row that is marked as inside."""
    return truth["inside"].values.astype(bool) if "inside" in truth else np.zeros(truth.sizes["row"], bool)
