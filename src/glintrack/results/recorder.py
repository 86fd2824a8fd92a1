"""Record a simulation: keep what is worth showing of it, and estimate when it ends."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import xarray as xr

from glintrack.case.design import Case
from glintrack.core.arrays import Array
from glintrack.core.colour import colour_channels, exposure_of, holds_colours, natural_colour
from glintrack.core.records import Rows
from glintrack.core.schema import RADIANCE
from glintrack.core.spectral import Band, channel_weights
from glintrack.io.images import write_frame
from glintrack.ortho import rectify_array
from glintrack.render import Observer
from glintrack.results.epoch import Epoch, Imaged, box_rows, vehicle_boxes
from glintrack.results.figures.frame import Bearings, azimuth_of, in_view
from glintrack.results.film import Film
from glintrack.scene import City
from glintrack.stokes import dolp
from glintrack.track import Detections, Frame, Grid
from glintrack.track.detect.frame import grid_of

# scores, pictures and files after the last frame take as long as so many frames, and so many for each frame
_END_FRAMES, _END_SHARE = 2.5, 0.05


@dataclass(frozen=True)
class Colour:
    """One frame as an eye and a perfect polarimeter would see it, before the sensor.

    Parameters
    ----------
    view, ground
        Natural colour in the aircraft's view and on the ground grid, sRGB; None where the flight's spectra
        lie beyond what eyes see. [1]
    view_dolp
        Degree of linear polarization in the aircraft's view, pan band. [1]
    view_bearings
        How that view lies.
    """

    view: Array | None
    ground: Array | None
    view_dolp: Array
    view_bearings: Bearings | None = None


@dataclass
class Recorder:
    """Writes evenly spread rectified frames of each channel; keeps a film, served queries, natural colour.

    What it keeps does not grow with the number of frames but for served queries (some 200 bytes each),
    detections (100 bytes each) and boxes.

    Parameters
    ----------
    case
        The design being flown.
    folder
        Of the result, into whose ``frames`` evenly spread rectified frames are written as they come; or none.
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
    _boxes: Rows = field(default_factory=Rows)
    _exposure: float | None = None

    def __post_init__(self) -> None:
        """Choose the film's frames."""
        self.film = Film.of(self.case.flight.frames, self.case.output.film_frames)

    def picture(self, channel: str, index: int, image: xr.Dataset, city: City) -> None:
        """Called by `simulate` with each rectified frame, before it is tracked: write those that are kept."""
        frames, keep = self.case.flight.frames, self.case.output.keep_frames
        if self.folder is not None and index in np.linspace(0, frames - 1, min(keep, frames)).round().astype(
            int
        ):
            frames_folder = self.folder / "frames"
            frames_folder.mkdir(exist_ok=True)
            path = frames_folder / f"{channel}_{image.attrs['time_s']:07.2f}s.tif"
            write_frame(path, image, city.crs, (city.origin_easting_m, city.origin_northing_m))

    def record(self, epoch: Epoch) -> None:
        """Called by `simulate` after every turn of a loop."""
        self.observer = epoch.observer
        if epoch.index <= self.shown_index:  # the middle frame, or the last one of an interrupted flight
            self.shown[epoch.channel] = epoch.image
        if epoch.index == self.shown_index and self.colour is None:
            self.colour = self._natural_colour(epoch)
        self._queries[epoch.channel] = self._queries.get(epoch.channel, Rows()).append(_served(epoch))
        if self.grid is None:
            self.grid = grid_of(Frame(epoch.time_s, epoch.image), None)
        found = replace(epoch.detections, box=None, earlier_s=(), earlier=None, detail=None)
        self.found.setdefault(epoch.channel, []).append((epoch.time_s, found))
        if epoch.channel == self.case.channels[0]:
            self._note_paints(epoch)
            if self.case.output.boxes:
                seen = epoch.true_frame
                now = epoch.city.at(epoch.time_s)
                frame = Imaged(epoch.observer, now, seen.truth, seen.true_pose, seen.reported_pose)
                rows = box_rows(vehicle_boxes(frame), epoch.index, epoch.time_s)
                self._boxes = self._boxes.append(rows)
            if epoch.index in self.film.frames:
                self.film.add(epoch.index, epoch.time_s, epoch.image, self._ground_colour(epoch))

    @property
    def shown_index(self) -> int:
        """Frame that the pictures show: three quarters through, when tracks are established."""
        return (3 * (self.case.flight.frames - 1)) // 4

    @property
    def origin_m(self) -> tuple[float, float]:
        """Where the ENU origin lies in the scene's CRS. [m]"""
        if self.observer is None:
            return 0.0, 0.0
        return self.observer.city.origin_easting_m, self.observer.city.origin_northing_m

    def queries(self, channel: str) -> xr.Dataset:
        """Served queries and their spectra, one ``row`` each; see `_served`."""
        return self._queries.get(channel, Rows()).to_dataset()

    def detections(self, channel: str) -> xr.Dataset:
        """What change detection found, one ``row`` each, in order of time."""
        return _rows(self.found.get(channel, []))

    def boxes(self) -> xr.Dataset:
        """Where every frame imaged each vehicle, one ``row`` each, if the case asks for it."""
        return self._boxes.to_dataset()

    def vehicles(self) -> xr.Dataset:
        """Every vehicle of the truth with the material of its paint."""
        ids = sorted(self.paints)
        return xr.Dataset(
            {"paint": ("vehicle", np.array([self.paints[i] for i in ids], dtype=object))},
            coords={"vehicle": np.array(ids, dtype=np.int64)},
        )

    def _note_paints(self, epoch: Epoch) -> None:
        """Names of the paints of vehicles not met before."""
        if set(epoch.score.vehicle_ids.tolist()) <= self.paints.keys():
            return
        now, names = epoch.city.at(epoch.time_s), epoch.city.materials["material"].values
        for vehicle, paint in zip(now.vehicle_id.tolist(), now.paint.tolist(), strict=True):
            if vehicle >= 0:
                self.paints[vehicle] = str(names[paint])
        for vehicle in epoch.score.vehicle_ids.tolist():
            self.paints.setdefault(vehicle, "")

    def _ground_colour(self, epoch: Epoch) -> Array | None:
        """Natural colour on the ground grid, exposed as the film's first frame; None in the infrared."""
        if not holds_colours(epoch.sky.wavelength_um):
            return None
        xyz, white = _xyz(epoch)
        xyz = _mean_of_four(xyz)  # four rays a cell of the map, which is as wide as two elements
        gsd_m, city = self.case.ortho.gsd_m, epoch.city
        ground = rectify_array(xyz, epoch.camera, epoch.reported_pose, city.terrain, gsd_m, city.extent_m)
        if self._exposure is None:
            self._exposure = exposure_of(ground, white)
        colour = natural_colour(ground, white, self._exposure)
        return np.where(np.isfinite(ground).all(axis=-1, keepdims=True), colour, np.nan)

    def _natural_colour(self, epoch: Epoch) -> Colour:
        sky, city = epoch.sky, epoch.city
        band = Band("pan", *self.case.sensor.band_um).response(sky.wavelength_um)
        pan = channel_weights(sky.wavelength_um, band[None] * sky.wavelength_um)
        polarized = dolp(epoch.true_frame.light(pan).values[:, :, 0])
        bearings = in_view(epoch.camera, epoch.reported_pose, azimuth_of(sky.sun_direction))
        if not holds_colours(sky.wavelength_um):
            return Colour(None, None, polarized, bearings)
        xyz, white = _xyz(epoch)
        gsd_m = 0.5 * self.case.ortho.gsd_m  # elements are half a superpixel
        ground = rectify_array(xyz, epoch.camera, epoch.reported_pose, city.terrain, gsd_m, city.extent_m)
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

    def ended(self, frame: int, at_s: float) -> None:
        """A frame has ended, at a time by any clock that leaves out compiling. [s]"""
        self._ended.append((frame, at_s))

    def left_s(self) -> float | None:
        """Time until everything is written; None before two frames have ended. [s]

        The first frame counts for nothing: what it took holds what is done once.
        """
        if len(self._ended) < 2:
            return None
        (first, begun_s), (last, now_s) = self._ended[0], self._ended[-1]
        frame_s = (now_s - begun_s) / (last - first)
        return frame_s * (self.frames - 1 - last + _END_FRAMES + _END_SHARE * self.frames)


def _xyz(epoch: Epoch) -> tuple[Array, Array]:
    """XYZ radiance of a frame before the sensor, and that of a white panel on the ground."""
    channels = colour_channels(epoch.sky.wavelength_um)
    xyz = np.ascontiguousarray(epoch.true_frame.light(channels).values[..., 0])
    return xyz, epoch.observer.white(channels)


def _mean_of_four(picture: Array) -> Array:
    """Every element's mean with those above, to the left and between."""
    for axis in (0, 1):
        before = np.concatenate([np.split(picture, [1], axis)[0], np.split(picture, [-1], axis)[0]], axis)
        picture = 0.5 * (picture + before)
    return picture


def _served(epoch: Epoch) -> xr.Dataset:
    """Served queries of one epoch: where, for which track, on which vehicle (−1: none), and the spectrum."""
    served = epoch.spectra["served"].values.astype(bool)
    names = ("track_id", "east", "north", "radiance")
    track, east, north, radiance = (epoch.spectra[name].values[served] for name in names)
    vehicle_of = dict(zip(epoch.score.track_ids.tolist(), epoch.score.matched_vehicle.tolist(), strict=True))
    on = np.array([vehicle_of.get(int(i), -1) for i in track], dtype=np.int64)
    return xr.Dataset(
        {
            "time_s": ("row", np.full(len(track), epoch.time_s), {"units": "s"}),
            "track_id": ("row", track.astype(np.int64), {"units": "1"}),
            "vehicle_id": ("row", on, {"units": "1"}),
            "east": ("row", east, {"units": "m"}),
            "north": ("row", north, {"units": "m"}),
            "radiance": (("row", "wavelength"), radiance.astype(np.float32), {"units": RADIANCE}),
        },
        coords={"wavelength": epoch.spectra["wavelength"].variable},
    )


def _rows(found: list[tuple[float, Detections]]) -> xr.Dataset:
    """Detections of all epochs, without what their detector alone needs of them: whole frames, perhaps."""
    if not found:
        return xr.Dataset()
    time_s = np.concatenate([np.full(len(one), at) for at, one in found])
    all_of = {
        name: np.concatenate([getattr(one, name) for _, one in found])
        for name in ("position", "covariance", "extent", "contrast")
    }
    position, covariance = all_of["position"], all_of["covariance"]
    columns = {
        "time_s": (time_s, "s"),
        "east": (position[:, 0], "m"),
        "north": (position[:, 1], "m"),
        "east_var": (covariance[:, 0, 0], "m2"),
        "north_var": (covariance[:, 1, 1], "m2"),
        "east_north_cov": (covariance[:, 0, 1], "m2"),
        "extent": (all_of["extent"], "m"),
        "contrast": (all_of["contrast"], "1"),
    }
    told = [one.log_likelihood_ratio for _, one in found if one.log_likelihood_ratio is not None]
    if len(told) == len(found):
        columns["log_likelihood_ratio"] = (np.concatenate(told), "1")
    return xr.Dataset({name: ("row", values, {"units": unit}) for name, (values, unit) in columns.items()})
