"""Position of the sun and its irradiance above the atmosphere.

pvlib takes a tenth of a second to load, which each command on a case would wait for: where the sun stands is
asked of its module of that alone, and the rest is loaded by who needs it.
"""

import datetime
import math
from functools import lru_cache
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import Float

from glintrack.atmosphere.design import HIGHEST_SUN_ZENITH_DEG, AtmosphereDesign
from glintrack.core.arrays import Array

BAND_WIDTH_UM = 0.01
"""Width over which every spectral value of the atmosphere is a mean. [µm]"""
# pvlib's defaults: elevation [m], pressure [mbar] and temperature [°C] of the place; how far clocks are
# ahead of the earth's turning; and refraction at the horizon, which no zenith angle here has in it
_SEA_LEVEL, _DELTA_T_S, _REFRACTION_DEG = (0.0, 1013.25, 12.0), 67.0, 0.5667


def sun_direction(design: AtmosphereDesign) -> tuple[float, float]:
    """Zenith angle of the sun and its azimuth, clockwise from north, of the direction one looks to see it.

    The zenith angle is geometric (no refraction). Computed by the NREL algorithm in pvlib where the design
    gives place and time. [rad, rad]

    Raises
    ------
    ValueError
        If the sun stands below 10° of elevation at that place and time.
    """
    if design.sun_zenith_deg is not None and design.sun_azimuth_deg is not None:
        return math.radians(design.sun_zenith_deg), math.radians(design.sun_azimuth_deg) % (2 * math.pi)
    unix_s, place = np.array([_time(design).timestamp()]), (design.latitude_deg, design.longitude_deg)
    found = _spa().solar_position(unix_s, *place, *_SEA_LEVEL, _DELTA_T_S, _REFRACTION_DEG)
    zenith_deg, azimuth_deg = float(found[1][0]), float(found[4][0])
    if zenith_deg > HIGHEST_SUN_ZENITH_DEG:
        raise ValueError(
            f"`local_time_h` must put the sun within 0 to {HIGHEST_SUN_ZENITH_DEG:g}° of the zenith, got "
            f"{zenith_deg:.1f}° at {design.local_time_h:g} h on {design.date} "
            f"({'below' if zenith_deg > 90 else 'above'} the horizon)"
        )
    return math.radians(zenith_deg), math.radians(azimuth_deg)


def earth_sun_distance(design: AtmosphereDesign) -> float:
    """Distance to the sun on the design's date. [astronomical units]"""
    import pandas as pd
    import pvlib

    times = pd.DatetimeIndex([_time(design)])
    return float(np.asarray(pvlib.solarposition.nrel_earthsun_distance(times)).ravel()[0])


def solar_irradiance(
    wavelength_um: Float[Array, "wavelength"], distance_au: float = 1.0
) -> Float[Array, "wavelength"]:
    """Solar irradiance above the atmosphere, mean over 10 nm. [W m⁻² µm⁻¹]

    Parameters
    ----------
    wavelength_um
        Band centres. [µm]
    distance_au
        Earth–sun distance. [au]

    References
    ----------
    ASTM G173-03, extraterrestrial column, as bundled with pvlib.
    """
    import pvlib

    table = pvlib.spectrum.get_reference_spectra(standard="ASTM G173-03")["extraterrestrial"]
    table_um, per_um = table.index.to_numpy() * 1e-3, table.to_numpy() * 1e3
    integral = np.r_[0.0, np.cumsum(0.5 * (per_um[1:] + per_um[:-1]) * np.diff(table_um))]
    wavelength_um = np.asarray(wavelength_um, dtype=float)
    upper = np.interp(wavelength_um + BAND_WIDTH_UM / 2, table_um, integral)
    lower = np.interp(wavelength_um - BAND_WIDTH_UM / 2, table_um, integral)
    return (upper - lower) / BAND_WIDTH_UM / distance_au**2


def _time(design: AtmosphereDesign) -> datetime.datetime:
    offset_h = design.utc_offset_h
    if offset_h is None:
        offset_h = round(design.longitude_deg / 15.0)
    midnight = datetime.datetime.combine(design.date, datetime.time(), datetime.UTC)
    return midnight + datetime.timedelta(hours=design.local_time_h - offset_h)


@lru_cache(maxsize=1)
def _spa() -> ModuleType:
    """`pvlib.spa`, the NREL algorithm, which needs nothing else of pvlib."""
    pvlib = find_spec("pvlib")
    assert pvlib is not None and pvlib.origin is not None
    found = spec_from_file_location("pvlib.spa", Path(pvlib.origin).with_name("spa.py"))
    assert found is not None and found.loader is not None
    spa = module_from_spec(found)
    found.loader.exec_module(spa)
    return spa
