"""The polarized atmosphere: sun, sky, path and gases from 0.4 to 2.5 µm."""

from importlib import import_module
from typing import TYPE_CHECKING

from glintrack.atmosphere.design import AtmosphereDesign, rochester_summer
from glintrack.atmosphere.directions import (
    interpolate_map,
    path_stokes,
    sky_stokes,
    to_fixed_azimuth_frame,
    to_meridian_frame,
)
from glintrack.atmosphere.sun import earth_sun_distance, solar_irradiance, sun_direction
from glintrack.atmosphere.tables import solve_tables

if TYPE_CHECKING:
    from glintrack.atmosphere.slab import rayleigh_slab

__all__ = [
    "AtmosphereDesign",
    "earth_sun_distance",
    "interpolate_map",
    "path_stokes",
    "rayleigh_slab",
    "rochester_summer",
    "sky_stokes",
    "solar_irradiance",
    "solve_tables",
    "sun_direction",
    "to_fixed_azimuth_frame",
    "to_meridian_frame",
]


def __getattr__(name: str):
    """Load `rayleigh_slab` when it is asked for: it brings sasktran2, a second of start nobody else needs."""
    if name == "rayleigh_slab":
        return import_module("glintrack.atmosphere.slab").rayleigh_slab
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
