"""Watch a flight and keep what is worth showing of it."""

from dataclasses import dataclass, field

import numpy as np
import xarray as xr

from .. import viz
from ..config import Case
from ..ortho import rectify_array
from ..render import shade
from ..simulate import Epoch
from ..spectral import Band, channel_weights
from ..stokes import dolp

Array = np.ndarray


@dataclass(frozen=True)
class Colour:
    """One frame as an eye and a perfect polarimeter would see it, before the sensor.

    Parameters
    ----------
    view, ground
        Natural colour in the aircraft's view and on the ground grid, sRGB. [1]
    view_dolp
        Degree of linear polarization in the aircraft's view, pan band. [1]
    """

    view: Array
    ground: Array
    view_dolp: Array


@dataclass
class Recorder:
    """Keeps evenly spread rectified frames of each modality, and natural colour for the middle one.

    Parameters
    ----------
    case
        The design being flown.
    """

    case: Case
    images: dict[str, dict[float, xr.Dataset]] = field(default_factory=dict)
    shown: dict[str, xr.Dataset] = field(default_factory=dict)
    colour: Colour | None = None
    last: Epoch | None = None

    def watch(self, epoch: Epoch) -> None:
        """Called by `simulate` after every turn of a loop."""
        self.last = epoch
        frames, keep = self.case.flight.frames, self.case.output.keep_frames
        kept = np.linspace(0, frames - 1, min(keep, frames)).round().astype(int)
        if epoch.index in kept:
            self.images.setdefault(epoch.modality, {})[epoch.time_s] = epoch.image
        if epoch.index <= self.shown_index:  # the middle frame, or the last one of an interrupted flight
            self.shown[epoch.modality] = epoch.image
        if epoch.index == self.shown_index and self.colour is None:
            self.colour = self._natural_colour(epoch)

    @property
    def shown_index(self) -> int:
        """Frame that the pictures show: three quarters through, when tracks are established."""
        return (3 * (self.case.flight.frames - 1)) // 4

    @property
    def origin_m(self) -> tuple[float, float]:
        """Where the ENU origin lies in the scene's CRS. [m]"""
        if self.last is None:
            return 0.0, 0.0
        return self.last.city.origin_easting_m, self.last.city.origin_northing_m

    def _natural_colour(self, epoch: Epoch) -> Colour:
        sky, city = epoch.sky, epoch.city
        weights = viz.colour_channels(sky.wavelength_um)
        xyz = shade(epoch.hits, sky, city.materials, weights).values[..., 0].astype(np.float32)
        white = weights @ (sky.sun_irradiance * sky.sun_direction[2] + sky.sky_irradiance) / np.pi
        gsd_m = 0.5 * self.case.ortho.gsd_m  # elements are half a superpixel
        ground = rectify_array(xyz, epoch.camera, epoch.reported_pose, city.terrain, gsd_m, city.extent_m)
        band = Band("pan", *self.case.sensor.band_um).response(sky.wavelength_um)
        pan = channel_weights(sky.wavelength_um, band[None] * sky.wavelength_um)
        polarized = dolp(shade(epoch.hits, sky, city.materials, pan).values[:, :, 0])
        return Colour(viz.natural_colour(xyz, white), viz.natural_colour(ground, white), polarized)
