"""Spectra on demand: each hit becomes a few coefficients, each channel one small dot product.

`projection` weights the spectra with the channels, `rough` gathers the reflection of rough surfaces, and
`pixels` combines both ray by ray. docs/theory/rendering.md has the equations.
"""

from collections.abc import Iterable, Iterator
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
from glintrack.render.shading.pixels import ShadedFrame, mottle_lattice, shade_pixels
from glintrack.render.shading.projection import FrameGrid, Light, frame_grid, project_spectra
from glintrack.render.shading.rough import VIEW_SPACING_RAD, prefilter


def shade(
    hits: Hits,
    sky: Sky,
    materials: xr.Dataset,
    channels: Float[Array, "channel wavelength"] | None = None,
    pixels: Int[Array, "pixel 2"] | None = None,
    wavelength_um: Float[Array, "channel"] | None = None,
    spectra: "FrameSpectra | None" = None,
) -> xr.DataArray:
    """Stokes radiance at the lens, in the ``detector`` frame.

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
        (row, column) of some elements; the whole frame by default.
    wavelength_um
        Wavelengths instead of channels; linear between those of the sky. [µm]
    spectra
        Projected spectra of the same frame, for several calls.

    Returns
    -------
    Dims (y, x, channel, stokes), with pixels (pixel, channel, stokes); with wavelengths ``wavelength``
    instead of ``channel``. [W m⁻² sr⁻¹ µm⁻¹]

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
    spectra = spectra or FrameSpectra(hits, sky, materials)
    light = next(_shade_parts(hits, spectra, channels, index, [index]))
    if pixels is not None:
        return _label(light, ("pixel",), wavelength_um)
    return _label(light.reshape(hits.rows, hits.columns, len(channels), 3), ("y", "x"), wavelength_um)


def shade_blocks(
    hits: Hits,
    sky: Sky,
    materials: xr.Dataset,
    channels: Float[Array, "channel wavelength"] | None = None,
    wavelength_um: Float[Array, "channel"] | None = None,
    rows: int = 32,
) -> Iterator[tuple[int, xr.DataArray]]:
    """Shade a frame in blocks of rows, so that a full cube need not be in memory.

    Parameters
    ----------
    hits, sky, materials, channels, wavelength_um
        As for `shade`.
    rows
        Rows of a block, at least one; the last block may have fewer.

    Yields
    ------
    The block's first row, and the result of `shade` for its rows: dims (y, x, channel or wavelength,
    stokes).
    """
    if rows < 1:
        raise ValueError(f"`rows` must be at least 1; got {rows}.")
    channels = _weights(sky, channels, wavelength_um)
    index = np.arange(hits.rows * hits.columns)
    parts = (index[k : k + rows * hits.columns] for k in range(0, len(index), rows * hits.columns))
    shaded = _shade_parts(hits, FrameSpectra(hits, sky, materials), channels, index, parts)
    for first, light in zip(range(0, hits.rows, rows), shaded, strict=True):
        yield first, _label(light.reshape(-1, hits.columns, *light.shape[1:]), ("y", "x"), wavelength_um)


def _weights(sky: Sky, channels: Array | None, wavelength_um: Array | None) -> Array:
    """Channel weights on the sky's grid, from channels or wavelengths."""
    grid = sky.wavelength_um
    if (channels is None) == (wavelength_um is None):
        raise ValueError("`shade` must be given either channels or wavelength_um; got both or neither.")
    if wavelength_um is None:
        channels = np.atleast_2d(np.asarray(channels, dtype=float))
        if channels.shape[0] == 0 or channels.shape[1] != len(grid):
            raise ValueError(
                f"`channels` must have at least one row of {len(grid)} weights; got shape {channels.shape}."
            )
        return channels
    wavelength_um = check_wavelengths(wavelength_um)
    return resample(wavelength_um, grid, np.eye(len(grid)), "wavelength_um of the sky").T


def _label(light: Array, leading: tuple[str, ...], wavelength_um: Array | None) -> xr.DataArray:
    """Label Stokes radiance with its dims, unit and reference axis."""
    coords: dict = {"stokes": ["I", "Q", "U"]}
    spectral_dim = "channel"
    if wavelength_um is not None:
        spectral_dim = "wavelength"
        coords["wavelength"] = ("wavelength", np.atleast_1d(wavelength_um), {"units": "um"})
    attrs = {"units": RADIANCE, "stokes_frame": "detector"}
    return xr.DataArray(light, dims=(*leading, spectral_dim, "stokes"), coords=coords, attrs=attrs)


class FrameSpectra:
    """Spectra of a frame contracted with channels, once for all calls with the same channels.

    Directions of look and the samples of `projection.standing_elements` represent the hits.
    """

    def __init__(self, hits: Hits, sky: Sky, materials: xr.Dataset):
        self._hits, self.sky, self._materials = hits, sky, materials
        self._projected: dict[bytes, Light] = {}

    @cached_property
    def looks(self) -> FrameGrid:
        """Directions of look for `prefilter`."""
        return frame_grid(self._hits, VIEW_SPACING_RAD)

    @cached_property
    def surfaces(self) -> MaterialTables:
        """Material tables for kernels."""
        return unpack_surfaces(self._materials, self.sky.wavelength_um)

    def project(self, channels: Float[Array, "channel wavelength"]) -> Light:
        """Call `project_spectra` once for the same channels."""
        key = channels.tobytes()
        if key not in self._projected:
            of_frame = self._hits, self.sky, self._materials, self.surfaces
            self._projected[key] = project_spectra(*of_frame, channels)
        return self._projected[key]


def _shade_parts(
    hits: Hits, spectra: FrameSpectra, channels: Array, index: Array, parts: Iterable[Int[Array, "pixel"]]
) -> Iterator[Float[Array, "pixel channel 3"]]:
    """Shade parts of the elements ``index``; components lie apart in memory, channels together."""
    sun, light = spectra.sky.sun_direction, spectra.project(channels)
    light = light._replace(probes=light_probes(hits, light.by_patch, light.by_bounce, index))
    rough = prefilter(hits, index, spectra.surfaces, light.sky_map, sun, spectra.looks)
    frame = ShadedFrame(hits, spectra.surfaces, light, rough, sun, mottle_lattice())
    for part in parts:
        out = np.empty((len(part), 3, light.lit.shape[3]), np.float32)
        over_rows(shade_pixels, len(part), part, frame, out)
        yield out[:, :, : len(channels)].transpose(0, 2, 1)
