"""The polarized atmosphere: sun, sky, path and gases from 0.4 to 2.5 µm."""

from typing import TYPE_CHECKING

from glintrack.lazy import lazy_names

if TYPE_CHECKING:
    from glintrack.atmosphere.design import AtmosphereDesign, rochester_summer
    from glintrack.atmosphere.directions import (
        interpolate_map,
        path_stokes,
        sky_stokes,
        to_fixed_azimuth_frame,
        to_meridian_frame,
    )
    from glintrack.atmosphere.slab import rayleigh_slab
    from glintrack.atmosphere.sun import earth_sun_distance, solar_irradiance, sun_direction
    from glintrack.atmosphere.tables import solve_tables

_HOMES = {
    "AtmosphereDesign": "glintrack.atmosphere.design:AtmosphereDesign",
    "earth_sun_distance": "glintrack.atmosphere.sun:earth_sun_distance",
    "interpolate_map": "glintrack.atmosphere.directions:interpolate_map",
    "path_stokes": "glintrack.atmosphere.directions:path_stokes",
    "rayleigh_slab": "glintrack.atmosphere.slab:rayleigh_slab",
    "rochester_summer": "glintrack.atmosphere.design:rochester_summer",
    "sky_stokes": "glintrack.atmosphere.directions:sky_stokes",
    "solar_irradiance": "glintrack.atmosphere.sun:solar_irradiance",
    "solve_tables": "glintrack.atmosphere.tables:solve_tables",
    "sun_direction": "glintrack.atmosphere.sun:sun_direction",
    "to_fixed_azimuth_frame": "glintrack.atmosphere.directions:to_fixed_azimuth_frame",
    "to_meridian_frame": "glintrack.atmosphere.directions:to_meridian_frame",
}
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
__getattr__, __dir__ = lazy_names(__name__, _HOMES)
