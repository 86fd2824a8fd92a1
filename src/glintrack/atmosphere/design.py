"""Design of the atmosphere: aerosol, gases, sun, wavelengths (a frozen design)."""

import datetime
import itertools
import json
import math
from typing import Annotated, Any, Literal

from jaxtyping import Float
from pydantic import Field, model_validator

from glintrack.core.arrays import Array
from glintrack.core.designs import Design
from glintrack.core.spectral import MAX_WAVELENGTH_UM, MIN_WAVELENGTH_UM, check_wavelengths, wavelength_grid
from glintrack.io.atomic import content_hash

FORMAT_VERSION = 4  # of the solved tables: raise it whenever the same design would give other numbers
HIGHEST_SUN_ZENITH_DEG = 80.0
LOWEST_SENSOR_M, HIGHEST_SENSOR_M = 500.0, 20_000.0
GROUND_ALBEDO = 0.15
"""Mean reflectance of the Lambertian ground around, as of a city in summer. [1]"""
SCALE_HEIGHT_M = 2000.0
"""Scale height of the aerosol's extinction. [m]"""
AEROSOL_TOP_M = 30_000.0
"""Height above which there is no aerosol. [m]"""
CLOUD_THICKNESS_M, CLOUD_LAYERS = 1000.0, 40
CLOUD_EDGE_M = 50.0  # in which the extinction of the cloud rises from zero, and falls
CLOUD_ASYMMETRY = 0.864  # mean cosine of the scattering angle of droplets of 10 µm, at 0.55 µm
DEFAULT_AOD_550 = {"none": 0.0, "clear": 0.10, "maritime": 0.15, "urban": 0.50}
RAYLEIGH_EXTINCTION_550_PER_KM = 0.01159
"""Molecular extinction at 550 nm at the ground (Bucholtz, Appl. Opt. 34, 2765 (1995), Table 3). [km⁻¹]"""

_Wavelength = Annotated[
    float, Field(json_schema_extra={"minimum": MIN_WAVELENGTH_UM, "maximum": MAX_WAVELENGTH_UM})
]
_Height = Annotated[float, Field(json_schema_extra={"minimum": LOWEST_SENSOR_M, "maximum": HIGHEST_SENSOR_M})]


class AtmosphereDesign(Design):
    """An atmosphere over level ground, and the sun in it; the ``[atmosphere]`` table of a case.

    O₂, CO₂, CH₄ and N₂O are those of the US standard atmosphere. Every spectral value is a mean over 10 nm.
    """

    aerosol: Literal["none", "clear", "maritime", "urban"] = "clear"
    """clear is continental, urban is haze with soot."""
    visibility_km: float | None = Field(default=None, ge=1, le=300)
    """Meteorological range at the ground (2 % contrast at 0.55 µm); excludes aod_550."""
    aod_550: float | None = Field(default=None, ge=0, le=3)
    """Vertical aerosol optical depth at 0.55 µm; default clear 0.1, maritime 0.15, urban 0.5."""
    cloud_optical_depth: float = Field(default=0.0, ge=0, le=100)
    """Vertical optical depth at 0.55 µm of one unbroken layer of water cloud; 10 to 40 is an overcast sky."""
    cloud_base_m: float = Field(default=4000.0, ge=LOWEST_SENSOR_M, le=12_000)
    """Height of the base of the cloud above the ground; the sensor must be below it."""
    water_cm: float = Field(default=2.9, ge=0, le=10, description="Vertical column of precipitable water")
    sun_zenith_deg: float | None = Field(default=None, ge=0, le=HIGHEST_SUN_ZENITH_DEG)
    """Zenith angle of the sun; with sun_azimuth_deg, instead of place and time."""
    sun_azimuth_deg: float | None = Field(default=None, ge=-360, le=360)
    """Azimuth of the sun, clockwise from north."""
    latitude_deg: float = Field(default=43.16, ge=-90, le=90, description="Of the place, north positive")
    longitude_deg: float = Field(default=-77.61, ge=-180, le=180, description="Of the place, east positive")
    date: datetime.date = datetime.date(2010, 7, 15)
    """Sets the earth-sun distance, and with place and time the sun."""
    local_time_h: float = Field(default=15.0, ge=0, le=24)
    """Local *standard* time, also in summer (docs/guide/study.md)."""
    utc_offset_h: float | None = Field(default=None, ge=-12, le=14)
    """Of local standard time; the time zone of the longitude if left out."""
    wavelength_stop_um: float = Field(default=1.0, gt=MIN_WAVELENGTH_UM, le=MAX_WAVELENGTH_UM)
    """Last wavelength of a grid from 0.4 µm in steps of 0.01 µm."""
    wavelengths_um: tuple[_Wavelength, ...] | None = None
    """A list from 0.4 to 2.5 µm instead of that grid."""
    altitudes_m: tuple[_Height, ...] = (500.0, 1000.0, 2000.0, 3000.0, 5000.0, 10000.0)
    """Heights above the ground at which the path is tabulated, rising."""
    streams: int = Field(default=16, ge=4, le=40, description="Discrete ordinates over the full sphere, even")

    @model_validator(mode="before")
    @classmethod
    def _place_not_exchanged(cls, values: Any) -> Any:
        keys = ("latitude_deg", "longitude_deg")
        latitude, longitude = (values.get(key) if isinstance(values, dict) else None for key in keys)
        if not (isinstance(latitude, float | int) and isinstance(longitude, float | int)):
            return values
        if abs(longitude) <= 90 < abs(latitude) <= 180:
            raise ValueError(
                f"`latitude_deg` must lie within ±90°; got {latitude:g} with longitude_deg = {longitude:g}. "
                "Exchange them."
            )
        return values

    @model_validator(mode="after")
    def _consistent(self):
        if self.visibility_km is not None and self.aod_550 is not None:
            raise ValueError(
                f"`visibility_km` must not be given together with `aod_550`; got {self.visibility_km:g} km "
                f"and {self.aod_550:g}."
            )
        if self.aerosol == "none" and (self.visibility_km is not None or self.aod_550):
            raise ValueError("`aerosol` must not be 'none' where `visibility_km` or `aod_550` is given")
        if (self.sun_zenith_deg is None) != (self.sun_azimuth_deg is None):
            raise ValueError("`sun_zenith_deg` must be given with `sun_azimuth_deg`; got only one of them.")
        if self.streams % 2:
            raise ValueError(f"`streams` must be even; got {self.streams}.")
        _ = self.wavelength_um
        heights = self.altitudes_m
        rising = all(a < b for a, b in itertools.pairwise(heights))
        if not (heights and rising and LOWEST_SENSOR_M <= heights[0] and heights[-1] <= HIGHEST_SENSOR_M):
            raise ValueError(
                f"`altitudes_m` must rise within {LOWEST_SENSOR_M:g} to {HIGHEST_SENSOR_M:g} m; "
                f"got {heights}."
            )
        return self

    @property
    def wavelength_um(self) -> Float[Array, "wavelength"]:
        """Rising wavelengths of the tables. [µm]"""
        if self.wavelengths_um is not None:
            return check_wavelengths(self.wavelengths_um, "wavelengths_um")
        return wavelength_grid(MIN_WAVELENGTH_UM, self.wavelength_stop_um)

    @property
    def sensor_altitudes_m(self) -> tuple[float, ...]:
        """Altitudes of the tables: up to the base of a cloud, which is one of them. [m]"""
        if not self.cloud_optical_depth:
            return self.altitudes_m
        return (*(a for a in self.altitudes_m if a < self.cloud_base_m), self.cloud_base_m)

    @property
    def utc(self) -> datetime.datetime:
        """UTC of the date and local standard time, at which the sun stands where it does."""
        offset_h = round(self.longitude_deg / 15.0) if self.utc_offset_h is None else self.utc_offset_h
        midnight = datetime.datetime.combine(self.date, datetime.time(), datetime.UTC)
        return midnight + datetime.timedelta(hours=self.local_time_h - offset_h)

    @property
    def aerosol_optical_depth_550(self) -> float:
        """Vertical aerosol optical depth at 0.55 µm, from whichever knob was used. [1]

        References
        ----------
        Koschmieder's relation with the 2 % contrast threshold, extinction = ln(50)/visibility, less the
        molecular part, times the column of an exponential profile.
        """
        if self.aerosol == "none":
            return 0.0
        if self.visibility_km is None:
            return DEFAULT_AOD_550[self.aerosol] if self.aod_550 is None else self.aod_550
        at_ground_per_km = max(math.log(50) / self.visibility_km - RAYLEIGH_EXTINCTION_550_PER_KM, 0.0)
        column_km = SCALE_HEIGHT_M / 1e3 * (1 - math.exp(-AEROSOL_TOP_M / SCALE_HEIGHT_M))
        return at_ground_per_km * column_km

    def cloud_transmittance(self, cos_sun_zenith: float) -> float:
        """Share of the light of sun and sky that a cloud over black ground lets through, without absorption.

        References
        ----------
        Asymptotic theory of thick layers, King, J. Atmos. Sci. 44, 1734 (1987), with van de Hulst's escape
        function 3/7 (1 + 2 μ); at most 1, which it exceeds without a cloud.
        """
        escape = 3 / 7 * (1 + 2 * cos_sun_zenith)
        return min(4 / 3 * escape / ((1 - CLOUD_ASYMMETRY) * self.cloud_optical_depth + 1.43), 1.0)

    def content_key(self) -> str:
        """Hash of the design's content and of the format of its tables: the same key, the same numbers."""
        no_cloud = () if self.cloud_optical_depth else ("cloud_optical_depth", "cloud_base_m")
        values = self.model_dump(mode="json", exclude=set(no_cloud))
        content = json.dumps({"design": values, "format": FORMAT_VERSION}, sort_keys=True)
        return content_hash(content, 32)
