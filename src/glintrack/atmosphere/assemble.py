"""From a design to its tables: medium in, solver's fields out, scaled to the sun and factorized.

Sky and path are solved without gas absorption, which would need many eigenvectors (20 components
leave 8 % in the saturated bands). They are then multiplied per wavelength by the gases' transmission: of the
sky's irradiance on level ground, and of the path in a reference direction toward a sensor at each altitude.
The transmission follows from the band's exponential sum; ``docs/theory/atmosphere.md`` gives its error.

``python -m glintrack.atmosphere.assemble DESIGN.json TABLES.nc THREADS`` solves in a separate process, in
which OpenBLAS is limited to one thread before numpy loads (twice as fast).
"""

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.atmosphere import gas, solve
from glintrack.atmosphere.aerosol import aerosol_optics, without_forward_peak
from glintrack.atmosphere.design import (
    AEROSOL_TOP_M,
    CLOUD_EDGE_M,
    CLOUD_LAYERS,
    CLOUD_THICKNESS_M,
    GROUND_ALBEDO,
    SCALE_HEIGHT_M,
    AtmosphereDesign,
)
from glintrack.atmosphere.sun import earth_sun_distance, solar_irradiance, sun_direction
from glintrack.atmosphere.tables import write_tables
from glintrack.core.arrays import Array
from glintrack.core.schema import IRRADIANCE, RADIANCE

ZENITH_DEG = np.arange(0.0, 88.0, 3.0)
VIEW_ZENITH_DEG = np.arange(0.0, 86.0, 5.0)
AZIMUTH_STEP_DEG = 5.0
REFERENCE_VIEW_DEG = 35.0
"""Direction in which the gases' share of the path is computed: the middle of 0° to 50° off nadir."""
TERMS, SUMMED_GASES = 5, 1
"""Of a band's exponential sum: terms, and how many of its strongest gases are summed."""
LARGEST_INTENSITY_ERROR = 1e-3
"""Of I, relative, in any direction at any wavelength. [1]"""
LARGEST_DOLP_ERROR = 1e-3
"""Of the degree of linear polarization, in any direction at any wavelength. [1]"""
MAX_COMPONENTS = 16


@dataclass(frozen=True)
class _Factors:
    """field[λ] = Σ_k spectrum[k, λ]·map[k], largest magnitude of maps 1; largest errors of I and DoLP."""

    spectrum: Float[Array, "component wavelength"]
    maps: Float[Array, "component *direction 3"]
    intensity_error: float
    dolp_error: float


def _factorize(field: Float[Array, "wavelength *direction 3"]) -> _Factors:
    """Factorize a field into the fewest components with I and DoLP within their limits.

    Each wavelength is divided by its mean I, and each direction by its own, so that the singular vectors
    represent changes of shape and a dark horizon has the same weight as the bright aureole.
    """
    bands, directions = field.shape[0], field.shape[1:-1]
    flat = field.reshape(bands, -1, 3)
    level = flat[..., 0].mean(axis=1)
    shape = flat / level[:, None, None]
    weight = 1 / shape[..., 0].mean(axis=0)
    u, s, vt = np.linalg.svd((shape * weight[:, None]).reshape(bands, -1), full_matrices=False)
    for count in range(1, min(bands, MAX_COMPONENTS) + 1):
        maps = vt[:count].reshape(count, -1, 3) / weight[:, None]
        spectrum = (u[:, :count] * s[:count]).T * level
        size = abs(maps).max(axis=(1, 2)) * np.where(maps[..., 0].sum(axis=1) < 0, -1.0, 1.0)
        maps, spectrum = (maps / size[:, None, None]).astype(np.float32), spectrum * size[:, None]
        near = np.einsum("kw,kns->wns", spectrum, maps)
        intensity_error = float(abs(near[..., 0] / flat[..., 0] - 1).max())
        dolp = [np.hypot(x[..., 1], x[..., 2]) / x[..., 0] for x in (flat, near)]
        dolp_error = float(abs(dolp[1] - dolp[0]).max())
        if intensity_error <= LARGEST_INTENSITY_ERROR and dolp_error <= LARGEST_DOLP_ERROR:
            break
    return _Factors(spectrum, maps.reshape(count, *directions, 3), intensity_error, dolp_error)


def assemble_tables(
    design: AtmosphereDesign, threads: int = 1, progress: Callable[[float], None] | None = None
) -> xr.Dataset:
    """Solve a design and lay out its tables (schema ``atmosphere``, factors only).

    Parameters
    ----------
    threads
        Of the solver.
    progress
        Called with the finished fraction.
    """
    sun_zenith, sun_azimuth = sun_direction(design)
    medium = build_medium(design, math.cos(sun_zenith))
    half_circle = np.radians(np.arange(0.0, 180.0 + AZIMUTH_STEP_DEG / 2, AZIMUTH_STEP_DEG))
    zeniths = np.radians(ZENITH_DEG), np.radians(VIEW_ZENITH_DEG)
    altitudes = np.array(design.sensor_altitudes_m)
    directions = solve.Directions(math.cos(sun_zenith), *zeniths, half_circle, altitudes)

    def part(start: float, share: float) -> Callable[[float], None]:
        return lambda done: progress(start + share * done) if progress is not None else None

    clean = replace(medium, gas_absorption=np.zeros_like(medium.gas_absorption))
    streams = design.streams
    fields = solve.solve_fields(clean, directions, GROUND_ALBEDO, streams, threads, part(0.0, 0.6))
    ground = solve.solve_ground(clean, directions, streams, threads, part(0.6, 0.1))
    height, extinction = medium.height_m, fields.scattering_extinction
    through = _through(extinction, height, directions)
    path = fields.upward.copy()  # less the target's own light
    path[..., 0] -= (fields.emitted[:, None, None] * through)[..., None]
    light = _light_of(ground, extinction, height, directions)
    absorbed = _light_with_gases(fields, clean, directions, design, threads, part(0.7, 0.3))
    sun_top = solar_irradiance(design.wavelength_um, earth_sun_distance(design))
    sun_depth = gas.slant_weights(directions.cos_sun_zenith, height) @ medium.gas_absorption
    azimuth, sky_full = _full_circle(fields.sky, directions.azimuth, sun_azimuth)
    _, path_full = _full_circle(path, directions.azimuth, sun_azimuth)
    sky, path_factors = _factorize(sky_full), _factorize(path_full)
    sky = replace(sky, spectrum=sky.spectrum * (sun_top * absorbed.diffuse / light.diffuse))
    path_factors = replace(path_factors, spectrum=path_factors.spectrum * sun_top)
    d, amounts = replace(directions, azimuth=azimuth), gas.gas_amounts(design.water_cm)
    gases = gas.path_transmittance(
        amounts, height, d.altitude_m, d.view_zenith, design.wavelength_um, d.cos_sun_zenith
    )
    spectra = {
        "sun_irradiance": sun_top * (light.sun * np.exp(-sun_depth)),
        "sky_irradiance": sun_top * absorbed.diffuse,
        "spherical_albedo": absorbed.returned,
        "path_gas": (absorbed.path / light.path).T,
        "transmittance": through * gases,
    }
    return _dataset(design, d, sky, path_factors, spectra)


def build_medium(design: AtmosphereDesign, cos_sun_zenith: float) -> solve.Medium:
    """Optical properties by level and wavelength of a design; gases effective for the sun's slant path."""
    height, wavelength_um = np.array(gas.LEVELS_M, dtype=float), design.wavelength_um
    base, top = design.cloud_base_m, design.cloud_base_m + CLOUD_THICKNESS_M
    particles = {}
    if design.cloud_optical_depth > 0:
        # layers of an optical depth near 1: the solver takes the source of a layer from its ends
        height = np.union1d(height, np.linspace(base, top, CLOUD_LAYERS + 1))
        inside = np.clip(np.minimum(height - base, top - height) / CLOUD_EDGE_M, 0, 1)
        particles["cloud"] = _particles("cloud", design.cloud_optical_depth, inside, height, wavelength_um)
    if design.aerosol_optical_depth_550 > 0:
        profile = gas.exponential_profile(height, SCALE_HEIGHT_M, AEROSOL_TOP_M)
        depth = design.aerosol_optical_depth_550
        particles["aerosol"] = _particles(design.aerosol, depth, profile, height, wavelength_um)
    amounts = gas.gas_amounts(design.water_cm)
    return solve.Medium(
        height_m=height,
        wavelength_um=wavelength_um,
        rayleigh=True,
        particles=particles,
        gas_absorption=gas.effective_absorption(amounts, height, cos_sun_zenith, wavelength_um),
    )


def _particles(
    kind: str, depth_550: float, profile: Array, height_m: Array, wavelength_um: Array
) -> solve.Particles:
    """Particles of a vertical optical depth at 0.55 µm with some profile."""
    optics = without_forward_peak(aerosol_optics(kind, wavelength_um), solve.MOMENTS)
    return solve.Particles(
        extinction=depth_550 * np.outer(gas.column_weights(profile, height_m), optics.extinction),
        albedo=optics.single_scattering_albedo,
        moments=optics.moments,
    )


@dataclass(frozen=True)
class _Light:
    """Share of the direct beam, sky on level ground, path in the reference direction, spherical albedo."""

    sun: Float[Array, "wavelength"]
    diffuse: Float[Array, "wavelength"]
    path: Float[Array, "wavelength altitude"]
    returned: Float[Array, "wavelength"]


def _light_with_gases(
    fields: solve.Fields,
    medium: solve.Medium,
    d: solve.Directions,
    design: AtmosphereDesign,
    threads: int,
    progress,
) -> _Light:
    """Light of a medium with gases: each band the sum of its terms."""
    amounts, height = gas.gas_amounts(design.water_cm), medium.height_m
    found = [
        gas.gas_terms(amounts, height, d.cos_sun_zenith, float(um), TERMS, SUMMED_GASES)
        for um in medium.wavelength_um
    ]
    band = np.repeat(np.arange(len(found)), [len(weights) for weights, _ in found])
    weights, absorption = (np.concatenate([terms[k] for terms in found]) for k in (0, 1))
    terms = replace(
        medium,
        wavelength_um=medium.wavelength_um[band],
        particles={name: kind.at(band) for name, kind in medium.particles.items()},
        gas_absorption=absorption.T,
    )
    ground = solve.solve_ground(terms, d, design.streams, threads, progress)
    light = _light_of(ground, fields.scattering_extinction[:, band] + absorption.T, height, d)
    into = np.eye(len(found))[band].T * weights  # (band, term)
    on_ground = into * (light.diffuse + d.cos_sun_zenith * light.sun)
    returned = (on_ground @ light.returned) / on_ground.sum(axis=1)
    return _Light(into @ light.sun, into @ light.diffuse, into @ light.path, returned)


def _light_of(ground: solve.GroundLight, extinction: Array, height_m: Array, d: solve.Directions) -> _Light:
    """Sun, sky and path of a medium of some extinction (level, wavelength)."""
    sun = np.exp(-gas.slant_weights(d.cos_sun_zenith, height_m) @ extinction)
    diffuse = np.maximum(ground.irradiance(GROUND_ALBEDO) - d.cos_sun_zenith * sun, 0.0)
    view = int(np.argmin(abs(d.view_zenith - math.radians(REFERENCE_VIEW_DEG))))
    emitted = GROUND_ALBEDO * ground.irradiance(GROUND_ALBEDO) / np.pi
    around = ground.gain[:, :, view, 0] - _through(extinction, height_m, d)[:, :, view]
    path = ground.dark_upward[:, :, view, 0] + emitted[:, None] * around
    return _Light(sun, diffuse, np.maximum(path, 0.0), ground.spherical_albedo)


def _through(
    extinction: Array, height_m: Array, d: solve.Directions
) -> Float[Array, "wavelength altitude view_zenith"]:
    """Transmittance from the ground to each sensor."""
    slant = np.array(
        [[gas.slant_weights(math.cos(v), height_m, a) for v in d.view_zenith] for a in d.altitude_m]
    )
    return np.exp(-np.moveaxis(slant @ extinction, -1, 0))


def _full_circle(
    half: Float[Array, "*lead azimuth 3"], azimuth: Float[Array, "azimuth"], sun_azimuth: float
) -> tuple[Float[Array, "full"], Float[Array, "*lead full 3"]]:
    """Mirror a half circle about the sun's vertical plane and sort it by absolute azimuths."""
    mirrored = half[..., -2:0:-1, :] * np.array([1.0, 1.0, -1.0])  # U turns its sign in the mirror
    full = np.concatenate([half, mirrored], axis=-2)
    around = np.r_[azimuth, 2 * np.pi - azimuth[-2:0:-1]]
    step = azimuth[1] - azimuth[0]
    absolute = np.mod(sun_azimuth + around, 2 * np.pi)
    order = np.argsort(absolute)
    even = absolute[order[0]] + step * np.arange(order.size)
    return even, full[..., order, :]


def _dataset(
    design: AtmosphereDesign, d: solve.Directions, sky: _Factors, path: _Factors, spectra: dict[str, Array]
) -> xr.Dataset:
    """Dataset of the tables, with units and descriptions."""
    sun_zenith, sun_azimuth = sun_direction(design)
    radiance, frame = {"units": RADIANCE}, {"units": "1", "stokes_frame": "meridian"}
    flat, path_dims = ("wavelength",), ("path_component", "altitude", "view_zenith", "azimuth", "stokes")
    through_dims = ("wavelength", "altitude", "view_zenith")
    labels = {
        "sun_irradiance": (flat, IRRADIANCE, "direct sun at the ground, on a plane normal to the beam"),
        "sky_irradiance": (flat, IRRADIANCE, "diffuse sky on level ground"),
        "spherical_albedo": (flat, "1", "of the atmosphere, for light from below"),
        "path_gas": (("altitude", "wavelength"), "1", "transmission of gases for the path to the altitude"),
        "transmittance": (through_dims, "1", "of reflected sunlight from the ground to the sensor"),
    }
    look = "of the direction of look, clockwise from north"
    axes = {
        "wavelength": (design.wavelength_um, {"units": "um"}),
        "altitude": (d.altitude_m, {"units": "m"}),
        "zenith": (d.zenith, {"units": "rad"}),
        "view_zenith": (d.view_zenith, {"units": "rad", "long_name": "from nadir"}),
        "azimuth": (d.azimuth, {"units": "rad", "long_name": look}),
    }
    tables = xr.Dataset(
        {n: (dims, spectra[n], {"units": u, "long_name": text}) for n, (dims, u, text) in labels.items()}
        | {
            "sky_spectrum": (("sky_component", "wavelength"), sky.spectrum, radiance),
            "sky_map": (("sky_component", "zenith", "azimuth", "stokes"), sky.maps, frame),
            "path_spectrum": (("path_component", "wavelength"), path.spectrum, radiance),
            "path_map": (path_dims, path.maps, frame),
        },
        coords={name: (name, *axis) for name, axis in axes.items()} | {"stokes": ["I", "Q", "U"]},
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


def main(design_path: str, tables_path: str, threads: str) -> None:
    """Solve the design of one file into another."""
    design = AtmosphereDesign.model_validate_json(Path(design_path).read_text(encoding="utf-8"))
    tables = assemble_tables(design, int(threads), lambda fraction: print(f"{fraction:.4f}", flush=True))
    write_tables(tables, Path(tables_path))


if __name__ == "__main__":
    main(*sys.argv[1:4])
