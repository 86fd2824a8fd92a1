"""From a design to its tables: medium in, solver's fields out, scaled to the sun and factorized.

Sky and path are solved without gas absorption, whose angular shape takes many eigenvectors (20 components
leave 8 % in the saturated bands), and then multiplied per wavelength by what the gases leave: of the sky's
irradiance on level ground; of the path in a reference direction, toward a sensor at each altitude. What they
leave is the light of the band's exponential sum. ``docs/atmosphere.md`` says what that costs.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.atmosphere.aerosol import AerosolOptics, aerosol_optics, without_forward_peak
from glintrack.atmosphere.design import AEROSOL_TOP_M, SCALE_HEIGHT_M, AtmosphereDesign
from glintrack.atmosphere.exponential_sums import gas_terms
from glintrack.atmosphere.factors import Factors, factorize
from glintrack.atmosphere.gas import effective_absorption, gas_amounts, path_transmittance
from glintrack.atmosphere.profile import LEVELS_M, column_weights, exponential_profile, slant_weights
from glintrack.atmosphere.solve import (
    MOMENTS,
    Directions,
    Fields,
    GroundLight,
    Medium,
    solve_fields,
    solve_ground,
)
from glintrack.atmosphere.sun import earth_sun_distance, solar_irradiance, sun_direction
from glintrack.core.arrays import Array
from glintrack.core.schema import IRRADIANCE, RADIANCE

ZENITH_DEG = np.arange(0.0, 88.0, 3.0)
VIEW_ZENITH_DEG = np.arange(0.0, 86.0, 5.0)
AZIMUTH_STEP_DEG = 5.0
REFERENCE_VIEW_DEG = 35.0
"""Where the gases' share of the path is taken: about the middle of 0° to 50° off nadir."""
TERMS, SUMMED_GASES = 5, 1
"""Of a band's exponential sum: terms, and how many of its strongest gases are summed."""


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

    def part(start: float, share: float) -> Callable[[float], None] | None:
        tell = progress
        return None if tell is None else lambda done: tell(start + share * done)

    clean = replace(medium, gas_absorption=np.zeros_like(medium.gas_absorption))
    streams = design.streams
    fields = solve_fields(clean, directions, design.ground_albedo, streams, threads, part(0.0, 0.6))
    ground = solve_ground(clean, directions, streams, threads, part(0.6, 0.1))
    height, extinction = medium.height_m, fields.scattering_extinction
    path = _without_ground(fields, ground, _through(extinction, height, directions), design)
    light = _light_of(ground, extinction, height, directions, design)
    left = _absorbed_light(fields, clean, directions, design, threads, part(0.7, 0.3))
    sun_top = solar_irradiance(design.wavelength_um, earth_sun_distance(design))
    return _lay_out(design, directions, replace(fields, upward=path), (light, left), sun_top, sun_azimuth)


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


@dataclass(frozen=True)
class _Light:
    """What reaches ground and sensor for unit solar irradiance, by wavelength.

    ``sun``: share of the direct beam. ``diffuse``: sky on level ground. ``path``: (wavelength, altitude), in
    the reference direction. ``returned``: spherical albedo.
    """

    sun: Float[Array, "wavelength"]
    diffuse: Float[Array, "wavelength"]
    path: Float[Array, "wavelength altitude"]
    returned: Float[Array, "wavelength"]


def _absorbed_light(
    fields: Fields, medium: Medium, d: Directions, design: AtmosphereDesign, threads: int, progress
) -> _Light:
    """With gases: each band the sum of its terms."""
    amounts, height = gas_amounts(design.water_cm, design.ozone_du), medium.height_m
    found = [
        gas_terms(amounts, height, d.cos_sun_zenith, float(um), TERMS, SUMMED_GASES)
        for um in medium.wavelength_um
    ]
    band = np.repeat(np.arange(len(found)), [len(weights) for weights, _ in found])
    weights, gas = (np.concatenate([terms[k] for terms in found]) for k in (0, 1))
    terms = Medium(
        height,
        medium.wavelength_um[band],
        medium.rayleigh,
        medium.aerosol_extinction[:, band],
        medium.aerosol_albedo[band],
        medium.aerosol_moments[band],
        gas.T,
    )
    ground = solve_ground(terms, d, design.streams, threads, progress)
    light = _light_of(ground, fields.scattering_extinction[:, band] + gas.T, height, d, design)
    into = np.eye(len(found))[band].T * weights  # (band, term)
    on_ground = into * (light.diffuse + d.cos_sun_zenith * light.sun)
    returned = (on_ground @ light.returned) / on_ground.sum(axis=1)
    return _Light(into @ light.sun, into @ light.diffuse, into @ light.path, returned)


def _light_of(
    ground: GroundLight, extinction: Array, height_m: Array, d: Directions, design: AtmosphereDesign
) -> _Light:
    """Sun, sky and path of a medium of some extinction (level, wavelength)."""
    albedo = design.ground_albedo
    sun = np.exp(-slant_weights(d.cos_sun_zenith, height_m) @ extinction)
    diffuse = np.maximum(ground.irradiance(albedo) - d.cos_sun_zenith * sun, 0.0)
    path = _reference_path(ground, _through(extinction, height_m, d), design, d)
    return _Light(sun, diffuse, np.maximum(path, 0.0), ground.spherical_albedo)


def _through(
    extinction: Array, height_m: Array, d: Directions
) -> Float[Array, "wavelength altitude view_zenith"]:
    """Transmittance from the ground to each sensor."""
    slant = np.array([[slant_weights(math.cos(v), height_m, a) for v in d.view_zenith] for a in d.altitude_m])
    return np.exp(-np.moveaxis(slant @ extinction, -1, 0))


def _lay_out(
    design: AtmosphereDesign,
    d: Directions,
    fields: Fields,
    light: tuple[_Light, _Light],
    sun_top: Array,
    sun_azimuth: float,
) -> xr.Dataset:
    """Scale to the sun, put the gases in, factorize; ``fields.upward`` is the path."""
    height, (clean, left) = np.array(LEVELS_M, dtype=float), light
    amounts = gas_amounts(design.water_cm, design.ozone_du)
    absorbed = effective_absorption(amounts, height, d.cos_sun_zenith, design.wavelength_um)
    sun = clean.sun * np.exp(-slant_weights(d.cos_sun_zenith, height) @ absorbed)
    through = _through(fields.scattering_extinction, height, d)
    azimuth, sky_full = _full_circle(fields.sky, d.azimuth, sun_azimuth)
    _, path_full = _full_circle(fields.upward, d.azimuth, sun_azimuth)
    sky = _scaled(factorize(sky_full), sun_top * left.diffuse / clean.diffuse)
    path_factors = _scaled(factorize(path_full), sun_top)
    spectra = {
        "sun_irradiance": sun_top * sun,
        "sky_irradiance": sun_top * left.diffuse,
        "spherical_albedo": left.returned,
        "path_gas": (left.path / clean.path).T,
        "transmittance": through
        * path_transmittance(amounts, height, d.altitude_m, d.view_zenith, design.wavelength_um),
    }
    axes = {"zenith": d.zenith, "view_zenith": d.view_zenith, "azimuth": azimuth}
    return _dataset(design, axes, sky, path_factors, spectra)


def _without_ground(
    fields: Fields, ground: GroundLight, through: Array, design: AtmosphereDesign
) -> Float[Array, "wavelength altitude view_zenith azimuth 3"]:
    """Upward light less the target's own (adjacency) or less all that the ground sent (none)."""
    emitted, path = fields.emitted[:, None, None], fields.upward.copy()
    if design.adjacency:
        path[..., 0] -= (emitted * through)[..., None]
    else:
        path -= (emitted[..., None] * ground.gain)[..., None, :]
    return path


def _reference_path(
    light: GroundLight, through: Array, design: AtmosphereDesign, d: Directions
) -> Float[Array, "wavelength altitude"]:
    """Intensity of the path in one direction toward each sensor, from which the gases' share is taken."""
    view = int(np.argmin(abs(d.view_zenith - math.radians(REFERENCE_VIEW_DEG))))
    emitted = design.ground_albedo * light.irradiance(design.ground_albedo) / np.pi
    around = light.gain[:, :, view, 0] - through[:, :, view]
    return light.dark_upward[:, :, view, 0] + (emitted[:, None] * around if design.adjacency else 0.0)


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
            "path_gas": (
                ("altitude", "wavelength"),
                spectra["path_gas"],
                {"units": "1", "long_name": "what gases leave of the path to a sensor at that altitude"},
            ),
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
