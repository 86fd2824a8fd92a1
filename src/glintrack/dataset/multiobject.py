"""Sets and tracks as MAITE's ``multiobject_tracking`` protocols want them, structurally: MAITE is not needed.

Boxes are x0, y0, x1, y1 with edges at integers, so that the first pixel spans 0 to 1; labels count
`VEHICLE_CLASSES` from 0; a track's id is never negative.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Float, Int, UInt

from glintrack.core.arrays import Array
from glintrack.dataset.annotations import boxes_of
from glintrack.dataset.build import read_plan
from glintrack.dataset.plan import DatasetPlan
from glintrack.dataset.shards import ShardFiles
from glintrack.io.raw_mosaics import read_raw
from glintrack.io.tracks import BOX_M, TrackGeoreference
from glintrack.metrics import VISIBLE_FRACTION
from glintrack.scene import VEHICLE_CLASSES

_MICROSECONDS = 1_000_000


@dataclass(frozen=True)
class VideoFrame:
    """One frame: counts (1, row, column), when it was taken [s], that in µs, and its index from 0."""

    pixels: UInt[Array, "1 row column"]
    time_s: float
    pts: int
    frame_index: int


@dataclass(frozen=True)
class FrameTracks:
    """What is where in one frame.

    Parameters
    ----------
    boxes
        x0, y0, x1, y1. [pixel]
    labels, scores, track_ids
        Of each box.
    """

    boxes: Float[Array, "box 4"]
    labels: Int[Array, "box"]
    scores: Float[Array, "box"]
    track_ids: Int[Array, "box"]


@dataclass(frozen=True)
class VideoTracks:
    """Tracks over a video, frame by frame."""

    frame_tracks: Sequence[FrameTracks]


@dataclass(frozen=True)
class RawVideo:
    """The raws of one case of a set, read when they are iterated over."""

    folder: Path
    plan: DatasetPlan
    name: str

    def __iter__(self) -> Iterator[VideoFrame]:
        """Frame by frame."""
        rate = self.plan.cases[self.name].flight.rate_hz
        for shard in self.plan.shards(self.name):
            for k in shard.frames:
                counts = read_raw(self.folder / ShardFiles(shard).raw(k))[None]
                yield VideoFrame(counts, k / rate, round(k / rate * _MICROSECONDS), k)


class TrackingSet:
    """A split of a set, one video a case, its boxes as truth: MAITE's ``Dataset``.

    Parameters
    ----------
    folder
        That `build_dataset` wrote.
    split
        ``train``, ``val`` or ``test``.
    least_visible
        Of a vehicle that is truth. [1]
    allow_outside_paths
        As of `build.read_plan`.

    Raises
    ------
    ValueError
        If the folder holds no whole set, or the split no case.
    """

    def __init__(
        self,
        folder: str | Path,
        split: str = "test",
        least_visible: float = VISIBLE_FRACTION,
        allow_outside_paths: bool = False,
    ):
        self.folder, self.plan = Path(folder), read_plan(folder, allow_outside_paths)
        self.names = [name for name in self.plan.cases if self.plan.split[name] == split]
        self.least_visible = least_visible
        if not self.names:
            held = ", ".join(sorted(set(self.plan.split.values())))
            raise ValueError(f"`split` must be one that the set has ({held}), got {split!r}")
        self.metadata = {"id": self.plan.key, "index2label": dict(enumerate(VEHICLE_CLASSES))}

    def __len__(self) -> int:
        """How many videos."""
        return len(self.names)

    def __getitem__(self, ind: int, /) -> tuple[RawVideo, VideoTracks, dict]:
        """One case: its raws, the vehicles that move or stand in them, and their size."""
        name = self.names[ind]
        case = self.plan.cases[name]
        boxes = boxes_of(self.folder, self.plan, name)
        boxes = boxes.query(f"visible_fraction >= {self.least_visible!r}")
        frames = [_of_boxes(boxes.query(f"frame == {k}")) for k in range(case.flight.frames)]
        metadata = {
            "id": name,
            "height": case.sensor.rows,
            "width": case.sensor.columns,
            "time_base": Fraction(1, _MICROSECONDS),
        }
        return RawVideo(self.folder, self.plan, name), VideoTracks(frames), metadata


def track_target(rows: xr.Dataset, place: TrackGeoreference) -> VideoTracks:
    """Tracks as MAITE's target, in pixels of rectified frames: squares of `BOX_M` about each place.

    Parameters
    ----------
    rows
        One row per track and frame, as ``load_result(…)["pan/tracks"]`` holds them; of the class of cars.
    place
        First pixel and side of the frames, and their times.
    """
    times_s = np.asarray(place.times_s, float)
    west, north = place.north_west_m
    half = 0.5 * BOX_M / place.cell_m
    frames = []
    for time_s in times_s:
        mine = np.abs(rows["time_s"].values - time_s) < 1e-6 if rows.sizes.get("row") else np.zeros(0, bool)
        x = (rows["east"].values[mine] - west) / place.cell_m if mine.any() else np.empty(0)
        y = (north - rows["north"].values[mine]) / place.cell_m if mine.any() else np.empty(0)
        ids = rows["track_id"].values[mine].astype(np.int64) if mine.any() else np.empty(0, np.int64)
        boxes = np.stack([x - half, y - half, x + half, y + half], axis=1)
        frames.append(FrameTracks(boxes, np.zeros(len(ids), np.int64), np.ones(len(ids)), ids))
    return VideoTracks(frames)


def _of_boxes(boxes: pd.DataFrame) -> FrameTracks:
    corners = boxes[["x0_px", "y0_px", "x1_px", "y1_px"]].to_numpy(float) + 0.5
    labels = np.array([VEHICLE_CLASSES.index(str(one)) for one in boxes["class"]], np.int64)
    return FrameTracks(corners, labels, np.ones(len(boxes)), boxes["vehicle_id"].to_numpy(np.int64))
