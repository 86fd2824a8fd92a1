"""The polarized atmosphere: sun, sky, path and gases from 0.4 to 2.5 µm."""

from glintrack.atmosphere.design import AtmosphereDesign
from glintrack.atmosphere.directions import interpolate_map, path_stokes, sky_stokes
from glintrack.atmosphere.solve import rayleigh_slab
from glintrack.atmosphere.sun import earth_sun_distance, solar_irradiance, sun_direction
from glintrack.atmosphere.tables import is_solved, solve_tables

__all__ = [
    "AtmosphereDesign", "earth_sun_distance", "interpolate_map", "is_solved", "path_stokes", "rayleigh_slab",
    "sky_stokes", "solar_irradiance", "solve_tables", "sun_direction",
]  # fmt: skip
