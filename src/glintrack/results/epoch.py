"""One turn of a loop, as `simulate` hands it to its callback, and where its frame images each vehicle.

Boxes lean as the picture has it, in the raw frame and rectified; parked vehicles have them too.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack import metrics, track
from glintrack.camera import Camera, Pose
from glintrack.core.arrays import Array
from glintrack.core.records import Radiance, ServedQueries
from glintrack.ortho import seen_ground
from glintrack.render import Hits, Observer, Outlines, Sky, outlines, vehicle_mask, visible_fraction
from glintrack.scene import VEHICLE_CLASSES, City, Snapshot
from glintrack.sensor import Sensor, light_on_elements, smear

BOX_COLUMNS = {
    "frame": "frame",
    "time_s": "time_s",
    "vehicle_id": "vehicle_id",
    "class": "class",
    "moving": "moving",
    "parked": "parked",
    **{f"{name}_px": name for name in ("x0", "y0", "x1", "y1")},
    **{f"{name}_m": name for name in ("west", "south", "east", "north")},
    "visible_fraction": "visible_fraction",
}  # of boxes.csv: column -> variable


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
        shown = observer.partial_radiance(anew, self.hits)

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


@dataclass(frozen=True)
class Imaged:
    """Which frame is labelled: the city then, and from where it was seen.

    Parameters
    ----------
    observer, snapshot, truth
        The city, its state at the frame's time, and the truth with ``visible_fraction``.
    true_pose, reported_pose
        Where the camera was, and where the navigator says it was: raw frames follow the one, rectified ones
        both.
    """

    observer: Observer
    snapshot: Snapshot
    truth: xr.Dataset
    true_pose: Pose
    reported_pose: Pose

    @cached_property
    def outlines(self) -> Outlines:
        """Of every vehicle that the frame holds a part of."""
        return outlines(self.snapshot, self.observer.camera, self.true_pose)


def vehicle_boxes(frame: Imaged) -> xr.Dataset:
    """The box of each vehicle that the frame holds a part of, hidden or not, in order of their ids.

    Returns
    -------
    Dim ``vehicle`` with the ids (parked ones from a million on) and ``class``, ``moving`` (from 1 m/s),
    ``parked``, ``visible_fraction`` [1]; ``x0``, ``y0``, ``x1``, ``y1`` in the raw frame, cut at its edge,
    element centres at integers [pixel]; ``west``, ``south``, ``east``, ``north`` of where rectification puts
    it: each vertex where its image lies on the terrain as seen from the reported pose [m].
    """
    observer, snapshot, seen = frame.observer, frame.snapshot, frame.outlines
    moving, visible = _by_id(frame.truth, metrics.is_moving(frame.truth)), _by_id(frame.truth)
    parked = seen.instance < snapshot.fixed
    still = visible_fraction(
        snapshot, observer.camera, frame.true_pose, observer.tracer, observer.vehicle_tracer,
        seen.instance[parked],
    )  # fmt: skip
    visibility = np.array([visible.get(int(i), 0.0) for i in seen.vehicle_id], float)
    visibility[parked] = still
    ground = _on_ground(seen, observer.camera, frame.reported_pose, observer.city.terrain)
    model = np.asarray(snapshot.model)[seen.instance]
    columns = {
        "class": (np.array([VEHICLE_CLASSES[k] for k in model], dtype=object), "1"),
        "moving": (np.array([int(moving.get(int(i), 0)) for i in seen.vehicle_id], np.int64), "1"),
        "parked": (parked.astype(np.int64), "1"),
        "visible_fraction": (visibility, "1"),
        **{name: (seen.box[:, k], "pixel") for k, name in enumerate(("x0", "y0", "x1", "y1"))},
        **{name: (ground[:, k], "m") for k, name in enumerate(("west", "south", "east", "north"))},
    }
    boxes = xr.Dataset(
        {name: ("vehicle", values, {"units": units}) for name, (values, units) in columns.items()},
        coords={"vehicle": seen.vehicle_id},
    )
    return boxes.sortby("vehicle")


def label_mask(frame: Imaged) -> xr.DataArray:
    """Id of the vehicle that each element's middle shows, −1 for none; dims y, x."""
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


def _by_id(truth: xr.Dataset, values: Array | None = None) -> dict[int, float]:
    """A figure of each vehicle of the truth, its visible fraction by default."""
    values = truth["visible_fraction"].values if values is None else np.asarray(values)
    return dict(zip(truth["vehicle"].values.tolist(), values.tolist(), strict=True))


def _on_ground(seen: Outlines, camera: Camera, reported: Pose, terrain: xr.Dataset) -> Array:
    """West, south, east, north of the vertices where their images lie on the terrain. [m]"""
    if not len(seen.instance):
        return np.empty((0, 4))
    place = seen_ground(terrain, camera, reported, seen.pixel)[:, :2]
    low, high = (how.reduceat(place, seen.first[:-1]) for how in (np.minimum, np.maximum))
    return np.concatenate([low, high], axis=1)
