"""Scores of tables: tracks and truth with one row per object and epoch."""

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from glintrack.core import schema
from glintrack.core.arrays import Array
from glintrack.core.records import Extent
from glintrack.core.schema import MOVING_SPEED_M_S
from glintrack.metrics.multi_object import gospa, multi_object_scores, ospa, point_similarity
from glintrack.metrics.summary import summarize
from glintrack.metrics.tracks import (
    MATCH_DISTANCE_M,
    AreaM,
    EpochScore,
    match_epoch,
    places_of,
    unlike,
    vehicles_of,
    window_km2,
)

SAME_TIME_S = 1e-3  # files round their times


def score_rows(
    tracks: xr.Dataset,
    truth: xr.Dataset,
    area_m: AreaM | None = None,
    match_distance_m: float = MATCH_DISTANCE_M,
    moving_speed_m_s: float = MOVING_SPEED_M_S,
) -> dict[str, float]:
    """Every score of a run, at the epochs of the truth.

    Parameters
    ----------
    tracks, truth
        Datasets with dim ``row``: ``time_s``, ``track_id`` or ``vehicle_id``, ``east``, ``north``, the truth
        with ``east_speed`` and ``north_speed`` [s, m, m s⁻¹], perhaps ``visible_fraction`` and ``inside``.
    area_m
        Area of interest (west, south, east, north); by default the box around the truth, or around that of
        it which is ``inside``. [m]
    match_distance_m, moving_speed_m_s
        As in `score_epoch`.

    Returns
    -------
    What `summarize` gives; ``mota``, ``motp``, ``idf1``, ``hota``, ``deta``, ``assa`` over all vehicles and
    tracks inside the area; ``ospa_m`` and ``gospa_m``, means over the epochs.

    Raises
    ------
    ValueError
        If a track has a row at a time that the truth does not have.
    """
    area = _area(truth) if area_m is None else area_m
    scores = score_epochs(tracks, truth, area, match_distance_m, moving_speed_m_s)
    epochs, of_vehicles = _epochs_of(truth)
    of_tracks = _split(_epoch_of(tracks, epochs), len(epochs))
    alike, distances = [], []
    for track_rows, vehicle_rows in zip(of_tracks, of_vehicles, strict=True):
        vehicles, vehicle_m = _inside(truth, "vehicle_id", vehicle_rows, area)
        found, track_m = _inside(tracks, "track_id", track_rows, area)
        alike.append(point_similarity(vehicles, vehicle_m, found, track_m, match_distance_m))
        distances.append((ospa(vehicle_m, track_m), gospa(vehicle_m, track_m)))
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
    area_m: AreaM | None = None,
    match_distance_m: float = MATCH_DISTANCE_M,
    moving_speed_m_s: float = MOVING_SPEED_M_S,
) -> list[EpochScore]:
    """Tracks against truth at each epoch of the truth; arguments and errors as of `score_rows`."""
    (scores,) = score_tables([tracks], truth, area_m, match_distance_m, moving_speed_m_s)
    return scores


def score_tables(
    tables: Sequence[xr.Dataset],
    truth: xr.Dataset,
    area_m: AreaM | None = None,
    match_distance_m: float = MATCH_DISTANCE_M,
    moving_speed_m_s: float = MOVING_SPEED_M_S,
) -> list[list[EpochScore]]:
    """`score_epochs` of several tables of tracks against the same truth, which is prepared once."""
    area = _area(truth) if area_m is None else area_m
    area_km2 = window_km2(area)
    epochs, of_vehicles = _epochs_of(truth)
    there = schema.check(_truth(_columns(truth)), "truth")
    every = vehicles_of(there, there["vehicle"].values, area, moving_speed_m_s)
    vehicles = [every.only(rows) for rows in of_vehicles]
    for one in vehicles:
        unlike(one.ids, "vehicle")
    out = []
    for tracks in tables:
        found = schema.check(_tracks(_columns(tracks)), "tracks")
        ids, place_m = found["track"].values, places_of(found)
        of_tracks = _split(_epoch_of(tracks, epochs), len(epochs))
        at_epochs = zip(epochs.tolist(), of_tracks, vehicles, strict=True)
        out.append(
            [
                match_epoch(
                    unlike(ids[rows], "track"), place_m[rows], now, match_distance_m, time_s, area_km2
                )
                for time_s, rows, now in at_epochs
            ]
        )
    return out


Columns = Mapping[str, Array]


def _epochs_of(truth: xr.Dataset) -> tuple[Float[Array, "epoch"], list[Array]]:
    """Times of the truth, and its rows at each."""
    if not truth.sizes.get("row"):
        return np.empty(0), []
    epochs, now = np.unique(truth["time_s"].values, return_inverse=True)
    return epochs, _split(now, len(epochs))


def _columns(table: xr.Dataset) -> Columns:
    """Columns of a table by name; none of an empty one."""
    if not table.sizes.get("row"):
        return {}
    return {str(name): one.values for name, one in table.variables.items() if one.dims == ("row",)}


def _split(index: Int[Array, "row"], count: int) -> list[Array]:
    """Rows of each value of an index, in their order."""
    if not count:
        return []
    order = np.argsort(index, kind="stable")
    return np.split(order, np.searchsorted(index[order], np.arange(1, count)))


def _epoch_of(tracks: xr.Dataset, epochs: Float[Array, "epoch"]) -> Array:
    """Index of the epoch of each row."""
    if not tracks.sizes.get("row"):
        return np.empty(0, int)
    time_s = tracks["time_s"].values.astype(float)
    if len(epochs) == 0:
        raise ValueError("`truth` must have rows at the times of the tracks, got none")
    after = np.minimum(np.searchsorted(epochs, time_s), len(epochs) - 1)
    before = np.maximum(after - 1, 0)
    index = np.where(np.abs(epochs[before] - time_s) <= np.abs(epochs[after] - time_s), before, after)
    stray = np.abs(epochs[index] - time_s) > SAME_TIME_S
    if stray.any():
        raise ValueError(
            f"`tracks` must have the truth's times, got {int(stray.sum())} rows at others, the first at "
            f"{time_s[stray][0]:g} s where the truth's lie between {epochs[0]:g} and {epochs[-1]:g} s"
        )
    return index


def _area(truth: xr.Dataset) -> Extent:
    if not truth.sizes.get("row"):
        return Extent(-1.0, -1.0, 1.0, 1.0)
    inside = truth["inside"].values.astype(bool) if "inside" in truth else np.zeros(0, bool)
    place = np.stack([truth["east"].values, truth["north"].values], axis=1).astype(float)
    if inside.any():  # truth of a run, of vehicles beyond its window too
        place = place[inside]
    low, high = place.min(axis=0), place.max(axis=0)
    room_m = 0.0 if inside.any() and (high > low).all() else 1.0
    return Extent(*(low - room_m).tolist(), *(high + room_m).tolist())


def _inside(table: xr.Dataset, ident: str, rows: Int[Array, "row"], area: AreaM) -> tuple[Array, Array]:
    """Numbers and places of those rows that lie in the area."""
    if not len(rows):
        return np.empty(0, int), np.empty((0, 2))
    x, y = (table[name].values[rows].astype(float) for name in ("east", "north"))
    west, south, east, north = area
    inside = (x >= west) & (x <= east) & (y >= south) & (y <= north)
    return table[ident].values[rows][inside], np.stack([x, y], axis=-1)[inside]


def _tracks(rows: Columns) -> xr.Dataset:
    """Rows of one epoch as the schema ``tracks``; what a table does not say is 0."""
    units = {
        "east": "m", "north": "m", "east_speed": "m s-1", "north_speed": "m s-1", "east_var": "m2",
        "north_var": "m2", "coasted": "1",
    }  # fmt: skip
    return _labelled(rows, "track", "track_id", units)


def _truth(rows: Columns) -> xr.Dataset:
    units = {
        "east": "m", "north": "m", "up": "m", "east_speed": "m s-1", "north_speed": "m s-1", "heading": "rad",
        "length": "m", "width": "m", "height": "m",
    }  # fmt: skip
    if "visible_fraction" in rows:
        units["visible_fraction"] = "1"
    return _labelled(rows, "vehicle", "vehicle_id", units)


def _labelled(rows: Columns, dim: str, ident: str, units: dict[str, str]) -> xr.Dataset:
    ids = rows[ident].astype(int) if rows else np.empty(0, int)
    columns = {}
    for name, unit in units.items():
        values = np.asarray(rows[name], float) if name in rows else np.zeros(len(ids))
        columns[name] = (dim, values, {"units": unit})
    return xr.Dataset(columns, coords={dim: ids})
