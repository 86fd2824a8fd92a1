"""One turn of a loop, as `simulate` shows it to whoever watches."""

from dataclasses import dataclass

import xarray as xr

from glintrack import metrics, track
from glintrack.camera import Camera, Pose
from glintrack.records import ServedQueries
from glintrack.render import Hits, Sky
from glintrack.scene import City


@dataclass(frozen=True)
class Epoch:
    """One turn of one channel's loop, for whoever watches."""

    index: int
    time_s: float
    channel: str
    city: City
    sky: Sky
    camera: Camera
    hits: Hits
    reported_pose: Pose
    image: xr.Dataset
    served: ServedQueries
    tracks: xr.Dataset
    score: metrics.EpochScore
    spectra: xr.Dataset
    detections: track.Detections
