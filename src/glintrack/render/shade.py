"""Spectra on demand: each hit becomes a few coefficients, each channel one small dot product.

`projection` weighs the spectra with the channels, `rough` gathers what rough surfaces reflect, and `pixels`
puts both together ray by ray. docs/rendering.md has the equations.
"""

from collections.abc import Iterator
from copy import copy
from functools import cached_property

import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.core.schema import RADIANCE
from glintrack.core.spectral import check_wavelengths, resample
from glintrack.render.hits import Hits
from glintrack.render.shading.frame_grid import FrameGrid, frame_grid
from glintrack.render.shading.incidence import mottle_lattice
from glintrack.render.shading.pixels import Frame, shade_pixels, unpack_rays
from glintrack.render.shading.probe_light import light_probes
from glintrack.render.shading.projection import Light, ToProbes, project_spectra
from glintrack.render.shading.rough import VIEW_SPACING_RAD, PrefilteredReflection, prefilter
from glintrack.render.shading.surfaces import Surfaces, unpack_surfaces
from glintrack.render.sky import Sky


def shade(
    hits: Hits,
    sky: Sky,
    materials: xr.Dataset,
    channels: Float[Array, "channel wavelength"] | None = None,
    pixels: Int[Array, "pixel 2"] | None = None,
    wavelength_um: Float[Array, "channel"] | None = None,
    out: xr.DataArray | None = None,
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
    out
        What an earlier call returned for as many elements and channels: its memory is written anew. Of a full
        cube fresh memory is several hundred MB, which a system must clear first.
    spectra
        Of the same frame, kept from call to call; of a frame of which these hits are some rows,
        `FrameSpectra.of_rows`.

    Returns
    -------
    Dims (y, x, channel, stokes), or (pixel, channel, stokes) if pixels were named; ``wavelength`` in place of
    ``channel`` if wavelengths were. [W m⁻² sr⁻¹ µm⁻¹]

    Raises
    ------
    ValueError
        If there is no channel, a wavelength outside the tables of the sky or of a material, or ``out`` is of
        another shape.
    """
    channels = _weights(sky, channels, wavelength_um)
    if pixels is None:
        index = np.arange(hits.rows * hits.columns)
    else:
        row, column = np.asarray(pixels, dtype=int).T
        index = np.atleast_1d(np.ravel_multi_index((row, column), (hits.rows, hits.columns)))
    kept = None if out is None else _memory(out, len(index), len(channels))
    shader = _Shader(hits, spectra or FrameSpectra(hits, sky, materials), channels, index)
    light, _ = shader.pixels(index, shader.prefilter(index), kept)
    if pixels is not None:
        return _labelled(light, ("pixel",), wavelength_um)
    return _labelled(light.reshape(hits.rows, hits.columns, len(channels), 3), ("y", "x"), wavelength_um)


def shade_with_guests(
    hits: Hits, spectra: "FrameSpectra", channels: Array, guests: Array
) -> tuple[xr.DataArray, xr.DataArray]:
    """A frame as of `shade` in some channels, and beside it in others, which cost little there.

    Parameters
    ----------
    hits, spectra
        Of the frame.
    channels, guests
        Weights on the sky's wavelengths. The light in ``channels`` is to the last bit what it is without
        guests. [1]
    """
    both = [_weights(spectra.sky, some, None) for some in (channels, guests)]
    index = np.arange(hits.rows * hits.columns)
    shader = _Shader(hits, spectra, np.concatenate(both), index, guests=len(both[1]))
    shape, found = (hits.rows, hits.columns, -1, 3), shader.pixels(index, shader.prefilter(index))
    own, others = (_labelled(light.reshape(shape), ("y", "x"), None) for light in found)
    return own, others


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
        light, _ = shader.pixels(np.arange(first * hits.columns, last * hits.columns), rough)
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


def _memory(light: xr.DataArray, pixels: int, channels: int) -> Float[Array, "pixel 3 channel"]:
    """The memory under what `shade` returned."""
    values = np.swapaxes(light.values, -1, -2)
    if values.size != 3 * pixels * channels or values.shape[-2:] != (3, channels):
        raise ValueError(f"`out` must hold {pixels} elements of {channels} channels, got shape {light.shape}")
    if values.dtype != np.float32 or not (values.flags.c_contiguous and values.flags.writeable):
        raise ValueError("`out` must be what `shade` returned, whole and unchanged, got another array")
    return values.reshape(pixels, 3, channels)


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
        self._rows = slice(None)
        self._projected: dict[tuple[bytes, int], tuple[Light, ToProbes]] = {}

    def of_rows(self, rows: slice) -> "FrameSpectra":
        """Of the same frame, for hits of some of its rows."""
        own = copy(self)
        own._rows = rows
        return own

    @cached_property
    def _looks(self) -> FrameGrid:
        return frame_grid(self._hits, VIEW_SPACING_RAD)

    @property
    def looks(self) -> FrameGrid:
        """Directions of look that `prefilter` takes."""
        return self._looks.of_rows(self._rows)

    @cached_property
    def surfaces(self) -> Surfaces:
        """Materials as kernels read them."""
        return unpack_surfaces(self._materials, self.sky.wavelength_um)

    def projected(
        self, channels: Float[Array, "channel wavelength"], guests: int = 0
    ) -> tuple[Light, ToProbes]:
        """What `project_spectra` makes of some channels."""
        key = channels.tobytes(), guests
        if key not in self._projected:
            of_frame = self._hits, self.sky, self._materials, self.surfaces
            self._projected[key] = project_spectra(*of_frame, channels, guests)
        light, to_probes = self._projected[key]
        return light._replace(grid=light.grid.of_rows(self._rows)), to_probes


class _Shader:
    """A frame made ready for channels: everything that is not done pixel by pixel."""

    def __init__(self, hits: Hits, spectra: FrameSpectra, channels: Array, index: Array, guests: int = 0):
        self._hits, self._rays, self._looks = hits, unpack_rays(hits), spectra.looks
        self._sun, self._surfaces = spectra.sky.sun_direction, spectra.surfaces
        self._channels = len(channels) - guests, guests
        light, to_probes = spectra.projected(channels, guests)
        self._light = light._replace(probes=light_probes(hits, *to_probes, index))

    def prefilter(self, index: Int[Array, "pixel"]) -> PrefilteredReflection:
        """Table of what rough surfaces reflect, wherever some elements need it."""
        return prefilter(self._hits, index, self._surfaces, self._light.sky_map, self._sun, self._looks)

    def pixels(
        self,
        index: Int[Array, "pixel"],
        rough: PrefilteredReflection,
        out: Float[Array, "pixel 3 channel"] | None = None,
    ) -> tuple[Float[Array, "pixel channel 3"], Float[Array, "pixel guest 3"]]:
        """Stokes radiance of some elements; components lie apart in memory, channels together."""
        own, guests = self._channels
        if out is None:
            out = np.empty((len(index), 3, own), np.float32)
        beside = np.empty((len(index), 3, guests), np.float32)
        frame = Frame(self._rays, self._surfaces, self._light, rough, self._sun, mottle_lattice())
        over_rows(shade_pixels, len(index), index, frame, out, beside)
        return out.transpose(0, 2, 1), beside.transpose(0, 2, 1)
