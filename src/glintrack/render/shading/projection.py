"""Spectra × channel weights, once for all pixels, so that 211 bands cost the same as one.

radiance(λ) = τ(λ)·[Σ_m ρ_m(λ) (c₀ E_sun + c₁ E_around + Σ_k c_k E_k) + Σ_j a_j(λ) (c L_sun + c L_around +
Σ_k c_k φ_k)] + path(λ). The first bracket is light from bases and through leaves, polarized by refraction
at their interface or by a mirror, the same in all channels. The second holds Stokes vectors: glint,
surroundings and sky mirrored by a surface with the spectra a_j of its Fresnel terms.
"""

import math
from typing import NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.render.light.gather import ENCLOSED, MET_AGAIN, SECOND, MaterialClasses, material_classes
from glintrack.render.light.probes import BOUNCE_UNIT
from glintrack.render.light.sky import LEVEL_NODE, QUARTERS, Sky, look_up_all
from glintrack.render.shading.diffuse import CAP_LOST, RING_LOST, mirror_patch_shares
from glintrack.render.shading.hits import Hits, samples_of
from glintrack.render.shading.materials import MaterialTables
from glintrack.stokes import frame_angle, rotate


class FrameGrid(NamedTuple):
    """Nodes at some elements of the frame, and the place of each row and column between them.

    Parameters
    ----------
    direction
        Unit direction of look at each node. [1]
    row_low, column_low
        Node before each row and column.
    row_part, column_part
        Part toward the next node. [1]
    """

    direction: Float[Array, "node_row node_column 3"]
    row_low: Int[Array, "row"]
    row_part: Float[Array, "row"]
    column_low: Int[Array, "column"]
    column_part: Float[Array, "column"]


def frame_grid(hits: Hits, spacing_rad: float) -> FrameGrid:
    """Nodes at most ``spacing_rad`` apart along the middle row and column of a frame."""
    rows, columns = hits.rows, hits.columns
    look = hits.look.reshape(rows, columns, 3)
    at_rows = _nodes(look[:, columns // 2], spacing_rad)
    at_columns = _nodes(look[rows // 2], spacing_rad)
    places = []
    for nodes, count in ((at_rows, rows), (at_columns, columns)):
        place = np.interp(np.arange(count), nodes, np.arange(len(nodes)))
        low = np.clip(place.astype(np.int64), 0, max(len(nodes) - 2, 0))
        places += [low, place - low]
    return FrameGrid(np.ascontiguousarray(look[np.ix_(at_rows, at_columns)], dtype=np.float64), *places)


def _nodes(line: Float[Array, "element 3"], spacing_rad: float) -> Int[Array, "node"]:
    """Spread elements evenly along a line, with both ends."""
    extent = float(np.arccos(np.clip(line[0].astype(float) @ line[-1], -1, 1)))
    count = min(max(int(np.ceil(extent / spacing_rad)) + 1, 2), len(line))
    return np.unique(np.rint(np.linspace(0, len(line) - 1, count)).astype(np.int64))


_MIN_SKY = 3e-4  # relative strength under which a combination of sky components is left out
_MIN_DIFFUSE = 2e-3  # the same of the light of bases, for any channels
_PATH_SPACING_RAD = math.radians(0.5)
_DEPTH_STEP = 0.05  # optical depth between nodes: linear interpolation is good to 3e-4
_MAX_NODES = 64
_SURROUNDINGS_ELEMENTS = 4096
_MIN_SUN = 0.05  # sine of its elevation, in the light of the sky about it
LANES = 32  # many channels are padded to a multiple of the lanes of a compiled loop


class Light(NamedTuple):
    """Contracted spectra of one frame, for the kernel.

    Parameters
    ----------
    airmass_start, airmass_step
        Nodes of the transmittance in 1/cos of the view zenith. [1]
    lit
        τ ρ × irradiance for sun, surroundings and each diffuse component, by channel; the second half of the
        rows is for the transmission of leaves.
    mirrored
        τ a_j × (sun irradiance, surroundings' radiance, each sky component), by channel, for each dispersion
        group. The last node has no air: it is for rays to the sky.
    group
        Dispersion group of each optical class.
    sky_map
        Angular maps of the sky components.
    irradiance
        Irradiance of each diffuse component over normals, under the open sky.
    probes
        Irradiance of each diffuse component at each probe, from the sky and off surfaces (`diffuse`).
    by_patch, of_patch
        Irradiance of each diffuse component from each patch of the sky over normals, for an open part of
        1/255; and of all wavelengths.
    by_bounce
        Irradiance of each diffuse component per unit of `Hits.probe_bounced`.
    near_sun
        Irradiance of each diffuse component from the cap about the sun and from the ring about that, over
        normals.
    followed
        True if probes have the light of surfaces; else the frame's mean is used.
    path
        Path radiance by channel in the ``detector`` frame over `grid`.
    grid
        Directions of look.

    Many channels are padded with zeros to a multiple of 32.
    """

    airmass_start: float
    airmass_step: float
    lit: Float[Array, "airmass material light channel"]
    mirrored: Float[Array, "airmass group component channel"]
    group: Int[Array, "optics"]
    sky_map: Float[Array, "disc disc sky_component 3"]
    irradiance: Float[Array, "normal diffuse_component"]
    probes: Float[Array, "probe light_and_2"]
    by_patch: Float[Array, "normal patch diffuse_component"]
    of_patch: Float[Array, "normal patch"]
    by_bounce: Float[Array, "bounce diffuse_component"]
    near_sun: Float[Array, "normal cap_and_ring diffuse_component"]
    followed: bool
    path: Float[Array, "node_row node_column 3 channel"]
    grid: FrameGrid


def project_spectra(
    hits: Hits,
    sky: Sky,
    materials: xr.Dataset,
    surfaces: MaterialTables,
    channels: Float[Array, "channel wavelength"],
) -> Light:
    """Contract every spectrum of a frame with the channels; its probes are not lit yet."""
    airmass, tau = _transmittance(hits, sky)
    weights = (tau[:, None] * channels).reshape(-1, channels.shape[1])  # (airmass channel, wavelength)
    shape = len(tau), len(channels)
    rho = base_spectra(materials, sky.wavelength_um)
    around = _surroundings(hits, sky, rho[: len(surfaces.weight)])
    # diffuse light: the sky components, scaled so that level ground gets the tables' irradiance, and bounces
    whole = sky.irradiance_map.sum(axis=1)
    level = whole[LEVEL_NODE] @ sky.sky_spectrum
    scale = np.divide(sky.sky_irradiance, level, out=np.ones_like(level), where=level > 0)
    bounces = _bounce_spectra(hits, sky, material_classes(materials), rho)
    by_component = np.concatenate([sky.sky_spectrum * scale, bounces])
    strength = np.concatenate([np.abs(whole).max(axis=0), np.ones(len(bounces))])
    diffuse, of_irradiance = _compress(rho[:, :, None] * by_component.T, strength, _MIN_DIFFUSE)
    of_sky, of_bounce = np.split(of_irradiance, [len(sky.sky_spectrum)])
    lights = np.concatenate([sky.sun_irradiance[None], around[None], diffuse.T @ by_component])
    taken = (weights @ sky.sky_spectrum.T).reshape(*shape, -1)
    of_spectrum, of_map = _compress(taken, np.abs(sky.sky_map).max(axis=(0, 1)).max(axis=1))
    light = np.concatenate([sky.sun_irradiance[None], around[None] / np.pi, of_spectrum.T @ sky.sky_spectrum])
    group, terms = _groups(surfaces)
    path_grid = frame_grid(hits, _PATH_SPACING_RAD)
    looked_at = channels.sum(axis=0)
    mean = float(around @ looked_at)
    off_mean = bounces @ looked_at / mean if mean > 0 else np.zeros(len(bounces))
    # after the diffuse components the two of `diffuse`: the mirrored sky, and light off surfaces
    mirrored_sky = mirror_patch_shares(sky, hits.look, looked_at)
    place_sky = np.stack([mirrored_sky, np.zeros_like(mirrored_sky)], axis=-1)
    by_patch = np.concatenate([sky.irradiance_map @ of_sky, place_sky], axis=-1)
    by_bounce = np.concatenate([of_bounce, np.zeros((len(bounces), 1)), off_mean[:, None]], axis=-1)
    return Light(
        airmass_start=float(airmass[0]),
        airmass_step=float(airmass[1] - airmass[0]),
        lit=_contract(rho, weights, lights, *shape),
        mirrored=_contract(terms, weights, light, *shape),
        group=group,
        sky_map=np.ascontiguousarray(of_map.T @ sky.sky_map, np.float32),
        irradiance=by_patch.sum(axis=1).astype(np.float32),
        probes=np.zeros((0, 2 * by_patch.shape[2] + 2), np.float32),
        by_patch=(by_patch / 255).astype(np.float32),
        of_patch=(sky.irradiance_map @ sky.sky_spectrum.sum(axis=1)).astype(np.float32),
        by_bounce=(BOUNCE_UNIT * by_bounce).astype(np.float32),
        near_sun=sun_vicinity(by_patch),
        followed=len(bounces) > 0,
        path=_path(hits, sky, path_grid, channels),
        grid=path_grid,
    )


def sun_vicinity(by_patch: Float[Array, "normal patch component"]) -> Float[Array, "normal 2 component"]:
    """Irradiance from the cap about the sun, and from the ring of quarters about that."""
    ring = by_patch[:, 1 : 1 + QUARTERS].sum(axis=1)
    return np.stack([by_patch[:, 0], ring], axis=1).astype(np.float32)


def base_spectra(materials: xr.Dataset, wavelength_um: Array) -> Float[Array, "row wavelength"]:
    """Reflectance of each material, then transmittance of each, on the sky's grid."""
    table = materials["wavelength"].values.astype(float)
    if wavelength_um[0] < table[0] - 1e-9 or wavelength_um[-1] > table[-1] + 1e-9:
        raise ValueError(
            f"`materials.reflectance` must cover {wavelength_um[0]:g} to {wavelength_um[-1]:g} µm; "
            f"got {table[0]:g} to {table[-1]:g} µm."
        )
    rows = materials["reflectance"].values.astype(float)
    through = materials["transmittance"].values if "transmittance" in materials else np.zeros_like(rows)
    both = np.concatenate([rows, through])
    return np.stack([np.interp(wavelength_um, table, row) for row in both])


def _contract(
    spectra: Array, weights: Array, lights: Array, airmasses: int, channels: int
) -> Float[Array, "airmass row light channel"]:
    """Products of spectra and lights, contracted with (airmass channel, wavelength) weights."""
    lit_by = (lights.T[:, :, None] * weights.T[:, None]).reshape(weights.shape[1], -1)
    contracted = spectra.reshape(-1, spectra.shape[-1]) @ lit_by
    return _pad_channels(np.moveaxis(contracted.reshape(len(spectra), -1, airmasses, channels), 2, 0))


def _pad_channels(channels: Array) -> Array:
    """Convert to single precision and pad the channels with zeros."""
    count = channels.shape[-1]
    width = count if count < LANES // 2 else -(-count // LANES) * LANES
    out = np.zeros((*channels.shape[:-1], width), np.float32)
    out[..., :count] = channels
    return out


def _transmittance(hits: Hits, sky: Sky) -> tuple[Array, Array]:
    """Airmass nodes over the frame, and the transmittance at each; another row of ones for the sky."""
    up = hits.look[:, 2]
    highest = up.max(initial=-1.0)
    highest = highest if highest < 0 else up[up < 0].max(initial=-1.0)
    lowest = math.cos(float(sky.view_zenith_rad[-1]))
    steep = float(np.clip(-up.min(initial=-lowest), lowest, 1))
    flat = float(np.clip(-highest, lowest, steep))
    first, last = 1 / steep, max(1 / flat, 1 / steep + 1e-6)
    table_airmass = 1 / np.cos(sky.view_zenith_rad)
    depth = -np.log(np.maximum(sky.transmittance[:, 0], 1e-9)).max() * math.cos(sky.view_zenith_rad[0])
    count = int(np.clip(math.ceil((last - first) * depth / _DEPTH_STEP) + 1, 2, _MAX_NODES))
    airmass = np.linspace(first, last, count)
    logarithm = np.log(np.maximum(sky.transmittance, 1e-30))
    tau = np.exp(np.stack([np.interp(airmass, table_airmass, row) for row in logarithm], axis=1))
    return airmass, np.concatenate([tau, np.ones((1, tau.shape[1]))])


def standing_elements(count: int) -> Int[Array, "element"]:
    """Elements that represent a frame in mean values, the same with and without traffic."""
    return np.arange(0, count, max(count // _SURROUNDINGS_ELEMENTS, 1))


def _standing_samples(hits: Hits) -> tuple[Int[Array, "sample"], Float[Array, "sample"]]:
    """Find samples on surfaces that represent the frame, and their weights."""
    some = samples_of(hits, standing_elements(hits.rows * hits.columns))
    some = some[hits.material[some] >= 0]
    return some, hits.weight[some].astype(float)


def _surroundings(hits: Hits, sky: Sky, rho: Array) -> Float[Array, "wavelength"]:
    """Mean light of the surfaces in view, as the irradiance from below. [W m⁻² µm⁻¹]"""
    some, weight = _standing_samples(hits)
    if len(some) == 0:
        return np.zeros(len(sky.wavelength_um))
    material, normal = hits.material[some], hits.normal[some].astype(float)
    sun = weight * np.maximum(normal @ sky.sun_direction, 0) * hits.sun_visible[some]
    above = weight * 0.5 * (1 + normal[:, 2]) * hits.sky_view[some]
    lit = [np.bincount(material, weights=w, minlength=len(rho)) / weight.sum() for w in (sun, above)]
    by_sun, by_sky = np.stack(lit) @ rho
    return by_sun * sky.sun_irradiance + by_sky * sky.sky_irradiance


def _bounce_spectra(
    hits: Hits, sky: Sky, classes: MaterialClasses, rho: Array
) -> Float[Array, "bounce wavelength"]:
    """Irradiance per unit of `Hits.probe_bounced`: spectra of the classes, by their light."""
    some, weight = _standing_samples(hits)
    if len(some) == 0 or hits.probe_bounced.shape[1] == 0:
        return np.zeros((hits.probe_bounced.shape[1], len(sky.wavelength_um)))
    share = np.bincount(hits.material[some], weights=weight, minlength=len(rho) // 2) / weight.sum()
    sent_on = share @ (rho[: len(rho) // 2] + rho[len(rho) // 2 :])
    on = 1 / (1 - ENCLOSED * np.clip(sent_on, 0, 1))
    spectra = np.stack([np.interp(sky.wavelength_um, classes.wavelength_um, row) for row in classes.spectra])
    leaf = np.interp(sky.wavelength_um, classes.wavelength_um, classes.leaf)[None]
    met_again = 1 / (1 - MET_AGAIN * np.clip(leaf, 0, 1))
    among = 0.5 * leaf**2 * (met_again - on)
    among_by_sky = leaf * MET_AGAIN * (leaf * met_again - sent_on * on)
    twice = (spectra[:, None] * spectra[None, :SECOND]).reshape(-1, len(sky.wavelength_um))
    # skylight on level ground that comes and goes with the sun: of the cap and of the ring about it
    by_patch = sky.irradiance_map[LEVEL_NODE : LEVEL_NODE + 1] @ sky.sky_spectrum
    level, (cap, ring) = by_patch[0].sum(axis=0), sun_vicinity(by_patch)[0].astype(float)
    part = np.divide(CAP_LOST * cap + RING_LOST * ring, level, out=np.zeros_like(level), where=level > 0)
    with_sun = part * sky.sky_irradiance
    sun = sky.sun_irradiance + with_sun / max(float(sky.sun_direction[2]), _MIN_SUN)
    rest = sky.sky_irradiance - with_sun
    by_sky = np.concatenate([spectra, spectra * sent_on * on]) * rest
    return np.concatenate([spectra * sun, by_sky, twice * on * sun, among * sun, among_by_sky * rest])


def _compress(weights: Array, size: Array, least: float = _MIN_SKY) -> tuple[Array, Array]:
    """Find the fewest combinations of components with the same light in the channels.

    ``weights`` (..., component) are those of each component in each channel, ``size`` the greatest absolute
    value of each component's map, ``least`` the relative error. Return the part of each component in the
    spectrum and in the map of each combination (component, combination).
    """
    size = np.where(size > 0, size, 1.0)
    taken = weights.reshape(-1, weights.shape[-1]) * size
    strength, turned = np.linalg.eigh(taken.T @ taken)
    turned = turned[:, ::-1][:, : max(int((strength > least**2 * strength[-1]).sum()), 1)]
    return turned * size[:, None], turned / size[:, None]


def _groups(surfaces: MaterialTables) -> tuple[Int[Array, "optics"], Float[Array, "group term wavelength"]]:
    """Group optical classes by the spectra of their Fresnel terms; group 0 has no dispersion."""
    plain = np.zeros_like(surfaces.dispersion[0])
    plain[0] = 1.0
    spectra = {own.tobytes(): own for own in (plain, *surfaces.dispersion)}
    keys = list(spectra)
    group = np.array([keys.index(own.tobytes()) for own in surfaces.dispersion], np.int64)
    return group, np.stack(list(spectra.values()))[:, : int(surfaces.terms.max(initial=1))]


def _path(hits: Hits, sky: Sky, grid: FrameGrid, channels: Array) -> Array:
    """Path radiance (row, column, 3, channel) at the nodes of a frame."""
    look = grid.direction.reshape(-1, 3).copy()
    look[:, 2] = np.minimum(look[:, 2], -1e-9)  # above the horizon that of the horizon
    components, north = look_up_all(sky.path_map, look)
    by_stokes = np.moveaxis(components, 1, 2).reshape(-1, components.shape[1])
    light = (by_stokes @ (sky.path_spectrum @ channels.T)).reshape(len(look), 3, -1)
    turn = frame_angle(north, np.broadcast_to(hits.detector_axis, look.shape), -look)
    turned = rotate(np.moveaxis(light, 1, 2), turn[:, None])
    return _pad_channels(np.moveaxis(turned, 1, 2)).reshape(*grid.direction.shape, -1)
