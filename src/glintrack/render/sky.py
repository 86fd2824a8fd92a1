"""The atmosphere's tables unpacked for the shading kernel, at one sensor altitude.

Angular maps come in the ``meridian`` frame, whose axis spins about the zenith and the nadir. Before a map is
interpolated its Q and U are turned to an axis that is smooth there: north carried along the great circle
from the zenith (sky) or the nadir (path) to the ray.
"""

from dataclasses import dataclass

import numba as nb
import numpy as np
import xarray as xr
from jaxtyping import Float

from ..stokes import rotate

Array = np.ndarray


@dataclass(frozen=True)
class AngularMap:
    """Stokes components on an even (polar angle, azimuth) grid, in the smooth frame.

    Parameters
    ----------
    values
        (polar, azimuth + 1, component, 3): the last azimuth repeats the first.
    polar_step_rad, azimuth_start_rad, azimuth_step_rad
        Spacing of the grid; polar angles start at 0, azimuths are clockwise from north. [rad]
    """

    values: Float[Array, "polar azimuth component 3"]
    polar_step_rad: float
    azimuth_start_rad: float
    azimuth_step_rad: float


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
    path_spectrum, path_map
        Path radiance likewise; its polar angle is from the nadir.
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
    sky_map: AngularMap
    path_spectrum: Float[Array, "path_component wavelength"]
    path_map: AngularMap
    transmittance: Float[Array, "wavelength view_zenith"]
    view_zenith_rad: Float[Array, "view_zenith"]


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
    return Sky(
        tables["wavelength"].values.astype(float),
        np.array([across * np.sin(azimuth), across * np.cos(azimuth), np.cos(zenith)]),
        tables["sun_irradiance"].values.astype(float),
        tables["sky_irradiance"].values.astype(float),
        tables["sky_spectrum"].values.astype(float),
        _smooth_map(tables["sky_map"].values, tables["zenith"].values, tables["azimuth"].values, -1.0),
        tables["path_spectrum"].values.astype(float),
        _smooth_map(at_altitude("path_map"), view_zenith, tables["azimuth"].values, +1.0),
        at_altitude("transmittance"),
        view_zenith,
    )


_LEADING = {"path_map": ("path_component", "altitude"), "transmittance": ("wavelength", "altitude")}


def _smooth_map(meridian: Array, polar_rad: Array, azimuth_rad: Array, sense: float) -> AngularMap:
    """(component, polar, azimuth, 3) in `meridian` to the smooth frame on an even polar grid.

    The meridian axis at azimuth φ lies φ clockwise from carried north as seen from below looking up at the
    zenith (``sense`` −1), and φ counter-clockwise looking down at the nadir (+1).
    """
    turned = rotate(meridian, sense * np.asarray(azimuth_rad, dtype=float))
    even = np.linspace(0.0, float(polar_rad[-1]), max(len(polar_rad), 2 * len(polar_rad)))
    position = np.interp(even, polar_rad, np.arange(len(polar_rad)))
    low = np.minimum(position.astype(int), len(polar_rad) - 2)
    part = (position - low)[None, :, None, None]
    resampled = (1 - part) * turned[:, low] + part * turned[:, low + 1]
    closed = np.concatenate([resampled, resampled[:, :, :1]], axis=2)
    step = float(azimuth_rad[1] - azimuth_rad[0])
    return AngularMap(
        np.ascontiguousarray(np.moveaxis(closed, 0, 2)), float(even[1]), float(azimuth_rad[0]), step
    )


@nb.njit(cache=True)
def look_up(values, polar_step, azimuth_start, azimuth_step, polar, azimuth, out):
    """Bilinear (component, 3) of an angular map at one direction; polar angles beyond its end are clamped."""
    y = min(polar / polar_step, values.shape[0] - 1.000001)
    turn = 2.0 * np.pi
    x = ((azimuth - azimuth_start) % turn) / azimuth_step
    i, j = int(y), min(int(x), values.shape[1] - 2)
    fy, fx = y - i, x - j
    w00, w01, w10, w11 = (1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx
    for k in range(values.shape[2]):
        for s in range(3):
            out[k, s] = (
                w00 * values[i, j, k, s]
                + w01 * values[i, j + 1, k, s]
                + w10 * values[i + 1, j, k, s]
                + w11 * values[i + 1, j + 1, k, s]
            )


@nb.njit(cache=True)
def carried_north(rx, ry, rz):
    """North carried along the great circle from the zenith (rz ≥ 0) or the nadir (rz < 0) to direction r."""
    if rz >= 0:
        g = ry / (1.0 + rz)
        return -g * rx, 1.0 - g * ry, -g * (rz + 1.0)
    g = ry / (1.0 - rz)
    return -g * rx, 1.0 - g * ry, -g * (rz - 1.0)
