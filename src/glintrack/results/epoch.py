"""Data of one frame and channel for the callback of `simulate`, and boxes of the vehicles in the frame.

Boxes are those of the raw and of the rectified frame, with parked vehicles.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Float

from glintrack import metrics, track
from glintrack.camera import Pose
from glintrack.core.arrays import Array
from glintrack.core.records import Radiance, ServedQueries
from glintrack.ortho import intersect_terrain
from glintrack.render import Hits, Observer, Outlines, outlines, vehicle_mask, visible_fraction
from glintrack.scene import VEHICLE_CLASSES, City, Snapshot
from glintrack.sensor import Sensor, light_on_elements, smear

_PIXELS, _METRES = ("x0_px", "y0_px", "x1_px", "y1_px"), ("west_m", "south_m", "east_m", "north_m")
# columns of boxes.csv
BOX_COLUMNS = (
    "frame", "time_s", "vehicle_id", "class", "moving", "parked", *_PIXELS, *_METRES, "visible_fraction",
)  # fmt: skip


@dataclass(frozen=True)
class TrueFrame:
    """Data of a frame before all channels: light, sensor, poses and truth.

    Parameters
    ----------
    sensor
        From `build_sensor`.
    true_pose, reported_pose
        True pose of the camera, and the navigator's.
    motion
        From `sensor.image_motion`. [element]
    hits, light
        Hits of the rays, and their radiance.
    planes
        That light behind the lens on every element, over the exposure: `sensor.light_on_elements`.
    truth
        Schema ``truth`` with ``visible_fraction``; ``inside`` is 1 in the scored area.
    area
        The scored area. [m]
    """

    sensor: Sensor
    true_pose: Pose
    reported_pose: Pose
    motion: Array
    hits: Hits
    light: Radiance
    planes: Float[Array, "plane row column"]
    truth: xr.Dataset
    area: metrics.Area

    def planes_with(self, observer: Observer, again: Hits) -> Float[Array, "plane row column"]:
        """Planes with the elements that were traced ``again``."""
        elements = np.flatnonzero(again.rays)
        row, column = np.divmod(elements, again.columns)
        shown = observer.partial_radiance(again, self.hits)

        def with_new(channels: Array, pixels: Array | None = None) -> xr.DataArray:
            if pixels is not None:
                return shown(channels, pixels)
            frame = self.light(channels).copy(deep=True)
            if len(elements):
                frame.values[row, column] = shown(channels, np.stack([row, column], axis=1)).values
            return frame

        light = smear(with_new, self.motion)(self.sensor.channels)
        return light_on_elements(light.values, self.sensor)


@dataclass(frozen=True)
class Epoch:
    """Data of one channel after one frame."""

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
    def city(self) -> City:
        """City of the scene."""
        return self.observer.city


@dataclass(frozen=True)
class SceneView:
    """City and camera of a frame with vehicle labels.

    Parameters
    ----------
    observer, snapshot, truth
        City, its state at the frame's time, and the truth with ``visible_fraction``.
    true_pose, reported_pose
        True and reported pose of the camera: raw frames follow the true one, rectified ones both.
    """

    observer: Observer
    snapshot: Snapshot
    truth: xr.Dataset
    true_pose: Pose
    reported_pose: Pose

    @cached_property
    def outlines(self) -> Outlines:
        """Outlines of the vehicles in the frame."""
        return outlines(self.snapshot, self.observer.camera, self.true_pose)


def vehicle_boxes(frame: SceneView) -> xr.Dataset:
    """Box of each vehicle in the frame, occluded or not, in order of their ids.

    Returns
    -------
    Dim ``vehicle`` with the ids (parked ones from a million on) and ``class``, ``moving`` (from 1 m/s),
    ``parked``, ``visible_fraction`` [1]; ``x0_px``, ``y0_px``, ``x1_px``, ``y1_px`` in the raw frame, cut at
    its edge, element centres at integers; ``west_m``, ``south_m``, ``east_m``, ``north_m`` in the rectified
    frame: each vertex is on the terrain where it is seen from the reported pose.
    """
    observer, snapshot, seen = frame.observer, frame.snapshot, frame.outlines
    parked = seen.instance < snapshot.fixed
    still = visible_fraction(
        snapshot, observer.camera, frame.true_pose, observer.tracer, observer.vehicle_tracer,
        seen.instance[parked],
    )  # fmt: skip
    of_truth = pd.DataFrame(
        {
            "moving": np.asarray(metrics.is_moving(frame.truth), float),
            "visible": frame.truth["visible_fraction"].values,
        },
        index=frame.truth["vehicle"].values,
    ).reindex(seen.vehicle_id, fill_value=0)
    visibility = of_truth["visible"].to_numpy(float, copy=True)
    visibility[parked] = still
    ground = np.empty((0, 4))
    if len(seen.instance):  # the vertices where their images lie on the terrain
        place = intersect_terrain(observer.city.terrain, observer.camera, frame.reported_pose, seen.pixel)[
            :, :2
        ]
        ends = [bound.reduceat(place, seen.first[:-1]) for bound in (np.minimum, np.maximum)]
        ground = np.concatenate(ends, axis=1)
    classes = [VEHICLE_CLASSES[k] for k in np.asarray(snapshot.model)[seen.instance]]
    columns = {
        "class": (np.array(classes, dtype=object), "1"),
        "moving": (of_truth["moving"].to_numpy(bool), "1"),
        "parked": (parked, "1"),
        "visible_fraction": (visibility, "1"),
        **{name: (seen.box[:, k], "pixel") for k, name in enumerate(_PIXELS)},
        **{name: (ground[:, k], "m") for k, name in enumerate(_METRES)},
    }
    boxes = xr.Dataset(
        {name: ("vehicle", values, {"units": units}) for name, (values, units) in columns.items()},
        coords={"vehicle": seen.vehicle_id},
    )
    return boxes.sortby("vehicle")


def label_mask(frame: SceneView) -> xr.DataArray:
    """Id of the vehicle at each element's middle, −1 for none; dims y, x."""
    observer, snapshot = frame.observer, frame.snapshot
    values = vehicle_mask(snapshot, observer.camera, frame.true_pose, observer.tracer, frame.outlines)
    return xr.DataArray(values, dims=("y", "x"), name="mask", attrs={"units": "1"})


def box_rows(boxes: xr.Dataset, frame: int, time_s: float) -> xr.Dataset:
    """Boxes of a frame as rows of `boxes.csv`."""
    rows = boxes.rename_dims(vehicle="row").reset_index("vehicle").rename_vars(vehicle="vehicle_id")
    count = rows.sizes["row"]
    return rows.assign(
        frame=("row", np.full(count, frame)), time_s=("row", np.full(count, time_s), {"units": "s"})
    )
