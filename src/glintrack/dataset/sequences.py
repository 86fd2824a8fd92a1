"""Frames on one grid with labels of their vehicles, and the matching of positions with these labels."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Bool, Float
from scipy.spatial.distance import cdist

from glintrack.core.arrays import Array
from glintrack.io.orthoimages import FrameSource, Geotransform, image_of
from glintrack.io.tables import read_csv, read_numbers
from glintrack.io.tracks import LABEL_FILE_COLUMNS
from glintrack.metrics.tracks import match

NEAR_M = 4.0  # from a label: a position is right
MOVING_M_S = 1.0  # a label that moves slower counts neither way
ABOUT = 2  # frames before and after, over which a label's speed is taken
LABEL_COLUMNS = ["frame", "vehicle_id", "asked", "east_m", "north_m"]
MAX_SEQUENCE_BYTES = 2_000_000_000


@dataclass(frozen=True)
class LabelledSequence:
    """Frames on one grid, whose north-west corner lies at (0, 0), and the labels in them.

    Parameters
    ----------
    times_s
        Time of each frame. [s]
    frames
        Counts; NaN where there is no data.
    gsd_m
        Side of a pixel. [m]
    labels
        A table with `LABEL_COLUMNS`. Labels that are not asked count neither way.
    areas
        Masks of ground by name.
    """

    times_s: Float[Array, "frame"]
    frames: Float[Array, "frame y x"]
    gsd_m: float
    labels: pd.DataFrame
    areas: dict[str, Bool[Array, "y x"]]

    def images(self) -> Iterator[tuple[float, xr.Dataset]]:
        """Yield the time and image of each frame, as ``glintrack track`` reads them."""
        for time_s, counts in zip(self.times_s, self.frames, strict=True):
            image = image_of({"pan": counts.astype(np.float32)}, Geotransform(0.0, 0.0, self.gsd_m))
            yield float(time_s), image

    def after(self, first: int) -> "LabelledSequence":
        """Sequence from a frame on."""
        labels = self.labels.take(np.flatnonzero(self.labels["frame"] >= first))
        labels = labels.assign(frame=labels["frame"] - first)
        return replace(self, times_s=self.times_s[first:], frames=self.frames[first:], labels=labels)

    def cells(self, places_m: Float[Array, "n 2"]) -> Array:
        """Row and column of the pixel at each place."""
        return np.floor(places_m[:, ::-1] * (-1, 1) / self.gsd_m).astype(int)

    def inside(self, area: str, places_m: Float[Array, "n 2"]) -> Bool[Array, "n"]:
        """Mask of the places that lie in an area."""
        cell, last = self.cells(places_m), np.array(self.areas[area].shape) - 1
        known = ((cell >= 0) & (cell <= last)).all(axis=1)
        return known & self.areas[area][tuple(np.clip(cell, 0, last).T)]


def read_sequence(source: FrameSource, path: Path) -> LabelledSequence:
    """Read frames, and a CSV file of their labels as ``glintrack dataset label`` makes it.

    Parameters
    ----------
    source
        Frames, all of the labelled ones among them.
    path
        CSV file with `LABEL_FILE_COLUMNS`; ``asked`` is 0 for labels that count neither way.

    Returns
    -------
    The sequence, with the ground of all frames as area ``all``.

    Raises
    ------
    ValueError
        If a column is missing, a label is of no frame, or the frames are too large for memory.
    """
    table = read_csv(path, "labels")
    if missing := [name for name in LABEL_FILE_COLUMNS if name not in table]:
        known = ", ".join(LABEL_FILE_COLUMNS)
        raise ValueError(f"`labels` must have the columns {known}; got no {missing[0]} in {path}.")
    values = pd.DataFrame(read_numbers(table, path, LABEL_FILE_COLUMNS), columns=list(LABEL_FILE_COLUMNS))
    times_s, frames, corner_m, gsd_m = list[float](), list[Array](), np.zeros(2), 1.0
    for time_s, image in source.frames:
        if not frames:
            x, y = image["x"].values, image["y"].values
            gsd_m = float(x[1] - x[0])
            corner_m = np.array([x[0] - gsd_m / 2, y[0] + gsd_m / 2])
        times_s.append(time_s)
        frames.append(image["pan"].values)
        if (size := len(frames) * frames[0].nbytes) > MAX_SEQUENCE_BYTES:
            raise ValueError(f"`frames` must have at most {MAX_SEQUENCE_BYTES:,} bytes; got {size:,}.")
    frame = values["frame"].to_numpy()
    known = np.isin(frame, np.arange(len(times_s)))
    if not known.all() or (values["time_s"].to_numpy() != np.array(times_s)[frame.astype(int)]).any():
        raise ValueError(f"`labels` must be of these frames and their times; got others in {path}.")
    labels = pd.DataFrame(
        {
            "frame": frame.astype(int),
            "vehicle_id": values["vehicle_id"].astype(int),
            "asked": values["asked"] > 0,
            "east_m": values["east_m"] - corner_m[0],
            "north_m": values["north_m"] - corner_m[1],
        }
    )
    areas, times = {"all": np.ones(frames[0].shape, bool)}, np.array(times_s)
    return LabelledSequence(times, np.stack(frames), gsd_m, with_speeds(labels, times), areas)


def with_speeds(labels: pd.DataFrame, times_s: Float[Array, "frame"]) -> pd.DataFrame:
    """Add the column ``speed_m_s`` to labels, of which those that stand are not asked."""
    speed_m_s = np.zeros(len(labels))
    frames, places_m = labels["frame"].to_numpy(), labels[["east_m", "north_m"]].to_numpy(float)
    for index in labels.groupby("vehicle_id").indices.values():
        frame, place_m = frames[index], places_m[index]
        for n, k in enumerate(frame):
            near = np.flatnonzero(np.abs(frame - k) <= ABOUT)[[0, -1]]
            way_m, passed_s = np.hypot(*np.ptp(place_m[near], axis=0)), np.ptp(times_s[frame[near]])
            speed_m_s[index[n]] = way_m / passed_s if passed_s > 0 else 0.0
    return labels.assign(asked=labels["asked"].astype(bool) & (speed_m_s >= MOVING_M_S), speed_m_s=speed_m_s)


@dataclass(frozen=True)
class Matches:
    """Positions and labels of a sequence after their matching.

    Parameters
    ----------
    labels
        Labels that are asked, in the area, with ``found`` and ``track_id`` of the matched position, −1
        without one.
    false
        Rows of the positions that are false in the area. Others count neither way.
    """

    labels: pd.DataFrame
    false: pd.DataFrame

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall of the positions. [1]"""
        right = np.count_nonzero(self.labels["found"])
        return 2 * right / max(right + len(self.false) + len(self.labels), 1)

    @property
    def false_tracks(self) -> pd.DataFrame:
        """First false position of each track with more false positions than right ones."""
        right = self.labels["track_id"].to_numpy(int)
        false = self.false["track_id"].to_numpy(int)
        ids, first, count = np.unique(false, return_index=True, return_counts=True)
        return self.false.take(first[[n > (right == one).sum() for one, n in zip(ids, count, strict=True)]])


def match_positions(sequence: LabelledSequence, rows: pd.DataFrame, area: str) -> Matches:
    """Match positions with labels, one to one in each frame within `NEAR_M`.

    As in CLEAR MOT, a track keeps the vehicle of the frame before while it is near. A position that is not
    matched is false, unless it is near a label that is not asked.

    Parameters
    ----------
    sequence
        Frames and labels.
    rows
        ``frame``, ``track_id``, ``east_m`` and ``north_m`` of each position.
    area
        Name of the area in which labels and false positions count.
    """
    labels = sequence.labels
    frames, asked = labels["frame"].to_numpy(int), labels["asked"].to_numpy(bool)
    label_m, place_m = (of[["east_m", "north_m"]].to_numpy(float) for of in (labels, rows))
    found, track_id = np.zeros(len(labels), bool), np.full(len(labels), -1)
    tracks, is_false = rows["track_id"].to_numpy(int), np.zeros(len(rows), bool)
    vehicle = np.unique(labels["vehicle_id"], return_inverse=True)[1]
    before = np.full(len(labels), -1)  # track of each vehicle in the frame before
    for k in range(len(sequence.times_s)):
        row = np.flatnonzero(rows["frame"].to_numpy() == k)
        scored, ignored = (np.flatnonzero((frames == k) & (asked == flag)) for flag in (True, False))
        distance_m, to_ignored_m = (cdist(place_m[row], label_m[label]) for label in (scored, ignored))
        pairs = np.argwhere(distance_m <= NEAR_M)
        is_kept = tracks[row[pairs[:, 0]]] == before[vehicle[scored[pairs[:, 1]]]]
        # the same track costs nothing, any other more than the distance limit
        cost_m = np.where(is_kept, 0.0, NEAR_M + distance_m[tuple(pairs.T)])
        i, j = pairs[match(pairs, cost_m, 2 * NEAR_M)].T
        found[scored[j]] = True
        track_id[scored[j]] = tracks[row[i]]
        before[:] = -1
        before[vehicle[scored[j]]] = tracks[row[i]]
        is_unmatched = np.array((to_ignored_m > NEAR_M).all(axis=1))
        is_unmatched[i] = False
        is_false[row] = is_unmatched
    is_false &= sequence.inside(area, place_m)
    counted = np.flatnonzero(asked & sequence.inside(area, label_m))
    labels = labels.assign(found=found, track_id=track_id).take(counted)
    return Matches(labels, rows.take(np.flatnonzero(is_false)))


def count_switches(labels: pd.DataFrame) -> int:
    """Count the changes of the track of each vehicle, in labels with ``found`` and ``track_id``."""
    table = labels[["vehicle_id", "frame", "track_id"]].to_numpy(int)[labels["found"].to_numpy(bool)]
    vehicle, _, track = table[np.lexsort((table[:, 1], table[:, 0]))].T
    return int(np.count_nonzero((np.diff(vehicle) == 0) & (np.diff(track) != 0)))
