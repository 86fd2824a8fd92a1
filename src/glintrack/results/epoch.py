"""One turn of a loop, as `simulate` hands it to its callback."""

from dataclasses import dataclass

import xarray as xr

from glintrack import metrics, track
from glintrack.arrays import Array
from glintrack.camera import Camera, Pose
from glintrack.records import Radiance, ServedQueries
from glintrack.render import Hits, Observer, Sky
from glintrack.scene import City
from glintrack.sensor import Sensor, smear


@dataclass(frozen=True)
class TrueFrame:
    """What went before all loops: the light, the sensor, the poses, and the truth.

    Parameters
    ----------
    sensor
        From `build_sensor`.
    true_pose, reported_pose
        Where the camera was, and where the navigator says it was.
    motion
        From `sensor.image_motion`. [element]
    hits, radiance
        What the rays met, and the light of it as the elements integrate it.
    truth
        With ``visible_fraction``.
    """

    sensor: Sensor
    true_pose: Pose
    reported_pose: Pose
    motion: Array
    hits: Hits
    radiance: Radiance
    truth: xr.Dataset

    def light(self, observer: Observer, hits: Hits) -> Radiance:
        """The light of any hits from the same pose, as the elements integrate it."""
        return self.radiance if hits is self.hits else smear(observer.radiance(hits), self.motion)


@dataclass(frozen=True)
class Epoch:
    """One turn of one channel's loop."""

    index: int
    time_s: float
    channel: str
    observer: Observer
    true_frame: TrueFrame
    image: xr.Dataset
    served: ServedQueries
    tracks: xr.Dataset
    score: metrics.EpochScore
    spectra: xr.Dataset
    detections: track.Detections

    @property
    def hits(self) -> Hits:
        """What the frame's rays met."""
        return self.true_frame.hits

    @property
    def reported_pose(self) -> Pose:
        """Where the navigator says the camera was."""
        return self.true_frame.reported_pose

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
