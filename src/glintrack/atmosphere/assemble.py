"""From a design to its tables: medium in, solver's fields out, scaled to the sun and factorized.

Sky and path are solved without gas absorption, whose angular shape takes many eigenvectors (20 components
leave 8 % in the saturated bands), and then multiplied per wavelength by what the gases leave: of the sky's
irradiance on level ground, of the path in a reference direction. Sun, irradiances and transmittance carry the
gases exactly. ``docs/atmosphere.md`` says what that costs.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.arrays import Array
from glintrack.atmosphere.aerosol import AerosolOptics, aerosol_optics, without_forward_peak
from glintrack.atmosphere.design import AEROSOL_TOP_M, SCALE_HEIGHT_M, AtmosphereDesign
from glintrack.atmosphere.factors import Factors, factorize
from glintrack.atmosphere.gas import effective_absorption, gas_amounts, path_transmittance
from glintrack.atmosphere.profile import LEVELS_M, column_weights, exponential_profile, slant_weights
from glintrack.atmosphere.solve import MOMENTS, Directions, Fields, GroundLight, Medium, solve_fields
from glintrack.atmosphere.sun import earth_sun_distance, solar_irradiance, sun_direction
from glintrack.schema import IRRADIANCE, RADIANCE

ZENITH_DEG = np.arange(0.0, 88.0, 3.0)
VIEW_ZENITH_DEG = np.arange(0.0, 86.0, 5.0)
AZIMUTH_STEP_DEG = 5.0
REFERENCE_ALTITUDE_M, REFERENCE_VIEW_DEG = 3000.0, 20.0
"""Where the gases' share of the path is taken: the paper's slant range and its middle off-nadir angle."""


def assemble_tables(
    design: AtmosphereDesign, threads: int = 1, progress: Callable[[float], None] | None = None
) -> xr.Dataset:
    """Solve a design and lay out its tables (schema ``atmosphere``, factors only).

    Parameters
    ----------
    design
        The atmosphere.
    threads
        Of the solver.
    progress
        Called with the finished fraction.
    """
    sun_zenith, sun_azimuth = sun_direction(design)
    medium = build_medium(design, math.cos(sun_zenith))
    half_circle = np.radians(np.arange(0.0, 180.0 + AZIMUTH_STEP_DEG / 2, AZIMUTH_STEP_DEG))
    directions = Directions(
        math.cos(sun_zenith),
        np.radians(ZENITH_DEG),
        np.radians(VIEW_ZENITH_DEG),
        half_circle,
        np.array(design.altitudes_m),
    )
    fields = solve_fields(medium, directions, design.ground_albedo, design.streams, threads, progress)
    sun_top = solar_irradiance(design.wavelength_um, earth_sun_distance(design))
    return _lay_out(design, directions, fields, medium, sun_top, sun_azimuth)


def build_medium(design: AtmosphereDesign, cos_sun_zenith: float) -> Medium:
    """Optical properties by level and wavelength of a design; gases as the sun's slant path sees them."""
    height = np.array(LEVELS_M, dtype=float)
    wavelength_um = design.wavelength_um
    shape = (height.size, wavelength_um.size)
    if design.aerosol == "none":
        isotropic = np.zeros((wavelength_um.size, 4, MOMENTS))
        optics = AerosolOptics(np.zeros(shape[1]), np.zeros(shape[1]), isotropic)
    else:
        optics = without_forward_peak(aerosol_optics(design.aerosol, wavelength_um), MOMENTS)
    profile = column_weights(exponential_profile(height, SCALE_HEIGHT_M, AEROSOL_TOP_M), height)
    return Medium(
        height_m=height,
        wavelength_um=wavelength_um,
        rayleigh=True,
        aerosol_extinction=design.aerosol_optical_depth_550 * np.outer(profile, optics.extinction),
        aerosol_albedo=optics.single_scattering_albedo,
        aerosol_moments=optics.moments,
        gas_absorption=effective_absorption(
            gas_amounts(design.water_cm, design.ozone_du), height, cos_sun_zenith, wavelength_um
        ),
    )


def _lay_out(
    design: AtmosphereDesign,
    d: Directions,
    fields: Fields,
    medium: Medium,
    sun_top: Array,
    sun_azimuth: float,
) -> xr.Dataset:
    """Scale to the sun, take the ground off the path, put the gases in, factorize."""
    height, albedo, extinction = medium.height_m, design.ground_albedo, fields.scattering_extinction
    sunward = slant_weights(d.cos_sun_zenith, height)
    slant = np.array([[slant_weights(math.cos(v), height, a) for v in d.view_zenith] for a in d.altitude_m])

    def through(coefficient: Array) -> Array:
        return np.exp(-np.moveaxis(slant @ coefficient, -1, 0))

    sun_clean = np.exp(-sunward @ extinction)
    sun_through = sun_clean * np.exp(-sunward @ medium.gas_absorption)
    diffuse_clean = fields.clean.irradiance(albedo) - d.cos_sun_zenith * sun_clean
    diffuse = np.maximum(fields.absorbing.irradiance(albedo) - d.cos_sun_zenith * sun_through, 0.0)

    path = _without_ground(fields, through(extinction), design)
    absorbed = through(extinction + medium.gas_absorption)  # with the gases of the sun's path, as solved
    reference = [
        _reference_path(light, transmittance, design, d)
        for light, transmittance in ((fields.absorbing, absorbed), (fields.clean, through(extinction)))
    ]
    azimuth, sky_full = _full_circle(fields.sky, d.azimuth, sun_azimuth)
    _, path_full = _full_circle(path, d.azimuth, sun_azimuth)
    sky = _scaled(factorize(sky_full), sun_top * diffuse / diffuse_clean)
    path_factors = _scaled(factorize(path_full), sun_top * np.maximum(reference[0], 0.0) / reference[1])
    amounts = gas_amounts(design.water_cm, design.ozone_du)
    spectra = {
        "sun_irradiance": sun_top * sun_through,
        "sky_irradiance": sun_top * diffuse,
        "spherical_albedo": fields.absorbing.spherical_albedo,
        "transmittance": through(extinction)
        * path_transmittance(amounts, height, d.altitude_m, d.view_zenith, design.wavelength_um),
    }
    axes = {"zenith": d.zenith, "view_zenith": d.view_zenith, "azimuth": azimuth}
    return _dataset(design, axes, sky, path_factors, spectra)


def _without_ground(
    fields: Fields, through: Array, design: AtmosphereDesign
) -> Float[Array, "wavelength altitude view_zenith azimuth 3"]:
    """Upward light less the target's own (adjacency) or less all that the ground sent (none)."""
    emitted, path = fields.emitted[:, None, None], fields.upward.copy()
    if design.adjacency:
        path[..., 0] -= (emitted * through)[..., None]
    else:
        path -= (emitted[..., None] * fields.clean.gain)[..., None, :]
    return path


def _reference_path(
    light: GroundLight, through: Array, design: AtmosphereDesign, d: Directions
) -> Float[Array, "wavelength"]:
    """Intensity of the path in one direction toward one sensor, from which the gases' share is taken."""
    altitude = int(np.argmin(abs(d.altitude_m - REFERENCE_ALTITUDE_M)))
    view = int(np.argmin(abs(d.view_zenith - math.radians(REFERENCE_VIEW_DEG))))
    emitted = design.ground_albedo * light.irradiance(design.ground_albedo) / np.pi
    around = light.gain[:, altitude, view, 0] - through[:, altitude, view]
    return light.dark_upward[:, altitude, view, 0] + (emitted * around if design.adjacency else 0.0)


def _scaled(factors: Factors, by_wavelength: Float[Array, "wavelength"]) -> Factors:
    """The same maps with other spectra; relative errors stay what they are."""
    return replace(factors, spectrum=factors.spectrum * by_wavelength)


def _full_circle(
    half: Float[Array, "*lead azimuth 3"], azimuth: Float[Array, "azimuth"], sun_azimuth: float
) -> tuple[Float[Array, "full"], Float[Array, "*lead full 3"]]:
    """Mirror a half circle about the sun's vertical plane and lay it on absolute azimuths, rising."""
    mirrored = half[..., -2:0:-1, :] * np.array([1.0, 1.0, -1.0])  # U turns its sign in the mirror
    full = np.concatenate([half, mirrored], axis=-2)
    around = np.r_[azimuth, 2 * np.pi - azimuth[-2:0:-1]]
    step = azimuth[1] - azimuth[0]
    absolute = np.mod(sun_azimuth + around, 2 * np.pi)
    order = np.argsort(absolute)
    even = absolute[order[0]] + step * np.arange(order.size)
    return even, full[..., order, :]


def _dataset(
    design: AtmosphereDesign, axes: dict[str, Array], sky: Factors, path: Factors, spectra: dict[str, Array]
) -> xr.Dataset:
    sun_zenith, sun_azimuth = sun_direction(design)
    frame = {"units": "1", "stokes_frame": "meridian"}
    spectrum = ("wavelength",)
    tables = xr.Dataset(
        {
            "sun_irradiance": (
                spectrum,
                spectra["sun_irradiance"],
                {"units": IRRADIANCE, "long_name": "direct sun at the ground, on a plane normal to the beam"},
            ),
            "sky_irradiance": (
                spectrum,
                spectra["sky_irradiance"],
                {"units": IRRADIANCE, "long_name": "diffuse sky on level ground"},
            ),
            "spherical_albedo": (spectrum, spectra["spherical_albedo"], {"units": "1"}),
            "transmittance": (
                ("wavelength", "altitude", "view_zenith"),
                spectra["transmittance"],
                {"units": "1", "long_name": "from the ground to the sensor"},
            ),
            "sky_spectrum": (("sky_component", "wavelength"), sky.spectrum, {"units": RADIANCE}),
            "sky_map": (("sky_component", "zenith", "azimuth", "stokes"), sky.maps, frame),
            "path_spectrum": (("path_component", "wavelength"), path.spectrum, {"units": RADIANCE}),
            "path_map": (
                ("path_component", "altitude", "view_zenith", "azimuth", "stokes"),
                path.maps,
                frame,
            ),
        },
        coords={
            "wavelength": ("wavelength", design.wavelength_um, {"units": "um"}),
            "zenith": ("zenith", axes["zenith"], {"units": "rad"}),
            "view_zenith": ("view_zenith", axes["view_zenith"], {"units": "rad", "long_name": "from nadir"}),
            "azimuth": (
                "azimuth",
                axes["azimuth"],
                {"units": "rad", "long_name": "of the direction of look, clockwise from north"},
            ),
            "altitude": ("altitude", np.array(design.altitudes_m), {"units": "m"}),
            "stokes": ["I", "Q", "U"],
        },
    )
    tables.attrs = {
        "title": "polarized atmosphere: sun, sky, path",
        "source": "solved by glintrack with sasktran2; sun ASTM G173-03 (pvlib), aerosol WMO 1986, gases 6S",
        "licence": "BSD-3-Clause, as glintrack",
        "sun_zenith_rad": sun_zenith,
        "sun_azimuth_rad": sun_azimuth,
        "band_width_um": 0.01,
        "sky_intensity_error": sky.intensity_error,
        "sky_dolp_error": sky.dolp_error,
        "path_intensity_error": path.intensity_error,
        "path_dolp_error": path.dolp_error,
        "design": design.model_dump_json(),
        "content_key": design.content_key(),
    }
    return tables
