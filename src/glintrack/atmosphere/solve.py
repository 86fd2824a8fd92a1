"""Radiative transfer with sasktran2: sky, path and ground of one atmosphere, and a plain Rayleigh slab.

`tables` runs it in a separate process with OpenBLAS limited to one thread, which halves the time.

sasktran2's Q is ours (`meridian`) and its relative azimuth, measured from the sun, is ours clockwise: the
light seen when looking at the azimuth (sun's azimuth + a) is its (I, Q, U) at a. Pinned by the published
Coulson/Natraj rows and by the adding-doubling oracle in the tests.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import sasktran2 as sk
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from glintrack.core.arrays import Array
from glintrack.core.schema import EARTH_RADIUS_M

NEAR_VERTICAL = 0.99999
"""Largest |cos zenith| passed to the solver: at 1 its exact single scatter has wrong Q, U (0.26° off)."""
GROUND_OBSERVER_M = 1.0
"""Height of the observer of the light that leaves the ground. [m]"""
TRIAL_ALBEDOS = (0.3, 0.9)
PROBE_STREAMS = 8  # irradiances and ratios need no more, and cost a sixth
MOMENTS = 64  # of the phase matrix in exact single scatter: as fine as a 3° sky map can carry
CHUNK = 8  # wavelengths a call: bounds the memory, gives progress its steps
_SLAB_M = 1000.0  # height of the Rayleigh slab


@dataclass(frozen=True)
class Particles:
    """Scattering by one kind of particles.

    Parameters
    ----------
    extinction
        Shape (level, wavelength). [m⁻¹]
    albedo
        Single-scattering albedo, shape (wavelength,). [1]
    moments
        Phase matrix, shape (wavelength, 4, moment), see `aerosol.AerosolOptics`. [1]
    """

    extinction: Float[Array, "level wavelength"]
    albedo: Float[Array, "wavelength"]
    moments: Float[Array, "wavelength 4 moment"]

    def at(self, bands: Int[Array, "band"] | slice) -> Self:
        """Select some of the wavelengths."""
        return replace(
            self, extinction=self.extinction[:, bands], albedo=self.albedo[bands], moments=self.moments[bands]
        )


@dataclass(frozen=True)
class Medium:
    """Optical properties of an atmosphere at its levels and wavelengths.

    Parameters
    ----------
    height_m
        Levels, from 0 upward. [m]
    rayleigh
        Whether air scatters (US standard atmosphere 1976).
    particles
        Aerosol and cloud droplets, by name.
    gas_absorption
        Shape (level, wavelength). [m⁻¹]
    """

    height_m: Float[Array, "level"]
    wavelength_um: Float[Array, "wavelength"]
    rayleigh: bool
    particles: Mapping[str, Particles]
    gas_absorption: Float[Array, "level wavelength"]


@dataclass(frozen=True)
class Directions:
    """Directions of look: angles from the zenith (sky) and the nadir (path), azimuth from the sun. [rad]"""

    cos_sun_zenith: float
    zenith: Float[Array, "zenith"]
    view_zenith: Float[Array, "view_zenith"]
    azimuth: Float[Array, "azimuth"]
    altitude_m: Float[Array, "altitude"]


@dataclass(frozen=True)
class GroundLight:
    """Effect of a Lambertian ground below one medium, for unit solar irradiance; exact for any albedo.

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
        Share of the light from the whole ground that reaches the sensor, directly and scattered, same
        shape. [1]
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
    """Solved fields for unit solar irradiance above the atmosphere, per wavelength.

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
        Air, aerosol and cloud, (level, wavelength). [m⁻¹]
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
        The atmosphere and the directions of look. Gas absorption is included: exact for lines that do not
        saturate.
    ground_albedo
        Lambertian. [1]
    streams
        Discrete ordinates over the full sphere.
    threads
        Threads of the solver, over wavelengths.
    progress
        Called with the finished fraction.
    """
    d, rays = directions, sk.ViewingGeometry()
    for zenith in d.zenith:
        for azimuth in d.azimuth:
            up = min(np.cos(zenith), NEAR_VERTICAL)
            rays.add_ray(sk.SolarAnglesObserverLocation(d.cos_sun_zenith, azimuth, up, 0.0))
    _add_path_rays(rays, d, d.azimuth)
    rays.add_ray(sk.GroundViewingSolar(d.cos_sun_zenith, 0.0, NEAR_VERTICAL, GROUND_OBSERVER_M))
    light, extinction = _solve(medium, d, rays, (ground_albedo,), streams, threads, progress)
    count = d.zenith.size * d.azimuth.size
    sky = light[0, :, :count].reshape(-1, d.zenith.size, d.azimuth.size, 3)
    upward = light[0, :, count:-1].reshape(-1, d.altitude_m.size, d.view_zenith.size, d.azimuth.size, 3)
    return Fields(sky, upward, light[0, :, -1, 0], extinction - medium.gas_absorption)


def solve_ground(
    medium: Medium,
    directions: Directions,
    streams: int = 16,
    threads: int = 1,
    progress: Callable[[float], None] | None = None,
) -> GroundLight:
    """Solve one atmosphere for the effects of a Lambertian ground; parameters as `solve_fields`.

    Two albedos a separate the ground from the atmosphere: E(a) = E(0)/(1 − a s).
    """
    d, rays = directions, sk.ViewingGeometry()
    rays.add_ray(sk.GroundViewingSolar(d.cos_sun_zenith, 0.0, NEAR_VERTICAL, GROUND_OBSERVER_M))
    _add_path_rays(rays, d, (0.0,))
    probed, _ = _solve(medium, d, rays, TRIAL_ALBEDOS, min(PROBE_STREAMS, streams), threads, progress)
    low, high = TRIAL_ALBEDOS
    emitted = probed[:, :, 0, 0]
    ratio = (emitted[1] / high) / (emitted[0] / low)
    returned = (ratio - 1) / (ratio * high - low)
    dark = np.pi * emitted[0] / low * (1 - low * returned)
    gain = (probed[1, :, 1:] - probed[0, :, 1:]) / (emitted[1] - emitted[0])[:, None, None]
    black = probed[0, :, 1:] - gain * emitted[0][:, None, None]
    shape = (dark.size, d.altitude_m.size, d.view_zenith.size, 3)
    return GroundLight(dark, np.clip(returned, 0, 1), black.reshape(shape), gain.reshape(shape))


def _add_path_rays(rays: sk.ViewingGeometry, d: Directions, azimuths: Iterable[float]) -> None:
    for altitude in d.altitude_m:
        for view in d.view_zenith:
            for azimuth in azimuths:
                down = min(np.cos(view), NEAR_VERTICAL)
                rays.add_ray(sk.GroundViewingSolar(d.cos_sun_zenith, azimuth, down, altitude))


def _solve(
    medium: Medium,
    d: Directions,
    rays: sk.ViewingGeometry,
    albedos: tuple[float, ...],
    streams: int,
    threads: int,
    progress: Callable[[float], None] | None,
) -> tuple[Float[Array, "albedo wavelength ray 3"], Float[Array, "level wavelength"]]:
    """Radiance along rays over each albedo, and extinction of the medium."""
    config = _config(streams, MOMENTS, sk.SingleScatterSource.Exact)
    config.num_threads, config.delta_m_scaling = threads, True
    linear = sk.InterpolationMethod.LinearInterpolation
    geometry = sk.Geometry1D(
        d.cos_sun_zenith, 0.0, EARTH_RADIUS_M, medium.height_m, linear, sk.GeometryType.Spherical
    )
    engine, light, extinction = sk.Engine(config, geometry, rays), [], []
    for first in range(0, medium.wavelength_um.size, CHUNK):
        air = _atmosphere(medium, slice(first, first + CHUNK), geometry, config)
        part = []
        for albedo in albedos:
            air["ground"] = sk.constituent.LambertianSurface(albedo)
            part.append(engine.calculate_radiance(air)["radiance"].values)
        light.append(part)
        # after a solve the storage contains the delta-M scaled extinction
        extinction.append(np.array(air.unscaled_extinction, copy=True))
        if progress is not None:
            progress(min(1.0, (first + CHUNK) / medium.wavelength_um.size))
    return np.concatenate(light, axis=1), np.concatenate(extinction, axis=1)


def _config(streams: int, moments: int, single_scatter: sk.SingleScatterSource) -> sk.Config:
    config = sk.Config()
    config.num_stokes, config.num_streams, config.num_singlescatter_moments = 3, streams, moments
    config.multiple_scatter_source = sk.MultipleScatterSource.DiscreteOrdinates
    config.single_scatter_source = single_scatter
    config.log_level = sk.LogLevel.Off
    return config


def _atmosphere(medium: Medium, chunk: slice, geometry: sk.Geometry1D, config: sk.Config) -> sk.Atmosphere:
    wavelengths_nm = medium.wavelength_um[chunk] * 1e3
    air = sk.Atmosphere(geometry, config, calculate_derivatives=False, wavelengths_nm=wavelengths_nm)
    sk.climatology.us76.add_us76_standard_atmosphere(air)
    if medium.rayleigh:
        air["air"] = sk.constituent.Rayleigh()
    for name, kind in medium.particles.items():
        part = kind.at(chunk)
        levels, bands = part.extinction.shape
        albedo = np.broadcast_to(part.albedo, (levels, bands)).copy()
        by_moment = part.moments.transpose(2, 1, 0)  # moment, coefficient, wavelength
        moments = np.repeat(by_moment.reshape(-1, 1, bands), levels, axis=1)
        air[name] = sk.constituent.Manual(part.extinction, albedo, moments)
    gas = medium.gas_absorption[:, chunk]
    if np.any(gas > 0):
        air["gas"] = sk.constituent.Manual(gas.copy(), np.zeros_like(gas))
    return air


def rayleigh_slab(
    optical_depth: float, mu0: float, albedo: float, mu: ArrayLike, azimuth_deg: ArrayLike, streams: int = 40
) -> Float[Array, "... 3"]:
    """Light leaving the top of a homogeneous Rayleigh slab without depolarization, for a solar flux of π.

    Parameters
    ----------
    optical_depth
        Vertical, above 0. [1]
    mu0
        Cosine of the sun's zenith angle, in (0, 1]. [1]
    albedo
        Of the Lambertian ground below, 0 to 1. [1]
    mu
        Cosine of the angle of the emerging light from the vertical, in (0, 1]; broadcasts with
        ``azimuth_deg``. [1]
    azimuth_deg
        Azimuth of the direction of *travel* from the sunbeam's: 0 is forward scattering, counter-clockwise
        seen from above, as in the published tables. [°]
    streams
        Discrete ordinates over the full sphere, even.

    Returns
    -------
    I, Q, U in our `meridian` frame: Q is the opposite of the tables', U the same. [sr⁻¹]

    References
    ----------
    Coulson, Dave and Sekera, *Tables Related to Radiation Emerging from a Planetary Atmosphere with Rayleigh
    Scattering* (1960); Natraj, Li and Yung, Astrophys. J. 691, 1909 (2009).
    """
    limits = {"optical_depth": (optical_depth, np.inf), "mu0": (mu0, 1.0), "mu": (np.asarray(mu), 1.0)}
    for name, (value, largest) in limits.items():
        if not np.all((value > 0) & (value <= largest)):
            raise ValueError(f"`{name}` must be above 0 and at most {largest:g}; got {value}.")
    if not 0 <= albedo <= 1:
        raise ValueError(f"`albedo` must lie within 0 to 1; got {albedo:g}.")
    if streams % 2 or streams < 4:
        raise ValueError(f"`streams` must be even and at least 4; got {streams}.")
    mu, azimuth = np.broadcast_arrays(np.asarray(mu, dtype=float), np.radians(azimuth_deg))
    # a homogeneous plane slab is one layer, in which the ordinates' own single scatter is exact
    config = _config(streams, streams, sk.SingleScatterSource.DiscreteOrdinates)
    height, linear = np.linspace(0.0, _SLAB_M, 2), sk.InterpolationMethod.LinearInterpolation
    geometry = sk.Geometry1D(mu0, 0.0, EARTH_RADIUS_M, height, linear, sk.GeometryType.PlaneParallel)
    rays = sk.ViewingGeometry()
    for one_mu, one_azimuth in zip(mu.ravel(), azimuth.ravel(), strict=True):
        # tables count azimuth counter-clockwise, the solver clockwise
        rays.add_ray(sk.GroundViewingSolar(mu0, -one_azimuth, min(one_mu, NEAR_VERTICAL), 10 * _SLAB_M))
    slab = sk.Atmosphere(geometry, config, numwavel=1, calculate_derivatives=False)
    slab.storage.total_extinction[:] = optical_depth / _SLAB_M
    slab.storage.ssa[:] = 1.0
    slab.leg_coeff.a1[0] = 1.0
    slab.leg_coeff.a1[2] = 0.5
    slab.leg_coeff.a2[2] = 3.0  # pyright: ignore[reportOptionalSubscript]
    slab.leg_coeff.b1[2] = np.sqrt(6) / 2  # pyright: ignore[reportOptionalSubscript]
    slab.surface.albedo[:] = albedo
    light = sk.Engine(config, geometry, rays).calculate_radiance(slab)["radiance"].values
    return np.pi * light.reshape(*mu.shape, 3)
