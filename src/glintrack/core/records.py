"""Small records that pass between stages; larger values are labelled arrays (`schema`)."""

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from glintrack.core.arrays import Array


class Extent(NamedTuple):
    """A rectangle on the ground, north up. [m]"""

    west_m: float
    south_m: float
    east_m: float
    north_m: float

    @classmethod
    def of_cells(cls, x: Float[Array, "x"], y: Float[Array, "y"], cell_m: float) -> "Extent":
        """Extent of a raster by the middles of its cells; y falls. [m]"""
        half = 0.5 * cell_m
        return cls(float(x[0]) - half, float(y[-1]) - half, float(x[-1]) + half, float(y[0]) + half)


class Radiance(Protocol):
    """Radiance at the lens in one frame, computed for the channels and pixels that are requested."""

    def __call__(
        self, channels: Float[Array, "channel wavelength"], pixels: Int[Array, "pixel 2"] | None = None
    ) -> xr.DataArray:
        """Stokes radiance of some spectral channels in the ``detector`` frame.

        Parameters
        ----------
        channels
            Weights on the sky's wavelengths, as `spectral.channel_weights` makes them. [1]
        pixels
            (row, column) of the requested elements; the whole frame by default.

        Returns
        -------
        Dims (y, x, channel, stokes), or (pixel, channel, stokes) if pixels were named.
        [W m⁻² sr⁻¹ µm⁻¹]
        """
        ...


@dataclass(frozen=True)
class Mosaic:
    """Electrons of all elements in one frame, before demosaicking.

    Parameters
    ----------
    electrons
        Calibrated electrons; NaN where a mirror directed light to the spectrometer. [e]
    sigma_e
        Standard deviation of shot, dark, read and quantizer noise. [e]
    layout
        Element types of a superpixel: ``"mirror"``, ``"open"``, a polarizer's angle [deg] or a filter's
        band [µm].
    gains
        Electrons of each element of a superpixel per unit of S0, S1 and S2 in its own band, the latter two in
        the ``detector`` frame. [e / (W m⁻² sr⁻¹ µm⁻¹)]
    """

    electrons: Float[Array, "row column"]
    sigma_e: Float[Array, "row column"]
    layout: tuple[tuple[str | float, ...], ...]
    gains: Float[Array, "side side 3"]


@dataclass(frozen=True)
class SpectralQuery:
    """Request for the spectrum of one ground point, in the next frame or by a second exposure.

    Parameters
    ----------
    east_m, north_m, up_m
        Ground point. [m]
    track_id
        Track the spectrum is for; −1 if for a detection not yet on a track.
    priority
        Expected gain, larger first. [nat]
    """

    east_m: float
    north_m: float
    up_m: float = 0.0
    track_id: int = -1
    priority: float = 0.0

    @property
    def position(self) -> Float[Array, "3"]:
        """Ground point (east, north, up). [m]"""
        return np.array([self.east_m, self.north_m, self.up_m], dtype=float)


@dataclass(frozen=True)
class ServedQueries:
    """Queries of one frame, and the micromirrors that serve them.

    Parameters
    ----------
    queries
        All queries, in their order.
    rows, columns
        Superpixel whose mirror serves each query; −1 where refused. [superpixel]
    refusals
        Why each query was refused, empty where it was served.
    """

    queries: tuple[SpectralQuery, ...]
    rows: Int[Array, "query"]
    columns: Int[Array, "query"]
    refusals: tuple[str, ...]

    @property
    def is_served(self) -> np.ndarray:
        """True for each query that gets a mirror."""
        return self.rows >= 0


NONE_SERVED = ServedQueries((), np.zeros(0, int), np.zeros(0, int), ())


@dataclass(frozen=True)
class GroundPlace:
    """Position of a rectified raster on the map.

    Parameters
    ----------
    crs
        Projected CRS, anything pyproj reads.
    west_m, north_m
        Outer corner of the first cell, in the CRS. [m]
    gsd_m
        Cell, square. [m]
    """

    crs: str
    west_m: float
    north_m: float
    gsd_m: float


@dataclass(frozen=True)
class RasterLayout:
    """Content of a raster file; its flat bands run over channels, then over components.

    Parameters
    ----------
    name, units
        Of the variable.
    rows, columns
        Size of the grid. [pixel]
    channel_dim, channels
        ``wavelength`` or ``band`` and a label for each channel; an empty name for a file with one only.
    component_dim, components
        ``stokes`` or ``rgb`` and the components' letters; empty for a scalar.
    block
        Rows and channels of one block.
    wavelength_um, width_um
        Centre and full width at half maximum of each channel. [µm]
    stokes_frame
        Reference axis of Q and U, or of an angle of polarization.
    place
        Of a rectified raster; None in camera geometry.
    attributes
        Further facts for the header.
    """

    name: str
    units: str
    rows: int
    columns: int
    channel_dim: str
    channels: tuple[str, ...]
    component_dim: str
    components: tuple[str, ...]
    block: tuple[int, int]
    wavelength_um: tuple[float, ...] = ()
    width_um: tuple[float, ...] = ()
    stokes_frame: str = ""
    place: GroundPlace | None = None
    attributes: tuple[tuple[str, str | float], ...] = ()

    @property
    def count(self) -> int:
        """Flat bands: channels times components."""
        return len(self.channels) * len(self.components)

    @property
    def band_names(self) -> tuple[str, ...]:
        """Label of each flat band, the component first."""
        if not self.component_dim:
            return tuple(f"{self.name} {c}".strip() for c in self.channels)
        return tuple(f"{k} {c}".strip() for k in self.components for c in self.channels)

    @property
    def dims(self) -> tuple[str, ...]:
        """Dims of a labelled file, slowest first; the map axes come last, where GDAL looks for them."""
        return tuple(d for d in (self.component_dim, self.channel_dim) if d) + ("y", "x")


@dataclass(frozen=True)
class Rows:
    """A table that grows by some rows in each epoch.

    Parameters
    ----------
    parts
        Rows of the epochs, with dim ``row`` and the same variables.
    """

    parts: tuple[xr.Dataset, ...] = ()

    def append(self, rows: xr.Dataset) -> "Rows":
        """Table with the rows of one more epoch, perhaps none."""
        return Rows((*self.parts, rows))

    def to_dataset(self) -> xr.Dataset:
        """All rows in their order, attributes as in the first epoch; an empty Dataset without epochs."""
        how: dict[str, Any] = {"data_vars": "minimal", "coords": "minimal", "compat": "override"}
        return xr.concat(self.parts, "row", combine_attrs="override", **how) if self.parts else xr.Dataset()
