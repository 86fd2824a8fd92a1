"""Record pictures, film, served queries and detections of a simulation, and estimate when it ends."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import xarray as xr

from glintrack.camera import Pose
from glintrack.case.design import Case
from glintrack.core.arrays import Array
from glintrack.core.colour import colour_channels, exposure_of, holds_colours, natural_colour
from glintrack.core.records import Radiance, Rows
from glintrack.core.schema import RADIANCE
from glintrack.core.spectral import band_response, channel_weights
from glintrack.io.images import write_frame
from glintrack.metrics import Area
from glintrack.ortho import rectify_array
from glintrack.render import Observer
from glintrack.results.epoch import Epoch, SceneView, box_rows, vehicle_boxes
from glintrack.results.figures.frame import Bearings, azimuth_of, in_view
from glintrack.results.film import Film
from glintrack.scene import City
from glintrack.stokes import dolp
from glintrack.track import Detections, Frame, Grid
from glintrack.track.detect.frame import grid_of

# time of scores, pictures and files after the last frame, in frames, and in frames for each frame
_END_FRAMES, _END_SHARE = 2.5, 0.05


@dataclass(frozen=True)
class Colour:
    """Natural colour and polarization of one frame before the sensor.

    Parameters
    ----------
    view, ground
        Natural colour in the aircraft's view and on the ground grid, sRGB; None in the infrared. [1]
    view_dolp
        Degree of linear polarization in the aircraft's view, pan band. [1]
    view_bearings
        Directions of north and of the sun in that view.
    """

    view: Array | None
    ground: Array | None
    view_dolp: Array
    view_bearings: Bearings | None = None


@dataclass
class Recorder:
    """Record a film, served queries, detections and natural colour; write rectified frames of each channel.

    Parameters
    ----------
    case
        The simulated case.
    folder
        Folder of the result, for evenly spread rectified frames in ``frames``; or None.
    """

    case: Case
    folder: Path | None = None
    shown: dict[str, xr.Dataset] = field(default_factory=dict)
    colour: Colour | None = None
    observer: Observer | None = None
    film: Film = field(init=False)
    paints: dict[int, str] = field(default_factory=dict)
    _queries: dict[str, Rows] = field(default_factory=dict)
    found: dict[str, list[tuple[float, Detections]]] = field(default_factory=dict)
    grid: Grid | None = None
    areas: dict[float, Area] = field(default_factory=dict)
    _boxes: Rows = field(default_factory=Rows)
    _exposure: float | None = None
    _written: list[tuple[int, Path]] = field(default_factory=list)
    _recent: dict[tuple[str, int], xr.Dataset] = field(default_factory=dict)
    _poses: dict[int, tuple[Pose, Pose]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Choose the film's frames."""
        self.film = Film.of(self.case.flight.frames, self.case.output.film_frames)

    def picture(self, channel: str, index: int, image: xr.Dataset, city: City) -> None:
        """Write a rectified frame, if it is one of those; `simulate` calls this before it is tracked."""
        frames, count = self.case.flight.frames, self.case.output.keep_frames
        chosen = np.linspace(0, frames - 1, min(count, frames)).round().astype(int)
        if self.folder is not None and index in chosen:
            frames_folder = self.folder / "frames"
            frames_folder.mkdir(exist_ok=True)
            decimals = 2 if self.case.flight.rate_hz <= 100 else 4
            path = frames_folder / f"{channel}_{image.attrs['time_s']:07.{decimals}f}s.tif"
            write_frame(path, image, city.crs, (city.origin_easting_m, city.origin_northing_m))
            self._written.append((index, path))

    def record(self, epoch: Epoch) -> None:
        """Record one frame of one channel; the callback of `simulate`."""
        self.observer = epoch.observer
        self.areas[epoch.time_s] = epoch.true_frame.area
        seen = epoch.true_frame
        if epoch.index == 3 * (self.case.flight.frames - 1) // 4:  # when tracks are established
            self.shown[epoch.channel] = epoch.image
            if self.colour is None:
                self.colour = self._natural_colour(seen.light, seen.reported_pose)
        self._recent[epoch.channel, epoch.index] = epoch.image  # of two frames, the last may be half done
        self._recent.pop((epoch.channel, epoch.index - 2), None)
        self._poses[epoch.index] = seen.true_pose, seen.reported_pose
        self._queries[epoch.channel] = self._queries.get(epoch.channel, Rows()).append(_query_rows(epoch))
        if self.grid is None:
            self.grid = grid_of(Frame(epoch.time_s, epoch.image), None)
        found = replace(epoch.detections, earlier_s=(), earlier=None, detail=None)
        self.found.setdefault(epoch.channel, []).append((epoch.time_s, found))
        if epoch.channel == self.case.channels[0]:
            self._note_paints(epoch)
            if self.case.output.boxes:
                now = epoch.city.at(epoch.time_s)
                frame = SceneView(epoch.observer, now, seen.truth, seen.true_pose, seen.reported_pose)
                rows = box_rows(vehicle_boxes(frame), epoch.index, epoch.time_s)
                self._boxes = self._boxes.append(rows)
            if epoch.index in self.film.frames:
                rgb = self._ground_colour(seen.light, seen.reported_pose)
                self.film.add(epoch.index, epoch.time_s, epoch.image, rgb)

    def end_at(self, frames: int) -> None:
        """Keep complete frames only, and end pictures and film with the last one, traced again."""
        self.found = {channel: rows[:frames] for channel, rows in self.found.items()}
        self._queries = {channel: Rows(rows.parts[:frames]) for channel, rows in self._queries.items()}
        self._boxes = Rows(self._boxes.parts[:frames])
        for path in [path for index, path in self._written if index >= frames]:
            path.unlink(missing_ok=True)
        last, observer = frames - 1, self.observer
        if observer is None or last not in self._poses:
            return
        self.shown = {channel: image for (channel, k), image in self._recent.items() if k == last}
        first_image = self.shown[self.case.channels[0]]
        time_s, (true_pose, reported_pose) = float(first_image.attrs["time_s"]), self._poses[last]
        light = observer.radiance(observer.observe(observer.city.at(time_s), true_pose).hits)
        self.colour = self._natural_colour(light, reported_pose)
        self.film.remove(frames)  # half a frame
        if last not in self.film.times_s and self.film.frames:
            self.film.add(last, time_s, first_image, self._ground_colour(light, reported_pose))

    @property
    def origin_m(self) -> tuple[float, float]:
        """ENU origin in the scene's CRS. [m]"""
        if self.observer is None:
            return 0.0, 0.0
        return self.observer.city.origin_easting_m, self.observer.city.origin_northing_m

    def queries(self, channel: str) -> xr.Dataset:
        """Rows of served queries with their spectra; ``vehicle_id`` is −1 where none was hit."""
        return self._queries.get(channel, Rows()).to_dataset()

    def detections(self, channel: str) -> xr.Dataset:
        """Rows of a channel's detections in order of time."""
        found = self.found.get(channel, [])
        if not found:
            return xr.Dataset()

        def join(name: str) -> Array:
            return np.concatenate([getattr(one, name) for _, one in found])

        position, covariance = join("position"), join("covariance")
        columns = {
            "time_s": (np.concatenate([np.full(len(one), at) for at, one in found]), "s"),
            "east_m": (position[:, 0], "m"),
            "north_m": (position[:, 1], "m"),
            "east_var_m2": (covariance[:, 0, 0], "m2"),
            "north_var_m2": (covariance[:, 1, 1], "m2"),
            "east_north_cov_m2": (covariance[:, 0, 1], "m2"),
            "extent_m": (join("extent"), "m"),
            "contrast": (join("contrast"), "1"),
        }
        ratios = [
            one.log_likelihood_ratio for _, one in found if len(one) and one.log_likelihood_ratio is not None
        ]
        if sum(map(len, ratios)) == sum(len(one) for _, one in found):
            columns["log_likelihood_ratio"] = (np.concatenate([np.empty(0), *ratios]), "1")
        return xr.Dataset({k: ("row", v, {"units": unit}) for k, (v, unit) in columns.items()})

    def boxes(self) -> xr.Dataset:
        """Box of each vehicle in every frame, one ``row`` each, if the case asks for it."""
        return self._boxes.to_dataset()

    def vehicles(self) -> xr.Dataset:
        """Every vehicle of the truth with the material of its paint."""
        ids = sorted(self.paints)
        return xr.Dataset(
            {"paint": ("vehicle", np.array([self.paints[i] for i in ids], dtype=object))},
            coords={"vehicle": np.array(ids, dtype=np.int64)},
        )

    def _note_paints(self, epoch: Epoch) -> None:
        """Add the paints of new vehicles."""
        if set(epoch.score.vehicle_ids.tolist()) <= self.paints.keys():
            return
        now, names = epoch.city.at(epoch.time_s), epoch.city.materials["material"].values
        for vehicle, paint in zip(now.vehicle_id.tolist(), now.paint.tolist(), strict=True):
            if vehicle >= 0:
                self.paints[vehicle] = str(names[paint])
        for vehicle in epoch.score.vehicle_ids.tolist():
            self.paints.setdefault(vehicle, "")

    def _ground_colour(self, light: Radiance, pose: Pose) -> Array | None:
        """Natural colour on the ground grid, exposed as the film's first frame; None in the infrared."""
        assert self.observer is not None
        if not holds_colours(self.observer.sky.wavelength_um):
            return None
        xyz, white = _xyz(self.observer, light)
        for axis in (0, 1):  # mean of four elements: a cell of the map is as wide as two
            before = np.concatenate([np.split(xyz, [1], axis)[0], np.split(xyz, [-1], axis)[0]], axis)
            xyz = 0.5 * (xyz + before)
        ground = _on_ground(self.observer, pose, xyz, self.case.ortho.gsd_m)
        if self._exposure is None:
            self._exposure = exposure_of(ground, white)
        colour = natural_colour(ground, white, self._exposure)
        return np.where(np.isfinite(ground).all(axis=-1, keepdims=True), colour, np.nan)

    def _natural_colour(self, light: Radiance, pose: Pose) -> Colour:
        observer = self.observer
        assert observer is not None
        sky = observer.sky
        band = band_response(*self.case.sensor.band_um, sky.wavelength_um)
        pan = channel_weights(sky.wavelength_um, band[None] * sky.wavelength_um)
        polarized = dolp(light(pan).values[:, :, 0])
        bearings = in_view(observer.camera, pose, azimuth_of(sky.sun_direction))
        if not holds_colours(sky.wavelength_um):
            return Colour(None, None, polarized, bearings)
        xyz, white = _xyz(observer, light)
        ground = _on_ground(observer, pose, xyz, 0.5 * self.case.ortho.gsd_m)  # elements, not superpixels
        colour = natural_colour(ground, white)
        colour = np.where(np.isfinite(ground).all(axis=-1, keepdims=True), colour, np.nan)
        return Colour(natural_colour(xyz, white), colour, polarized, bearings)


@dataclass
class FlightPace:
    """Estimate how long the rest of a simulation takes, from the time of its frames so far.

    Parameters
    ----------
    frames
        Number of frames of the whole flight.
    """

    frames: int
    _ended: list[tuple[int, float]] = field(default_factory=list)

    def add(self, frame: int, at_s: float) -> None:
        """Add the end of a frame, by a clock without compiling. [s]"""
        self._ended.append((frame, at_s))

    def left_s(self) -> float | None:
        """Time until everything is written, without the first frame; None before two have ended. [s]"""
        if len(self._ended) < 2:
            return None
        (first, begun_s), (last, now_s) = self._ended[0], self._ended[-1]
        frame_s = (now_s - begun_s) / (last - first)
        return frame_s * (self.frames - 1 - last + _END_FRAMES + _END_SHARE * self.frames)


def _on_ground(observer: Observer, pose: Pose, values: Array, gsd_m: float) -> Array:
    """Values of a frame on the ground grid of the window."""
    city = observer.city
    return rectify_array(values, observer.camera, pose, city.terrain, gsd_m, city.extent_m)


def _xyz(observer: Observer, light: Radiance) -> tuple[Array, Array]:
    """XYZ radiance of a frame before the sensor, and of a white panel on the ground."""
    channels = colour_channels(observer.sky.wavelength_um)
    return np.ascontiguousarray(light(channels).values[..., 0]), observer.white(channels)


def _query_rows(epoch: Epoch) -> xr.Dataset:
    """Rows of one epoch's served queries: position, track, vehicle (−1: none), and spectrum."""
    served = epoch.spectra["served"].values
    names = ("track_id", "east_m", "north_m", "radiance")
    track, east, north, radiance = (epoch.spectra[name].values[served] for name in names)
    vehicle_of = dict(zip(epoch.score.track_ids.tolist(), epoch.score.matched_vehicle.tolist(), strict=True))
    on = np.array([vehicle_of.get(int(i), -1) for i in track], dtype=np.int64)
    return xr.Dataset(
        {
            "time_s": ("row", np.full(len(track), epoch.time_s), {"units": "s"}),
            "track_id": ("row", track.astype(np.int64), {"units": "1"}),
            "vehicle_id": ("row", on, {"units": "1"}),
            "east_m": ("row", east, {"units": "m"}),
            "north_m": ("row", north, {"units": "m"}),
            "radiance": (("row", "wavelength"), radiance.astype(np.float32), {"units": RADIANCE}),
        },
        coords={"wavelength": epoch.spectra["wavelength"].variable},
    )
