"""Spectra on demand: each hit becomes a few coefficients, each channel one small dot product.

radiance(λ) = τ(λ)·[ρ(λ)·(c₀ E_sun + c₁ E_sky) + c₂ E_sun + c₃ E_sky + Σ_k c_k φ_k(λ)] + path(λ), where the
φ_k are the sky's spectral components. Only c₀ and c₁ (diffuse, depolarized) multiply a material's spectrum;
the others are Stokes vectors: sun glint, surroundings seen in a mirror, reflected sky. A channel contracts
the spectra with its weights before the pixels are visited, so 211 bands cost what one does.
"""

import math
from collections.abc import Iterator

import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from ..schema import RADIANCE
from ..spectral import check_wavelengths, resample
from ..threads import over_rows
from .hits import Hits
from .pixels import shade_pixels
from .sky import Sky

Array = np.ndarray

_KEPT = 1e-6  # relative strength under which a combination of sky components cannot be seen in float32
_VIEW_NODES = 8  # transmittance is smooth: eight view zeniths over a frame, linear between


def shade(
    hits: Hits,
    sky: Sky,
    materials: xr.Dataset,
    channels: Float[Array, "channel wavelength"] | None = None,
    pixels: Int[Array, "pixel 2"] | None = None,
    wavelength_um: Float[Array, "channel"] | None = None,
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
    spectra = _contract(hits, sky, materials, channels, index)
    out = np.empty((len(index), len(channels), 3), np.float32)
    over_rows(
        shade_pixels,
        len(index),
        index,
        hits.columns,
        hits.oversampling,
        hits.direction,
        hits.point,
        hits.normal,
        hits.material,
        hits.vehicle_id,
        hits.sun_visible,
        hits.mirror_material,
        hits.detector_axis,
        sky.sun_direction,
        np.stack([materials[name].values.astype(float) for name in _SURFACE], axis=1),
        *spectra,
        out,
    )
    if pixels is not None:
        return _labelled(out, ("pixel",), wavelength_um)
    return _labelled(out.reshape(hits.rows, hits.columns, len(channels), 3), ("y", "x"), wavelength_um)


def shade_blocks(
    hits: Hits,
    sky: Sky,
    materials: xr.Dataset,
    channels: Float[Array, "channel wavelength"] | None = None,
    wavelength_um: Float[Array, "channel"] | None = None,
    rows: int = 32,
) -> Iterator[tuple[int, xr.DataArray]]:
    """Shade a frame in blocks of rows: a full cube need never be in memory at once.

    Parameters
    ----------
    hits, sky, materials, channels, wavelength_um
        As for `shade`.
    rows
        Rows of a block, at least one; the last block may have fewer.

    Yields
    ------
    The block's first row, and what `shade` would give for its rows: dims (y, x, channel or wavelength,
    stokes).
    """
    if rows < 1:
        raise ValueError(f"`rows` must be at least 1, got {rows}")
    columns = np.arange(hits.columns)
    for first in range(0, hits.rows, rows):
        block = np.arange(first, min(first + rows, hits.rows))
        pixels = np.stack(np.meshgrid(block, columns, indexing="ij"), axis=-1).reshape(-1, 2)
        light = shade(hits, sky, materials, channels, pixels, wavelength_um).values
        yield (
            first,
            _labelled(light.reshape(len(block), hits.columns, *light.shape[1:]), ("y", "x"), wavelength_um),
        )


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


_SURFACE = ("refractive_index", "extinction_index", "roughness", "specular_weight", "mottle")


def _contract(hits: Hits, sky: Sky, materials: xr.Dataset, channels: Array, index: Array):
    """Spectra × channel weights at a few view zeniths, and the angular maps that go with them.

    Returns
    -------
    sky map, path map, by material (node, material, 2, channel), common
    (node, 2 + component, channel), path (component, channel), first node, node spacing [rad]. The last node
    has no atmosphere between: it is for pixels that see the sky.
    """
    nodes = _view_nodes(hits, float(sky.view_zenith_rad[-1]), index)
    tau = np.stack([np.interp(nodes, sky.view_zenith_rad, t) for t in sky.transmittance], axis=1)
    tau = np.concatenate([tau, np.ones((1, len(sky.wavelength_um)))])
    lit = np.stack([sky.sun_irradiance, sky.sky_irradiance])
    reflectance = _on_grid(materials, sky.wavelength_um)
    by_material = np.einsum("nl,ml,el,cl->nmec", tau, reflectance, lit, channels, optimize=True)
    lights = np.einsum("nl,el,cl->nec", tau, lit, channels, optimize=True)
    reflected = np.einsum("nl,kl,cl->nck", tau, sky.sky_spectrum, channels, optimize=True)
    reflected, sky_map = _compress(reflected, sky.sky_map)
    path, path_map = _compress(channels @ sky.path_spectrum.T, sky.path_map)
    common = np.concatenate([lights, np.moveaxis(reflected, -1, 1)], axis=1)
    return (
        sky_map,
        path_map,
        # one memory layout, whatever einsum chose: the kernel is compiled once
        np.ascontiguousarray(by_material),
        np.ascontiguousarray(common),
        np.ascontiguousarray(path.T),
        float(nodes[0]),
        float(nodes[1] - nodes[0]),
    )


def _view_nodes(hits: Hits, highest: float, index: Array) -> Array:
    """Even view zeniths over the rays that will be shaded. [rad]"""
    direction = hits.direction if hits.oversampling > 1 else hits.direction[index]
    down = -direction[:, 2]
    down = down[down > 0]
    low = math.acos(min(float(down.max(initial=0.0)), 1.0)) if down.size else 0.0
    high = math.acos(max(float(down.min(initial=1.0)), 0.0)) if down.size else 0.0
    high = min(max(high, low + 1e-6), highest)
    return np.linspace(min(low, high - 1e-6), high, _VIEW_NODES)


def _compress(weights: Array, maps: Array) -> tuple[Array, Array]:
    """Fewest components that give the same light in these channels: a few bands need few of them.

    Parameters
    ----------
    weights
        (..., component): what each channel takes of each component.
    maps
        (disc, disc, component, 3).

    Returns
    -------
    weights (..., r) and maps (disc, disc, r, 3), r ≤ component, with the same product to `_KEPT`.
    """
    size = np.abs(maps).max(axis=(0, 1, 3))
    left, strength, right = np.linalg.svd(weights.reshape(-1, weights.shape[-1]) * size, full_matrices=False)
    rank = max(int((strength > _KEPT * strength[0]).sum()), 1)
    if rank == len(size):
        return weights, maps
    kept = (left[:, :rank] * strength[:rank]).reshape(*weights.shape[:-1], rank)
    turned = np.einsum("rk,pakS->parS", right[:rank] / np.where(size > 0, size, 1), maps, optimize=True)
    return kept, np.ascontiguousarray(turned)


def _on_grid(materials: xr.Dataset, wavelength_um: Array) -> Array:
    """Reflectance (material, wavelength) on the sky's grid."""
    table = materials["wavelength"].values.astype(float)
    if wavelength_um[0] < table[0] - 1e-9 or wavelength_um[-1] > table[-1] + 1e-9:
        raise ValueError(
            f"`materials.reflectance` must cover {wavelength_um[0]:g} to {wavelength_um[-1]:g} µm, "
            f"got {table[0]:g} to {table[-1]:g} µm"
        )
    rows = materials["reflectance"].values.astype(float)
    return np.stack([np.interp(wavelength_um, table, row) for row in rows])
