"""Spectra on demand: each hit becomes a few coefficients, each channel one small dot product.

`projection` weighs the spectra with the channels, `rough` gathers what rough surfaces reflect, and `pixels`
puts both together ray by ray. docs/theory/rendering.md has the equations.
"""

from collections.abc import Iterator
from functools import cached_property

import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.core.schema import RADIANCE
from glintrack.core.spectral import check_wavelengths, resample
from glintrack.render.light.sky import Sky
from glintrack.render.shading.diffuse import light_probes
from glintrack.render.shading.hits import Hits
from glintrack.render.shading.materials import MaterialTables, unpack_surfaces
from glintrack.render.shading.pixels import ShadedFrame, mottle_lattice, shade_pixels, unpack_rays
from glintrack.render.shading.projection import FrameGrid, Light, ToProbes, frame_grid, project_spectra
from glintrack.render.shading.rough import VIEW_SPACING_RAD, PrefilteredReflection, prefilter


def shade(
    hits: Hits,
    sky: Sky,
    materials: xr.Dataset,
    channels: Float[Array, "channel wavelength"] | None = None,
    pixels: Int[Array, "pixel 2"] | None = None,
    wavelength_um: Float[Array, "channel"] | None = None,
    spectra: "FrameSpectra | None" = None,
) -> xr.DataArray:
    """Stokes radiance that reaches the lens, in the ``detector`` frame.

    Channels over the frame, spectra at a few pixels; for a full cube see `shade_blocks`.

    Parameters
    ----------
    hits
        From `trace`.
    sky
        From `unpack_sky`.
    materials
        Schema ``materials``.
    channels
        Weights on ``sky.wavelength_um``, as `spectral.channel_weights` makes them. [1]
    pixels
        (row, column) of the elements wanted; the whole frame by default.
    wavelength_um
        Instead of channels: where the spectrum is wanted, linear between those of the sky. [µm]
    spectra
        Of the same frame, kept from call to call.

    Returns
    -------
    Dims (y, x, channel, stokes), or (pixel, channel, stokes) if pixels were named; ``wavelength`` in place of
    ``channel`` if wavelengths were. [W m⁻² sr⁻¹ µm⁻¹]

    Raises
    ------
    ValueError
        If there is no channel, or a wavelength outside the tables of the sky or of a material.
    """
    channels = _weights(sky, channels, wavelength_um)
    if pixels is None:
        index = np.arange(hits.rows * hits.columns)
    else:
        row, column = np.asarray(pixels, dtype=int).T
        index = np.atleast_1d(np.ravel_multi_index((row, column), (hits.rows, hits.columns)))
    shader = _Shader(hits, spectra or FrameSpectra(hits, sky, materials), channels, index)
    light = shader.pixels(index, shader.prefilter(index))
    if pixels is not None:
        return _labelled(light, ("pixel",), wavelength_um)
    return _labelled(light.reshape(hits.rows, hits.columns, len(channels), 3), ("y", "x"), wavelength_um)


def shade_blocks(
    hits: Hits,
    sky: Sky,
    materials: xr.Dataset,
    channels: Float[Array, "channel wavelength"] | None = None,
    wavelength_um: Float[Array, "channel"] | None = None,
    rows: int = 32,
    spectra: "FrameSpectra | None" = None,
) -> Iterator[tuple[int, xr.DataArray]]:
    """Shade a frame in blocks of rows: a full cube need never be in memory at once.

    Parameters
    ----------
    hits, sky, materials, channels, wavelength_um
        As for `shade`.
    rows
        Rows of a block, at least one; the last block may have fewer.
    spectra
        As for `shade`.

    Yields
    ------
    The block's first row, and what `shade` would give for its rows: dims (y, x, channel or wavelength,
    stokes).
    """
    if rows < 1:
        raise ValueError(f"`rows` must be at least 1, got {rows}")
    channels = _weights(sky, channels, wavelength_um)
    index = np.arange(hits.rows * hits.columns)
    shader = _Shader(hits, spectra or FrameSpectra(hits, sky, materials), channels, index)
    rough = shader.prefilter(index)
    for first in range(0, hits.rows, rows):
        last = min(first + rows, hits.rows)
        light = shader.pixels(np.arange(first * hits.columns, last * hits.columns), rough)
        yield first, _labelled(light.reshape(last - first, hits.columns, -1, 3), ("y", "x"), wavelength_um)


def _weights(sky: Sky, channels: Array | None, wavelength_um: Array | None) -> Array:
    """Channel weights on the sky's grid, whichever way they were asked for."""
    grid = sky.wavelength_um
    if (channels is None) == (wavelength_um is None):
        raise ValueError("`shade` must be given either channels or wavelength_um, got both or neither")
    if wavelength_um is None:
        channels = np.atleast_2d(np.asarray(channels, dtype=float))
        if channels.shape[0] == 0 or channels.shape[1] != len(grid):
            raise ValueError(
                f"`channels` must have at least one row of {len(grid)} weights, got shape {channels.shape}"
            )
        return channels
    wavelength_um = check_wavelengths(wavelength_um)
    return resample(wavelength_um, grid, np.eye(len(grid)), "wavelength_um of the sky").T


def _labelled(light: Array, leading: tuple[str, ...], wavelength_um: Array | None) -> xr.DataArray:
    """Stokes radiance with its dims, unit and reference axis."""
    coords: dict = {"stokes": ["I", "Q", "U"]}
    spectral_dim = "channel"
    if wavelength_um is not None:
        spectral_dim = "wavelength"
        coords["wavelength"] = ("wavelength", np.atleast_1d(wavelength_um), {"units": "um"})
    attrs = {"units": RADIANCE, "stokes_frame": "detector"}
    return xr.DataArray(light, dims=(*leading, spectral_dim, "stokes"), coords=coords, attrs=attrs)


class FrameSpectra:
    """Spectra of a frame contracted with channels, once for all calls that ask for the same channels.

    Of the hits, directions of look and the samples of `projection.standing_elements` are read.
    """

    def __init__(self, hits: Hits, sky: Sky, materials: xr.Dataset):
        self._hits, self.sky, self._materials = hits, sky, materials
        self._projected: dict[bytes, tuple[Light, ToProbes]] = {}

    @cached_property
    def looks(self) -> FrameGrid:
        """Directions of look that `prefilter` takes."""
        return frame_grid(self._hits, VIEW_SPACING_RAD)

    @cached_property
    def surfaces(self) -> MaterialTables:
        """Materials as kernels read them."""
        return unpack_surfaces(self._materials, self.sky.wavelength_um)

    def projected(self, channels: Float[Array, "channel wavelength"]) -> tuple[Light, ToProbes]:
        """What `project_spectra` makes of some channels."""
        key = channels.tobytes()
        if key not in self._projected:
            of_frame = self._hits, self.sky, self._materials, self.surfaces
            self._projected[key] = project_spectra(*of_frame, channels)
        return self._projected[key]


class _Shader:
    """A frame made ready for channels: everything that is not done pixel by pixel."""

    def __init__(self, hits: Hits, spectra: FrameSpectra, channels: Array, index: Array):
        self._hits, self._rays, self._looks = hits, unpack_rays(hits), spectra.looks
        self._sun, self._surfaces = spectra.sky.sun_direction, spectra.surfaces
        self._channels = len(channels)
        light, to_probes = spectra.projected(channels)
        self._light = light._replace(probes=light_probes(hits, *to_probes, index))

    def prefilter(self, index: Int[Array, "pixel"]) -> PrefilteredReflection:
        """Table of what rough surfaces reflect, wherever some elements need it."""
        return prefilter(self._hits, index, self._surfaces, self._light.sky_map, self._sun, self._looks)

    def pixels(
        self, index: Int[Array, "pixel"], rough: PrefilteredReflection
    ) -> Float[Array, "pixel channel 3"]:
        """Stokes radiance of some elements; components lie apart in memory, channels together."""
        out = np.empty((len(index), 3, self._channels), np.float32)
        frame = ShadedFrame(self._rays, self._surfaces, self._light, rough, self._sun, mottle_lattice())
        over_rows(shade_pixels, len(index), index, frame, out)
        return out.transpose(0, 2, 1)
