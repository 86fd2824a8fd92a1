"""Spectra × channel weights, before any pixel is visited: 211 bands cost what one does.

radiance(λ) = τ(λ)·[Σ_m ρ_m(λ) (c₀ E_sun + c₁ E_around + Σ_k c_k E_k) + Σ_j a_j(λ) (c L_sun + c L_around +
Σ_k c_k φ_k)] + path(λ). The first bracket is light from bases and through leaves, polarized by refraction
at their interface or by the mirror that shows it, the same in all channels; the second holds Stokes
vectors: glint, surroundings and sky mirrored by a surface whose Fresnel terms have the spectra a_j.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.render.light.gather import ENCLOSED, MET_AGAIN, SECOND, MaterialClasses, material_classes
from glintrack.render.light.probes import BOUNCE_UNIT
from glintrack.render.light.sky import LEVEL_NODE, QUARTERS, Sky, look_up_all
from glintrack.render.shading.diffuse import CAP_LOST, PLACE_COMPONENTS, RING_LOST, mirrored_patches
from glintrack.render.shading.hits import Hits, samples_of
from glintrack.render.shading.materials import MaterialTables
from glintrack.stokes import frame_angle, rotate


class FrameGrid(NamedTuple):
    """Nodes at some elements of the frame, and where each row and column lies between them.

    Parameters
    ----------
    direction
        Unit direction of look at each node. [1]
    row_low, column_low
        Node before each row and column.
    row_part, column_part
        How far on toward the next node. [1]
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
    return FrameGrid(
        np.ascontiguousarray(look[np.ix_(at_rows, at_columns)], dtype=np.float64),
        *_between(at_rows, rows),
        *_between(at_columns, columns),
    )


def _nodes(line: Float[Array, "element 3"], spacing_rad: float) -> Int[Array, "node"]:
    """Evenly spread elements of a line, both ends among them."""
    extent = float(np.arccos(np.clip(line[0].astype(float) @ line[-1], -1, 1)))
    count = min(max(int(np.ceil(extent / spacing_rad)) + 1, 2), len(line))
    return np.unique(np.rint(np.linspace(0, len(line) - 1, count)).astype(np.int64))


def _between(nodes: Array, count: int) -> tuple[Array, Array]:
    if len(nodes) == 1:
        return np.zeros(count, np.int64), np.zeros(count)
    line = np.arange(count)
    low = np.clip(np.searchsorted(nodes, line, side="right") - 1, 0, len(nodes) - 2)
    return low, (line - nodes[low]) / (nodes[low + 1] - nodes[low])


_DIFFUSE_KEPT = 2e-3  # the same of what lights bases, whichever channels are wanted
_SKY_KEPT = 3e-4  # relative strength under which a combination of sky components is left out
_PATH_SPACING_RAD = math.radians(0.5)
_DEPTH_STEP = 0.05  # optical depth between nodes: linear between them is good to 3e-4
_MOST_NODES = 64
_SURROUNDINGS_ELEMENTS = 4096
_LOWEST_SUN = 0.05  # sine of its elevation: lower, the sky about it is not brighter than that for bases
_LEAST_PRODUCTS = 500_000  # multiplications that are worth a thread
LANES = 32  # many channels are filled up to a multiple of so many, which a compiled loop takes at once


class ToProbes(NamedTuple):
    """What each diffuse component sends to a probe (`light_probes`): from the sky, and off surfaces."""

    by_patch: Float[Array, "normal patch diffuse_component"]
    by_bounce: Float[Array, "bounce diffuse_component"]


class Light(NamedTuple):
    """Contracted spectra of one frame, for the kernel.

    Parameters
    ----------
    airmass_start, airmass_step
        Nodes of the transmittance in 1/cos of the view zenith. [1]
    lit
        τ ρ × irradiance for sun, surroundings and each diffuse component, by channel; the second half of the
        rows is for what passes through leaves.
    mirrored
        τ a_j × (sun irradiance, surroundings' radiance, each sky component), by channel, for each dispersion
        group. The last node has no air between: it is for rays that see the sky.
    group
        Dispersion group of each optical class.
    sky_map
        Angular maps of the sky components kept.
    irradiance
        Of each diffuse component over normals, under the open sky.
    probes
        Of each diffuse component at each probe, from the sky and off surfaces (`diffuse`).
    by_patch, of_patch
        Of each diffuse component from each patch of the sky over normals, for a part of 1/255 that is open;
        and of all wavelengths.
    near_sun
        Of each diffuse component from the cap about the sun and from the ring about that, over normals.
    followed
        Whether probes hold the light of what stands around; else the frame's mean stands for it.
    path
        Path radiance by channel in the ``detector`` frame over `grid`.
    grid
        Directions of look.

    Many channels are followed by zeros up to a multiple of 32.
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
) -> tuple[Light, ToProbes]:
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
    diffuse, of_irradiance = _compress(rho[:, :, None] * by_component.T, strength, _DIFFUSE_KEPT)
    of_sky, of_bounce = np.split(of_irradiance, [len(sky.sky_spectrum)])
    lights = np.concatenate([sky.sun_irradiance[None], around[None], diffuse.T @ by_component])
    lit = _product(rho, _lit_by(weights, lights))
    taken = _product(weights, sky.sky_spectrum.T).reshape(*shape, -1)
    kept, of_map = _compress(taken, sky.map_strength)
    sky_map = np.empty((*sky.sky_map.shape[:2], of_map.shape[1], 3), np.float32)
    over_rows(_combine, len(sky_map), sky.sky_map, of_map, sky_map)
    light = np.concatenate([sky.sun_irradiance[None], around[None] / np.pi, kept.T @ sky.sky_spectrum])
    group, terms = _groups(surfaces)
    mirrored = _product(terms.reshape(-1, terms.shape[-1]), _lit_by(weights, light))
    by_node = _by_node(mirrored, len(terms), *shape)
    path_grid = frame_grid(hits, _PATH_SPACING_RAD)
    looked_at = channels.sum(axis=0)
    mirrored_sky = mirrored_patches(sky, hits.look, looked_at)
    mean = float(around @ looked_at)
    off_mean = bounces @ looked_at / mean if mean > 0 else np.zeros(len(bounces))
    by_patch = _with_place(sky.irradiance_map @ of_sky, mirrored_sky)
    by_bounce = _with_place(of_bounce, np.zeros(len(bounces)), off_mean)
    to_probes = ToProbes((by_patch / 255).astype(np.float32), (BOUNCE_UNIT * by_bounce).astype(np.float32))
    light = Light(
        airmass_start=float(airmass[0]),
        airmass_step=float(airmass[1] - airmass[0]),
        lit=_by_node(lit, len(rho), *shape),
        mirrored=by_node,
        group=group,
        sky_map=sky_map,
        irradiance=by_patch.sum(axis=1).astype(np.float32),
        probes=np.zeros((0, 2 * by_patch.shape[2] + 2), np.float32),
        by_patch=to_probes.by_patch,
        of_patch=(sky.irradiance_map @ sky.sky_spectrum.sum(axis=1)).astype(np.float32),
        near_sun=near_sun(by_patch),
        followed=len(bounces) > 0,
        path=_path(hits, sky, path_grid, channels),
        grid=path_grid,
    )
    return light, to_probes


def _with_place(diffuse: Array, sky: Array, surfaces: Array | None = None) -> Array:
    """Diffuse components and, after them, the two of `diffuse`."""
    out = np.zeros((*diffuse.shape[:-1], diffuse.shape[-1] + PLACE_COMPONENTS))
    out[..., :-PLACE_COMPONENTS] = diffuse
    out[..., -2] = sky
    if surfaces is not None:
        out[..., -1] = surfaces
    return out


def near_sun(by_patch: Float[Array, "normal patch component"]) -> Float[Array, "normal 2 component"]:
    """Irradiance from the cap about the sun, and from the ring of quarters about that."""
    ring = by_patch[:, 1 : 1 + QUARTERS].sum(axis=1)
    return np.stack([by_patch[:, 0], ring], axis=1).astype(np.float32)


def base_spectra(materials: xr.Dataset, wavelength_um: Array) -> Float[Array, "row wavelength"]:
    """Reflectance of each material, then transmittance of each, on the sky's grid."""
    table = materials["wavelength"].values.astype(float)
    if wavelength_um[0] < table[0] - 1e-9 or wavelength_um[-1] > table[-1] + 1e-9:
        raise ValueError(
            f"`materials.reflectance` must cover {wavelength_um[0]:g} to {wavelength_um[-1]:g} µm, "
            f"got {table[0]:g} to {table[-1]:g} µm"
        )
    rows = materials["reflectance"].values.astype(float)
    through = materials["transmittance"].values if "transmittance" in materials else np.zeros_like(rows)
    both = np.concatenate([rows, through])
    low = np.clip(np.searchsorted(table, wavelength_um, side="right") - 1, 0, max(len(table) - 2, 0))
    high = np.minimum(low + 1, len(table) - 1)
    part = np.clip((wavelength_um - table[low]) / np.maximum(table[high] - table[low], 1e-12), 0, 1)
    return both[:, low] + part * (both[:, high] - both[:, low])


def _lit_by(weights: Array, lights: Array) -> Array:
    """(airmass channel, wavelength) × (light, wavelength) to (wavelength, light airmass channel)."""
    return (lights.T[:, :, None] * weights.T[:, None]).reshape(weights.shape[1], -1)


def _product(left: Array, right: Array) -> Array:
    """Matrix product by our own threads: those of a BLAS keep a core busy for a while after they are done."""
    out = np.zeros((len(left), right.shape[1]))
    operands = np.ascontiguousarray(left, dtype=float), np.ascontiguousarray(right, dtype=float)
    over_rows(_multiply, len(left), *operands, out, least=_LEAST_PRODUCTS // max(right.size, 1) + 1)
    return out


@nb.njit(nogil=True, cache=True, fastmath=True)
def _multiply(start, stop, left, right, out):
    for row in range(start, stop):
        for k in range(right.shape[0]):
            factor = left[row, k]
            for x in range(right.shape[1]):
                out[row, x] += factor * right[k, x]


@nb.njit(nogil=True, cache=True, fastmath=True)
def _combine(start, stop, disc, mix, out):
    """Combine the components of a map: ``mix`` has what each gives to each of the new ones."""
    for i in range(start, stop):
        for j in range(disc.shape[1]):
            for e in range(mix.shape[1]):
                for s in range(3):
                    total = 0.0
                    for k in range(mix.shape[0]):
                        total += disc[i, j, k, s] * mix[k, e]
                    out[i, j, e, s] = total


def _by_node(contracted: Array, rows: int, airmasses: int, channels: int) -> Array:
    """(row component, airmass channel) to (airmass, row, component, channel)."""
    split = contracted.reshape(rows, -1, airmasses, channels)
    return _filled(np.moveaxis(split, 2, 0))


def _filled(channels: Array) -> Array:
    """Single precision, channels filled up with zeros."""
    count = channels.shape[-1]
    width = count if count < LANES // 2 else -(-count // LANES) * LANES
    out = np.zeros((*channels.shape[:-1], width), np.float32)
    out[..., :count] = channels
    return out


def _transmittance(hits: Hits, sky: Sky) -> tuple[Array, Array]:
    """Airmass nodes over the frame, and the transmittance at each; one more row of ones for the sky."""
    up = hits.look[:, 2]
    highest = up.max(initial=-1.0)
    highest = highest if highest < 0 else up[up < 0].max(initial=-1.0)
    lowest = math.cos(float(sky.view_zenith_rad[-1]))
    steep = float(np.clip(-up.min(initial=-lowest), lowest, 1))
    flat = float(np.clip(-highest, lowest, steep))
    first, last = 1 / steep, max(1 / flat, 1 / steep + 1e-6)
    table_airmass = 1 / np.cos(sky.view_zenith_rad)
    depth = -np.log(np.maximum(sky.transmittance[:, 0], 1e-9)).max() * math.cos(sky.view_zenith_rad[0])
    count = int(np.clip(math.ceil((last - first) * depth / _DEPTH_STEP) + 1, 2, _MOST_NODES))
    airmass = np.linspace(first, last, count)
    logarithm = np.log(np.maximum(sky.transmittance, 1e-30))
    tau = np.exp(np.stack([np.interp(airmass, table_airmass, row) for row in logarithm], axis=1))
    return airmass, np.concatenate([tau, np.ones((1, tau.shape[1]))])


def standing_elements(count: int) -> Int[Array, "element"]:
    """Elements that stand for a frame of so many: the same with and without traffic."""
    return np.arange(0, count, max(count // _SURROUNDINGS_ELEMENTS, 1))


def _some_samples(hits: Hits) -> tuple[Int[Array, "sample"], Float[Array, "sample"]]:
    """Samples on surfaces that stand for the frame, and their weights."""
    some = samples_of(hits, standing_elements(hits.rows * hits.columns))
    some = some[hits.material[some] >= 0]
    return some, hits.weight[some].astype(float)


def _surroundings(hits: Hits, sky: Sky, rho: Array) -> Float[Array, "wavelength"]:
    """Mean light that leaves the surfaces in view, as the irradiance from below. [W m⁻² µm⁻¹]"""
    some, weight = _some_samples(hits)
    if len(some) == 0:
        return np.zeros(len(sky.wavelength_um))
    material, normal = hits.material[some], hits.normal[some].astype(float)
    sun = weight * np.maximum(normal @ sky.sun_direction, 0) * hits.sun_visible[some]
    above = weight * 0.5 * (1 + normal[:, 2]) * hits.sky_view[some]
    lit = [np.bincount(material, weights=w, minlength=len(rho)) / weight.sum() for w in (sun, above)]
    by_sun, by_sky = _product(np.stack(lit), rho)
    return by_sun * sky.sun_irradiance + by_sky * sky.sky_irradiance


def _bounce_spectra(
    hits: Hits, sky: Sky, classes: MaterialClasses, rho: Array
) -> Float[Array, "bounce wavelength"]:
    """Irradiance per unit of `Hits.probe_bounced`: spectra of the classes by the light they send on."""
    some, weight = _some_samples(hits)
    if len(some) == 0 or hits.probe_bounced.shape[1] == 0:
        return np.zeros((hits.probe_bounced.shape[1], len(sky.wavelength_um)))
    share = np.bincount(hits.material[some], weights=weight, minlength=len(rho) // 2) / weight.sum()
    sent_on = share @ (rho[: len(rho) // 2] + rho[len(rho) // 2 :])
    on = 1 / (1 - ENCLOSED * np.clip(sent_on, 0, 1))
    spectra, leaf = (_on_grid(x, classes.wavelength_um, sky) for x in (classes.spectra, classes.leaf[None]))
    met_again = 1 / (1 - MET_AGAIN * np.clip(leaf, 0, 1))
    among = 0.5 * leaf**2 * (met_again - on)
    among_by_sky = leaf * MET_AGAIN * (leaf * met_again - sent_on * on)
    twice = (spectra[:, None] * spectra[None, :SECOND]).reshape(-1, len(sky.wavelength_um))
    with_sun = _with_the_sun(sky)
    sun = sky.sun_irradiance + with_sun / max(float(sky.sun_direction[2]), _LOWEST_SUN)
    rest = sky.sky_irradiance - with_sun
    by_sky = np.concatenate([spectra, spectra * sent_on * on]) * rest
    return np.concatenate([spectra * sun, by_sky, twice * on * sun, among * sun, among_by_sky * rest])


def _with_the_sun(sky: Sky) -> Float[Array, "wavelength"]:
    """Skylight on level ground that comes and goes with the sun: of the cap and of the ring about it."""
    by_patch = sky.irradiance_map[LEVEL_NODE : LEVEL_NODE + 1] @ sky.sky_spectrum
    level = by_patch[0].sum(axis=0)
    cap, ring = near_sun(by_patch)[0].astype(float)
    part = np.divide(CAP_LOST * cap + RING_LOST * ring, level, out=np.zeros_like(level), where=level > 0)
    return part * sky.sky_irradiance


def _on_grid(rows: Array, table_um: Array, sky: Sky) -> Array:
    """Spectra on the sky's wavelengths, linear between their own."""
    return np.stack([np.interp(sky.wavelength_um, table_um, row) for row in rows])


def _compress(weights: Array, size: Array, least: float = _SKY_KEPT) -> tuple[Array, Array]:
    """Fewest combinations of components that give the same light in these channels.

    Parameters
    ----------
    weights
        (..., component): what each channel takes of each component.
    size
        Greatest absolute value of each component's map.
    least
        The light of all together is kept to this part.

    Returns
    -------
    For each combination r, what of each component goes into its spectrum, and what into its map (component,
    r each).
    """
    size = np.where(size > 0, size, 1.0)
    taken = weights.reshape(-1, weights.shape[-1]) * size
    strength, turned = np.linalg.eigh(_product(taken.T, taken))
    turned = turned[:, ::-1][:, : max(int((strength > least**2 * strength[-1]).sum()), 1)]
    return turned * size[:, None], turned / size[:, None]


def _groups(surfaces: MaterialTables) -> tuple[Int[Array, "optics"], Float[Array, "group term wavelength"]]:
    """Optical classes that share their Fresnel terms' spectra; group 0 has no dispersion."""
    spectra = [np.zeros_like(surfaces.dispersion[0])]
    spectra[0][0] = 1.0
    group = np.zeros(len(surfaces.terms), np.int64)
    known = {spectra[0].tobytes(): 0}
    for optical, own in enumerate(surfaces.dispersion):
        key = own.tobytes()
        if key not in known:
            known[key] = len(spectra)
            spectra.append(own)
        group[optical] = known[key]
    return group, np.stack(spectra)[:, : int(surfaces.terms.max(initial=1))]


def _path(hits: Hits, sky: Sky, grid: FrameGrid, channels: Array) -> Array:
    """Path radiance (row, column, 3, channel) at the nodes of a frame."""
    look = grid.direction.reshape(-1, 3).copy()
    look[:, 2] = np.minimum(look[:, 2], -1e-9)  # above the horizon there is no path: hold the horizon's
    components, north = look_up_all(sky.path_map, look)
    by_stokes = np.moveaxis(components, 1, 2).reshape(-1, components.shape[1])
    light = _product(by_stokes, _product(sky.path_spectrum, channels.T)).reshape(len(look), 3, -1)
    turn = frame_angle(north, np.broadcast_to(hits.detector_axis, look.shape), -look)
    turned = rotate(np.moveaxis(light, 1, 2), turn[:, None])
    return _filled(np.moveaxis(turned, 1, 2)).reshape(*grid.direction.shape, -1)
