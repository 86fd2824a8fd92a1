"""Position of the sun and its irradiance above the atmosphere."""

import datetime
import math
from functools import lru_cache

import numpy as np
import pandas as pd
import pvlib
from jaxtyping import Float

from glintrack.atmosphere.design import HIGHEST_SUN_ZENITH_DEG, AtmosphereDesign
from glintrack.core.arrays import Array

BAND_WIDTH_UM = 0.01
"""Width over which every spectral value of the atmosphere is a mean. [µm]"""


def sun_direction(design: AtmosphereDesign) -> tuple[float, float]:
    """Zenith angle of the sun and its azimuth, clockwise from north, of the direction one looks to see it.

    The zenith angle is geometric (no refraction). Computed by the NREL algorithm in pvlib where the design
    gives place and time. [rad, rad]

    Raises
    ------
    ValueError
        If the sun is below 10° of elevation at that place and time.
    """
    if design.sun_zenith_deg is not None and design.sun_azimuth_deg is not None:
        return math.radians(design.sun_zenith_deg), math.radians(design.sun_azimuth_deg) % (2 * math.pi)
    zenith_deg, azimuth_deg = _sun_angles_deg(design.utc, design.latitude_deg, design.longitude_deg)
    if zenith_deg > HIGHEST_SUN_ZENITH_DEG:
        raise ValueError(
            f"`local_time_h` must put the sun within 0 to {HIGHEST_SUN_ZENITH_DEG:g}° of the zenith; got "
            f"{zenith_deg:.1f}° at {design.local_time_h:g} h on {design.date}, "
            f"{'below' if zenith_deg > 90 else 'above'} the horizon."
        )
    return math.radians(zenith_deg), math.radians(azimuth_deg)


@lru_cache(maxsize=64)  # a study asks a thousand times for one of a few
def _sun_angles_deg(utc: datetime.datetime, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
    """Geometric zenith angle and azimuth of the sun. [deg]"""
    found = pvlib.solarposition.spa_python(pd.DatetimeIndex([utc]), latitude_deg, longitude_deg)
    return float(found["zenith"].iloc[0]), float(found["azimuth"].iloc[0])


def earth_sun_distance(design: AtmosphereDesign) -> float:
    """Distance to the sun on the design's date. [astronomical units]"""
    times = pd.DatetimeIndex([design.utc])
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
    table = pvlib.spectrum.get_reference_spectra(standard="ASTM G173-03")["extraterrestrial"]
    table_um, per_um = table.index.to_numpy() * 1e-3, table.to_numpy() * 1e3
    integral = np.r_[0.0, np.cumsum(0.5 * (per_um[1:] + per_um[:-1]) * np.diff(table_um))]
    wavelength_um = np.asarray(wavelength_um, dtype=float)
    upper = np.interp(wavelength_um + BAND_WIDTH_UM / 2, table_um, integral)
    lower = np.interp(wavelength_um - BAND_WIDTH_UM / 2, table_um, integral)
    return (upper - lower) / BAND_WIDTH_UM / distance_au**2
