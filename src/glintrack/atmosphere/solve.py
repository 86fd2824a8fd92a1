"""The radiative transfer itself: sasktran2 set up for one atmosphere, asked for sky, path, ground.

Importing this module loads sasktran2; `tables` therefore runs it in a process of its own (`worker`), with
OpenBLAS held to one thread, which halves the time.

sasktran2's Q is ours (`meridian`) and its relative azimuth, measured from the sun, is ours clockwise: the
light seen when looking at the azimuth (sun's azimuth + a) is its (I, Q, U) at a. Pinned by the published
Coulson/Natraj rows and by the adding-doubling oracle in the tests.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import sasktran2 as sk
from jaxtyping import Float

from glintrack.atmosphere.gas import EARTH_RADIUS_M
from glintrack.core.arrays import Array

NEAR_VERTICAL = 0.99999
"""Largest |cos zenith| asked of the solver: at 1 its exact single scatter has wrong Q, U (0.26° off)."""
GROUND_OBSERVER_M = 1.0
"""Height from which the light leaving the ground is looked at. [m]"""
TRIAL_ALBEDOS = (0.3, 0.9)
PROBE_STREAMS = 8  # irradiances and ratios need no more, and cost a sixth
MOMENTS = 64  # of the phase matrix in exact single scatter: as fine as a 3° sky map can carry
CHUNK = 8  # wavelengths a call: bounds the memory, gives progress its steps


@dataclass(frozen=True)
class Medium:
    """Optical properties of an atmosphere at its levels and wavelengths, and what lies under it.

    Parameters
    ----------
    height_m
        Levels, from 0 upward. [m]
    wavelength_um
        [µm]
    rayleigh
        Whether air scatters (US standard atmosphere 1976).
    aerosol_extinction
        Shape (level, wavelength). [m⁻¹]
    aerosol_albedo
        Single-scattering albedo, shape (wavelength,). [1]
    aerosol_moments
        Phase matrix, shape (wavelength, 4, moment), see `aerosol.AerosolOptics`. [1]
    gas_absorption
        Shape (level, wavelength). [m⁻¹]
    """

    height_m: Float[Array, "level"]
    wavelength_um: Float[Array, "wavelength"]
    rayleigh: bool
    aerosol_extinction: Float[Array, "level wavelength"]
    aerosol_albedo: Float[Array, "wavelength"]
    aerosol_moments: Float[Array, "wavelength 4 moment"]
    gas_absorption: Float[Array, "level wavelength"]


@dataclass(frozen=True)
class Directions:
    """Where to look: angles from the zenith (sky) and from the nadir (path), azimuth from the sun. [rad]"""

    cos_sun_zenith: float
    zenith: Float[Array, "zenith"]
    view_zenith: Float[Array, "view_zenith"]
    azimuth: Float[Array, "azimuth"]
    altitude_m: Float[Array, "altitude"]


@dataclass(frozen=True)
class GroundLight:
    """What a Lambertian ground makes of one medium, for unit solar irradiance; exact for any albedo.

    Parameters
    ----------
    dark_irradiance
        Sun and sky on level black ground, shape (wavelength,). [1]
    spherical_albedo
        Share of the ground's light that the atmosphere returns, shape (wavelength,). [1]
    dark_upward
        Light toward the sensor over black ground at the sun's azimuth, (wavelength, altitude,
        view_zenith, stokes). [sr⁻¹]
    gain
        What reaches the sensor of light that leaves the whole ground, directly and scattered, same shape.
        [1]
    """

    dark_irradiance: Float[Array, "wavelength"]
    spherical_albedo: Float[Array, "wavelength"]
    dark_upward: Float[Array, "wavelength altitude view_zenith 3"]
    gain: Float[Array, "wavelength altitude view_zenith 3"]

    def irradiance(self, albedo: float) -> Float[Array, "wavelength"]:
        """On level ground of some albedo, sun and sky, over the solar irradiance. [1]"""
        return self.dark_irradiance / (1 - albedo * self.spherical_albedo)


@dataclass(frozen=True)
class Fields:
    """What the solver gives for unit solar irradiance above the atmosphere, per wavelength.

    Parameters
    ----------
    sky
        Diffuse light at the ground, (wavelength, zenith, azimuth, stokes), azimuth from the sun. [sr⁻¹]
    upward
        Light toward the sensor, the ground's own included, (wavelength, altitude, view_zenith, azimuth,
        stokes). [sr⁻¹]
    emitted
        Radiance leaving the ground in that solve, (wavelength,). [sr⁻¹]
    scattering_extinction
        Air and aerosol, (level, wavelength). [m⁻¹]
    """

    sky: Float[Array, "wavelength zenith azimuth 3"]
    upward: Float[Array, "wavelength altitude view_zenith azimuth 3"]
    emitted: Float[Array, "wavelength"]
    scattering_extinction: Float[Array, "level wavelength"]


def solve_fields(
    medium: Medium,
    directions: Directions,
    ground_albedo: float,
    streams: int = 16,
    threads: int = 1,
    progress: Callable[[float], None] | None = None,
) -> Fields:
    """Solve one atmosphere for its sky and its path.

    Parameters
    ----------
    medium, directions
        What is there and where to look. What gases absorb is solved in: exact for lines that do not saturate.
    ground_albedo
        Lambertian. [1]
    streams
        Discrete ordinates over the full sphere.
    threads
        Of the solver, over wavelengths.
    progress
        Called with the finished fraction.
    """
    config = _config(streams, threads)
    geometry = _geometry(directions.cos_sun_zenith, medium.height_m)
    engine = sk.Engine(config, geometry, _all_rays(directions))
    light, extinction = [], []
    for chunk in _chunks(medium, progress):
        air = _atmosphere(medium, chunk, geometry, config)
        light.append(_radiance(engine, air, ground_albedo))
        # the storage itself holds the delta-M scaled extinction once solved
        extinction.append(np.array(air.unscaled_extinction, copy=True))
    sky, upward, emitted = _sort_rays(np.concatenate(light), directions)
    return Fields(sky, upward, emitted, np.concatenate(extinction, axis=1) - medium.gas_absorption)


def solve_ground(
    medium: Medium,
    directions: Directions,
    streams: int = 16,
    threads: int = 1,
    progress: Callable[[float], None] | None = None,
) -> GroundLight:
    """What a Lambertian ground makes of one atmosphere; parameters as `solve_fields`."""
    config = _config(min(PROBE_STREAMS, streams), threads)
    geometry = _geometry(directions.cos_sun_zenith, medium.height_m)
    engine = sk.Engine(config, geometry, _probe_rays(directions))
    probed = []
    for chunk in _chunks(medium, progress):
        air = _atmosphere(medium, chunk, geometry, config)
        probed.append([_radiance(engine, air, albedo) for albedo in TRIAL_ALBEDOS])
    return _ground_light(np.concatenate(probed, axis=1), directions)


def _chunks(medium: Medium, progress: Callable[[float], None] | None) -> Iterator[slice]:
    """Parts of the wavelengths, progress told after each."""
    for first in range(0, medium.wavelength_um.size, CHUNK):
        yield slice(first, first + CHUNK)
        if progress is not None:
            progress(min(1.0, (first + CHUNK) / medium.wavelength_um.size))


def _sort_rays(light: Array, d: Directions) -> tuple[Array, Array, Array]:
    """Sky, upward and ground light out of the order of `_all_rays`."""
    bands, zeniths, azimuths, views = light.shape[0], d.zenith.size, d.azimuth.size, d.view_zenith.size
    sky = light[:, : zeniths * azimuths].reshape(bands, zeniths, azimuths, 3)
    upward = light[:, zeniths * azimuths : -1].reshape(bands, d.altitude_m.size, views, azimuths, 3)
    return sky, upward, light[:, -1, 0]


def _ground_light(probed: Float[Array, "2 wavelength ray 3"], d: Directions) -> GroundLight:
    """Separate the ground from the atmosphere by two albedos a: E(a) = E(0)/(1 − a s)."""
    low, high = TRIAL_ALBEDOS
    emitted = probed[:, :, 0, 0]
    ratio = (emitted[1] / high) / (emitted[0] / low)
    returned = (ratio - 1) / (ratio * high - low)
    dark = np.pi * emitted[0] / low * (1 - low * returned)
    gain = (probed[1, :, 1:] - probed[0, :, 1:]) / (emitted[1] - emitted[0])[:, None, None]
    black = probed[0, :, 1:] - gain * emitted[0][:, None, None]
    shape = (dark.size, d.altitude_m.size, d.view_zenith.size, 3)
    return GroundLight(dark, np.clip(returned, 0, 1), black.reshape(shape), gain.reshape(shape))


def _config(streams: int, threads: int) -> sk.Config:
    config = sk.Config()
    config.num_stokes = 3
    config.num_streams = streams
    config.num_threads = threads
    config.num_singlescatter_moments = MOMENTS
    config.multiple_scatter_source = sk.MultipleScatterSource.DiscreteOrdinates
    config.single_scatter_source = sk.SingleScatterSource.Exact
    config.delta_m_scaling = True
    config.log_level = sk.LogLevel.Off
    return config


def _geometry(cos_sun: float, height_m: Array) -> sk.Geometry1D:
    linear = sk.InterpolationMethod.LinearInterpolation
    return sk.Geometry1D(cos_sun, 0.0, EARTH_RADIUS_M, height_m, linear, sk.GeometryType.Spherical)


def _all_rays(d: Directions) -> sk.ViewingGeometry:
    """Sky rays from the ground, path rays from every altitude, one ray from just above the ground."""
    rays = sk.ViewingGeometry()
    for zenith in d.zenith:
        for azimuth in d.azimuth:
            up = min(np.cos(zenith), NEAR_VERTICAL)
            rays.add_ray(sk.SolarAnglesObserverLocation(d.cos_sun_zenith, azimuth, up, 0.0))
    for altitude in d.altitude_m:
        for view in d.view_zenith:
            for azimuth in d.azimuth:
                down = min(np.cos(view), NEAR_VERTICAL)
                rays.add_ray(sk.GroundViewingSolar(d.cos_sun_zenith, azimuth, down, altitude))
    rays.add_ray(sk.GroundViewingSolar(d.cos_sun_zenith, 0.0, NEAR_VERTICAL, GROUND_OBSERVER_M))
    return rays


def _probe_rays(d: Directions) -> sk.ViewingGeometry:
    """One ray from just above the ground, then the path rays at one azimuth."""
    rays = sk.ViewingGeometry()
    rays.add_ray(sk.GroundViewingSolar(d.cos_sun_zenith, 0.0, NEAR_VERTICAL, GROUND_OBSERVER_M))
    for altitude in d.altitude_m:
        for view in d.view_zenith:
            down = min(np.cos(view), NEAR_VERTICAL)
            rays.add_ray(sk.GroundViewingSolar(d.cos_sun_zenith, 0.0, down, altitude))
    return rays


def _atmosphere(medium: Medium, chunk: slice, geometry: sk.Geometry1D, config: sk.Config) -> sk.Atmosphere:
    air = sk.Atmosphere(
        geometry, config, calculate_derivatives=False, wavelengths_nm=medium.wavelength_um[chunk] * 1e3
    )
    sk.climatology.us76.add_us76_standard_atmosphere(air)
    if medium.rayleigh:
        air["air"] = sk.constituent.Rayleigh()
    extinction = medium.aerosol_extinction[:, chunk]
    if np.any(extinction > 0):
        levels, bands = extinction.shape
        albedo = np.broadcast_to(medium.aerosol_albedo[chunk], (levels, bands)).copy()
        by_moment = medium.aerosol_moments[chunk].transpose(2, 1, 0)  # moment, coefficient, wavelength
        flat = by_moment.reshape(-1, 1, bands)
        moments = np.repeat(flat, levels, axis=1)
        air["aerosol"] = sk.constituent.Manual(extinction, albedo, moments)
    gas = medium.gas_absorption[:, chunk]
    if np.any(gas > 0):
        air["gas"] = sk.constituent.Manual(gas.copy(), np.zeros_like(gas))
    return air


def _radiance(engine: sk.Engine, air: sk.Atmosphere, albedo: float) -> Float[Array, "wavelength ray 3"]:
    air["ground"] = sk.constituent.LambertianSurface(albedo)
    return engine.calculate_radiance(air)["radiance"].values
