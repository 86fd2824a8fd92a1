"""From a design to its tables: medium in, solver's fields out, scaled to the sun and factorized."""

import math
from collections.abc import Callable

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.atmosphere.aerosol import AerosolOptics, aerosol_optics, without_forward_peak
from glintrack.atmosphere.design import AEROSOL_TOP_M, SCALE_HEIGHT_M, AtmosphereDesign
from glintrack.atmosphere.factors import Factors, factorize
from glintrack.atmosphere.profile import LEVELS_M, column_weights, exponential_profile, slant_weights
from glintrack.atmosphere.solve import MOMENTS, Directions, Fields, Medium, solve_fields
from glintrack.atmosphere.sun import earth_sun_distance, solar_irradiance, sun_direction
from glintrack.schema import IRRADIANCE, RADIANCE

Array = np.ndarray
ZENITH_DEG = np.arange(0.0, 88.0, 3.0)
VIEW_ZENITH_DEG = np.arange(0.0, 86.0, 5.0)
AZIMUTH_STEP_DEG = 5.0


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
    medium = build_medium(design)
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


def build_medium(design: AtmosphereDesign) -> Medium:
    """Optical properties at every level and wavelength of a design."""
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
        gas_absorption=np.zeros(shape),
    )


def _lay_out(
    design: AtmosphereDesign,
    d: Directions,
    fields: Fields,
    medium: Medium,
    sun_top: Array,
    sun_azimuth: float,
) -> xr.Dataset:
    height, scale = medium.height_m, sun_top[:, None, None, None]
    sun_through = np.exp(-slant_weights(d.cos_sun_zenith, height) @ fields.extinction)
    through = np.exp(
        -np.array([[slant_weights(math.cos(v), height, a) for v in d.view_zenith] for a in d.altitude_m])
        @ fields.extinction
    )  # altitude, view_zenith, wavelength
    through = np.moveaxis(through, -1, 0)
    emitted = (design.ground_albedo * fields.ground_irradiance / np.pi)[:, None, None]
    path = fields.upward.copy()
    if design.adjacency:
        path[..., 0] -= (emitted * through)[..., None]
    else:
        path -= (emitted[..., None] * fields.ground_gain)[..., None, :]
    azimuth, sky_full = _full_circle(fields.sky, d.azimuth, sun_azimuth)
    _, path_full = _full_circle(path, d.azimuth, sun_azimuth)
    sky, path_factors = factorize(sky_full * scale), factorize(path_full * scale[..., None])
    diffuse = sun_top * (fields.ground_irradiance - d.cos_sun_zenith * sun_through)
    return _dataset(
        design,
        {"zenith": d.zenith, "view_zenith": d.view_zenith, "azimuth": azimuth},
        sky,
        path_factors,
        {
            "sun_irradiance": sun_top * sun_through,
            "sky_irradiance": diffuse,
            "spherical_albedo": fields.spherical_albedo,
            "transmittance": through,
        },
    )


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
