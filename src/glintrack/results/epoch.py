"""One turn of a loop, as `simulate` hands it to its callback."""

from dataclasses import dataclass

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack import metrics, track
from glintrack.camera import Camera, Pose
from glintrack.core.arrays import Array
from glintrack.core.records import Radiance, ServedQueries
from glintrack.render import Hits, Observer, Sky
from glintrack.scene import City
from glintrack.sensor import Sensor, light_on_elements, smear


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
    hits, light
        What the rays met, and the light of it.
    planes
        That light behind the lens on every element, over the exposure: `sensor.light_on_elements`.
    truth
        With ``visible_fraction``.
    """

    sensor: Sensor
    true_pose: Pose
    reported_pose: Pose
    motion: Array
    hits: Hits
    light: Radiance
    planes: Float[Array, "plane row column"]
    truth: xr.Dataset

    def planes_with(self, observer: Observer, anew: Hits) -> Float[Array, "plane row column"]:
        """The same where some elements saw something else: they were traced ``anew``, they alone."""
        elements = np.flatnonzero(anew.rays)
        row, column = np.divmod(elements, anew.columns)
        shown = observer.radiance_anew(anew, self.hits)

        def changed(channels: Array, pixels: Array | None = None) -> xr.DataArray:
            if pixels is not None:
                return shown(channels, pixels)
            frame = self.light(channels).copy(deep=True)
            if len(elements):
                frame.values[row, column] = shown(channels, np.stack([row, column], axis=1)).values
            return frame

        light = smear(changed, self.motion)(self.sensor.channels)
        return light_on_elements(light.values, self.sensor)


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
