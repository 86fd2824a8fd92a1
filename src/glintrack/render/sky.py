"""The atmosphere's tables unpacked for the shading kernel, at one sensor altitude.

Angular maps come over (polar angle, azimuth) in the ``meridian`` frame, whose axis spins about the zenith and
the nadir. They are resampled once to a stereographic disc, with Q and U turned to an axis that is smooth
there: north carried along the great circle from the zenith (sky) or the nadir (path) to the ray. A look-up
then needs no trigonometry and has no pole.
"""

from dataclasses import dataclass
from functools import cached_property

import numba as nb
import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.atmosphere import interpolate_map
from glintrack.core.arrays import Array
from glintrack.render.shading.normals import node_normals
from glintrack.render.sky_patches import PATCHES, patch_of

_DISC_CELLS = 128  # 0.9° to 1.8° a cell, finer than the tables' 3° × 5°


@dataclass(frozen=True)
class Sky:
    """What `shade` needs of the atmosphere, at one sensor altitude.

    Parameters
    ----------
    wavelength_um
        Of every spectrum below. [µm]
    sun_direction
        Unit vector toward the sun, ENU. [1]
    sun_irradiance
        Direct, normal to the beam, at the ground. [W m⁻² µm⁻¹]
    sky_irradiance
        Diffuse on level ground. [W m⁻² µm⁻¹]
    sky_spectrum, sky_map
        Sky radiance = Σ spectrum × map. [W m⁻² sr⁻¹ µm⁻¹, 1]
    irradiance_map
        Of facets in the open, over the nodes of `normals.node_normals`, from each patch of the sky
        (`sky_patches`): Σ spectrum × map is their irradiance from the part of it in front of them; the sum
        over the patches is ``sky_irradiance`` on level ground.
    path_spectrum, path_map
        Path radiance likewise, what gases leave of it in the spectrum; its disc is centred on the nadir.
    transmittance
        From ground to sensor. [1]
    view_zenith_rad
        Of the transmittance; from the nadir. [rad]
    """

    wavelength_um: Float[Array, "wavelength"]
    sun_direction: Float[Array, "3"]
    sun_irradiance: Float[Array, "wavelength"]
    sky_irradiance: Float[Array, "wavelength"]
    sky_spectrum: Float[Array, "sky_component wavelength"]
    sky_map: Float[Array, "disc disc sky_component 3"]
    irradiance_map: Float[Array, "normal patch sky_component"]
    path_spectrum: Float[Array, "path_component wavelength"]
    path_map: Float[Array, "disc disc path_component 3"]
    transmittance: Float[Array, "wavelength view_zenith"]
    view_zenith_rad: Float[Array, "view_zenith"]

    @cached_property
    def map_strength(self) -> Float[Array, "sky_component"]:
        """Greatest absolute value of each component of ``sky_map``. [1]"""
        return np.abs(self.sky_map).max(axis=(0, 1, 3))


def unpack_sky(tables: xr.Dataset, altitude_m: float) -> Sky:
    """Unpack a dataset of schema ``atmosphere`` once, at the altitude of the sensor.

    Parameters
    ----------
    tables
        From `glintrack.atmosphere.solve_tables`.
    altitude_m
        Of the sensor above the ground; must lie within the tables. [m]
    """
    altitudes = tables["altitude"].values.astype(float)
    if not altitudes[0] - 1e-6 <= altitude_m <= altitudes[-1] + 1e-6:
        raise ValueError(
            f"`altitude_m` must lie within the atmosphere's tables, {altitudes[0]:g} to {altitudes[-1]:g} m, "
            f"got {altitude_m:g} (see atmosphere.altitudes_m)"
        )
    above = int(np.clip(np.searchsorted(altitudes, altitude_m), 1, max(len(altitudes) - 1, 1)))
    if len(altitudes) == 1:
        low, high, part = 0, 0, 0.0
    else:
        low, high = above - 1, above
        part = float((altitude_m - altitudes[low]) / (altitudes[high] - altitudes[low]))

    def at_altitude(name: str) -> Array:
        values = tables[name].transpose(*_LEADING[name], ...).values.astype(float)
        return (1 - part) * values[:, low] + part * values[:, high]

    zenith, azimuth = float(tables.attrs["sun_zenith_rad"]), float(tables.attrs["sun_azimuth_rad"])
    across = np.sin(zenith)
    view_zenith = tables["view_zenith"].values.astype(float)
    sky_map = _on_disc(tables["sky_map"].values, tables["zenith"].values, tables["azimuth"].values, "up")
    sun = np.array([across * np.sin(azimuth), across * np.cos(azimuth), np.cos(zenith)])
    return Sky(
        tables["wavelength"].values.astype(float),
        sun,
        tables["sun_irradiance"].values.astype(float),
        tables["sky_irradiance"].values.astype(float),
        tables["sky_spectrum"].values.astype(float),
        sky_map,
        _irradiance_map(sky_map, sun),
        tables["path_spectrum"].values.astype(float) * at_altitude("path_gas"),
        _on_disc(at_altitude("path_map"), view_zenith, tables["azimuth"].values, "down"),
        at_altitude("transmittance"),
        view_zenith,
    )


_LEADING = {
    "path_map": ("path_component", "altitude"),
    "path_gas": ("wavelength", "altitude"),
    "transmittance": ("wavelength", "altitude"),
}


def _on_disc(meridian: Array, polar_rad: Array, azimuth_rad: Array, looking: str) -> Array:
    """(component, polar, azimuth, 3) in `meridian` to the disc (east, north, component, 3), smooth frame."""
    cells = np.linspace(-1.0, 1.0, _DISC_CELLS)
    x, y = np.meshgrid(cells, cells, indexing="ij")
    polar, azimuth = 2 * np.arctan(np.hypot(x, y)), np.arctan2(x, y)
    return np.ascontiguousarray(interpolate_map(meridian, polar_rad, azimuth_rad, polar, azimuth, looking))


def _irradiance_map(sky_map: Array, sun: Array) -> Array:
    """∫ I cos θ dω over each patch of the sky in front of facets with the normals of `node_normals`."""
    heights, weights = np.polynomial.legendre.leggauss(32)
    heights, weights = 0.5 * (heights + 1), 0.5 * weights
    turns = (np.arange(64) + 0.5) * 2 * np.pi / 64
    z, azimuth = np.meshgrid(heights, turns, indexing="ij")
    across = np.sqrt(1 - z * z)
    directions = np.stack([across * np.sin(azimuth), across * np.cos(azimuth), z], axis=-1).reshape(-1, 3)
    radiance, _ = look_up_all(sky_map, directions)
    light = radiance[..., 0] * np.repeat(weights * 2 * np.pi / 64, 64)[:, None]
    cosine, patch = np.maximum(node_normals() @ directions.T, 0), patch_of(directions, sun)
    return np.stack([cosine[:, patch == b] @ light[patch == b] for b in range(PATCHES)], axis=1)


@nb.njit(cache=True, fastmath={"contract", "reassoc", "arcp", "nsz"}, forceinline=True)
def look_up(disc, rx, ry, rz, out):
    """Bilinear (component, 3) of a disc map in direction r; beyond the horizon the horizon's value."""
    scale = 1.0 / (1.0 + abs(rz))
    last = disc.shape[0] - 1
    x = min(max((rx * scale + 1.0) * 0.5 * last, 0.0), last - 1e-6)
    y = min(max((ry * scale + 1.0) * 0.5 * last, 0.0), last - 1e-6)
    i, j = int(x), int(y)
    fx, fy = np.float32(x - i), np.float32(y - j)
    w11 = fx * fy
    w10, w01 = fx - w11, fy - w11
    w00 = np.float32(1.0) - w10 - w01 - w11
    for k in range(disc.shape[2]):
        for s in range(3):
            out[k, s] = (
                w00 * disc[i, j, k, s]
                + w01 * disc[i, j + 1, k, s]
                + w10 * disc[i + 1, j, k, s]
                + w11 * disc[i + 1, j + 1, k, s]
            )


@nb.njit(cache=True)
def carried_north(rx, ry, rz):
    """North carried along the great circle from the zenith (rz ≥ 0) or the nadir (rz < 0) to direction r."""
    if rz >= 0:
        g = ry / (1.0 + rz)
        return -g * rx, 1.0 - g * ry, -g * (rz + 1.0)
    g = ry / (1.0 - rz)
    return -g * rx, 1.0 - g * ry, -g * (rz - 1.0)


@nb.njit(cache=True)
def look_up_all(disc, directions):
    """(direction, component, 3) of a disc map, and the axis of each (`carried_north`)."""
    out = np.empty((directions.shape[0], disc.shape[2], 3))
    north = np.empty((directions.shape[0], 3))
    for i in range(directions.shape[0]):
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        look_up(disc, x, y, z, out[i])
        north[i, 0], north[i, 1], north[i, 2] = carried_north(x, y, z)
    return out, north
