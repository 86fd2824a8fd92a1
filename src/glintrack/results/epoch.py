"""One turn of a loop, as `simulate` hands it to its callback."""

from dataclasses import dataclass

import xarray as xr

from glintrack import metrics, track
from glintrack.camera import Camera, Pose
from glintrack.records import ServedQueries
from glintrack.render import Hits, Observer, Sky
from glintrack.scene import City


@dataclass(frozen=True)
class Epoch:
    """One turn of one channel's loop."""

    index: int
    time_s: float
    channel: str
    observer: Observer
    hits: Hits
    reported_pose: Pose
    image: xr.Dataset
    served: ServedQueries
    tracks: xr.Dataset
    score: metrics.EpochScore
    spectra: xr.Dataset
    detections: track.Detections

    @property
    def city(self) -> City:
        """What is looked at."""
        return self.observer.city

    @property
    def sky(self) -> Sky:
        """By which light."""
        return self.observer.sky

    @property
    def camera(self) -> Camera:
        """The frame camera."""
        return self.observer.camera
