"""Data sets with the structure of MAITE's ``multiobject_tracking`` protocols; MAITE is not needed.

Boxes are x0, y0, x1, y1 with pixel edges at integers; labels are indices into `VEHICLE_CLASSES`; track ids
are not negative.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float, Int, UInt

from glintrack.core.arrays import Array
from glintrack.dataset.annotations import read_rows
from glintrack.dataset.build import read_plan
from glintrack.dataset.plan import DatasetPlan
from glintrack.io.raw_mosaics import read_raw
from glintrack.metrics import VISIBLE_FRACTION
from glintrack.scene import VEHICLE_CLASSES

_MICROSECONDS = 1_000_000


@dataclass(frozen=True)
class VideoFrame:
    """One frame: counts (1, row, column), its time in s and in µs, and its index from 0."""

    pixels: UInt[Array, "1 row column"]
    time_s: float
    pts: int
    frame_index: int


@dataclass(frozen=True)
class FrameTracks:
    """Boxes (x0, y0, x1, y1 [pixel]) of one frame, with the label, score and track id of each."""

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
    """Raws of one case of a set, read on iteration."""

    folder: Path
    plan: DatasetPlan
    name: str

    def __iter__(self) -> Iterator[VideoFrame]:
        """Read frame by frame."""
        flight = self.plan.cases[self.name].flight
        for shard in self.plan.shards(self.name):
            for k in shard.frames:
                counts = read_raw(self.folder / shard.raw(k))[None]
                time_s = flight.start_s + k / flight.rate_hz
                yield VideoFrame(counts, time_s, round(time_s * _MICROSECONDS), k)


class TrackingSet:
    """A split of a set, one video per case, its boxes as truth: MAITE's ``Dataset``.

    Parameters
    ----------
    folder
        Folder of `build_dataset`.
    split
        ``train``, ``val`` or ``test``.
    min_visible_fraction
        Smallest visible fraction of a vehicle in the truth. [1]
    allow_outside_paths
        See `build.read_plan`.

    Raises
    ------
    ValueError
        If the folder holds no whole set, or the split no case.
    """

    def __init__(
        self,
        folder: str | Path,
        split: str = "test",
        min_visible_fraction: float = VISIBLE_FRACTION,
        allow_outside_paths: bool = False,
    ):
        self.folder, self.plan = Path(folder), read_plan(folder, allow_outside_paths)
        self.names, self.min_visible_fraction = self.plan.names(split), min_visible_fraction
        self.metadata = {"id": self.plan.key, "index2label": dict(enumerate(VEHICLE_CLASSES))}

    def __len__(self) -> int:
        """Return the number of videos."""
        return len(self.names)

    def __getitem__(self, ind: int, /) -> tuple[RawVideo, VideoTracks, dict]:
        """Return the raws, the vehicles and the metadata of one case."""
        name = self.names[ind]
        case = self.plan.cases[name]
        boxes = read_rows(self.folder, self.plan, name, "boxes.csv").query(
            f"visible_fraction >= {self.min_visible_fraction!r}"
        )
        frames = [_frame_tracks(boxes.query(f"frame == {k}")) for k in range(case.flight.frames)]
        metadata = {
            "id": name,
            "height": case.sensor.rows,
            "width": case.sensor.columns,
            "time_base": Fraction(1, _MICROSECONDS),
        }
        return RawVideo(self.folder, self.plan, name), VideoTracks(frames), metadata


def _frame_tracks(boxes: pd.DataFrame) -> FrameTracks:
    corners = boxes[["x0_px", "y0_px", "x1_px", "y1_px"]].to_numpy(float) + 0.5
    labels = np.array([VEHICLE_CLASSES.index(str(one)) for one in boxes["class"]], np.int64)
    return FrameTracks(corners, labels, np.ones(len(boxes)), boxes["vehicle_id"].to_numpy(np.int64))
