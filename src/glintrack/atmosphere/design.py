"""Design of the atmosphere: aerosol, gases, sun, ground, wavelengths (a frozen design)."""

import datetime
import itertools
import json
import math
from typing import Annotated, Any, Literal

from jaxtyping import Float
from pydantic import Field, field_validator, model_validator

from glintrack.core.arrays import Array
from glintrack.core.designs import Design
from glintrack.core.spectral import LONGEST_UM, SHORTEST_UM, check_wavelengths, wavelength_grid
from glintrack.io.digest import content_hash

AEROSOLS = ("none", "clear", "maritime", "urban")
FORMAT_VERSION = 2  # of the solved tables: raise it whenever the same design would give other numbers
HIGHEST_SUN_ZENITH_DEG = 80.0
LOWEST_SENSOR_M, HIGHEST_SENSOR_M = 500.0, 20_000.0
SCALE_HEIGHT_M = 2000.0
"""Scale height of the aerosol's extinction. [m]"""
AEROSOL_TOP_M = 30_000.0
"""Height above which there is no aerosol. [m]"""
DEFAULT_AOD_550 = {"none": 0.0, "clear": 0.10, "maritime": 0.15, "urban": 0.50}
RAYLEIGH_EXTINCTION_550_PER_KM = 0.01159
"""Molecular extinction at 550 nm at the ground (Bucholtz, Appl. Opt. 34, 2765 (1995), Table 3). [km⁻¹]"""

_RANGES: dict[str, tuple[float, float, str]] = {
    "visibility_km": (1.0, 300.0, "km"),
    "aod_550": (0.0, 3.0, "of optical depth"),
    "water_cm": (0.0, 10.0, "cm of precipitable water"),
    "ozone_du": (0.0, 700.0, "Dobson units"),
    "sun_zenith_deg": (0.0, HIGHEST_SUN_ZENITH_DEG, "degrees"),
    "sun_azimuth_deg": (-360.0, 360.0, "degrees"),
    "latitude_deg": (-90.0, 90.0, "degrees"),
    "longitude_deg": (-180.0, 180.0, "degrees"),
    "local_time_h": (0.0, 24.0, "hours"),
    "utc_offset_h": (-12.0, 14.0, "hours"),
    "ground_albedo": (0.0, 0.99, "of reflectance"),
    "wavelength_start_um": (SHORTEST_UM, LONGEST_UM, "µm"),
    "wavelength_stop_um": (SHORTEST_UM, LONGEST_UM, "µm"),
    "wavelength_step_um": (0.001, LONGEST_UM - SHORTEST_UM, "µm"),
}


def _ranged(key: str, default: Any) -> Any:
    """A field whose range the schema shows; `_within_range` holds it, in the range's unit."""
    low, high, _ = _RANGES[key]
    return Field(default=default, json_schema_extra={"minimum": low, "maximum": high})


_Wavelength = Annotated[float, Field(json_schema_extra={"minimum": SHORTEST_UM, "maximum": LONGEST_UM})]
_Height = Annotated[float, Field(json_schema_extra={"minimum": LOWEST_SENSOR_M, "maximum": HIGHEST_SENSOR_M})]


class AtmosphereDesign(Design):
    """An atmosphere over level ground, and the sun in it; the ``[atmosphere]`` table of a case.

    O₂, CO₂, CH₄ and N₂O are those of the US standard atmosphere. Every spectral value is a mean over 10 nm.
    """

    aerosol: Literal["none", "clear", "maritime", "urban"] = "clear"
    """clear is continental, urban is haze with soot; see `atmosphere.aerosol.MIXTURES`."""
    visibility_km: float | None = _ranged("visibility_km", None)
    """Meteorological range at the ground (2 % contrast at 0.55 µm); excludes aod_550."""
    aod_550: float | None = _ranged("aod_550", None)
    """Vertical aerosol optical depth at 0.55 µm; 0.10 clear, 0.15 maritime, 0.50 urban by default."""
    water_cm: float = _ranged("water_cm", 2.9)
    """Vertical column of precipitable water."""
    ozone_du: float = _ranged("ozone_du", 320.0)
    """Vertical column of ozone, in Dobson units."""
    sun_zenith_deg: float | None = _ranged("sun_zenith_deg", None)
    """Where the sun stands, from the zenith; with sun_azimuth_deg, instead of place and time."""
    sun_azimuth_deg: float | None = _ranged("sun_azimuth_deg", None)
    """Where the sun stands, clockwise from north."""
    latitude_deg: float = _ranged("latitude_deg", 43.16)
    """Of the place, which gives the sun where it is not given."""
    longitude_deg: float = _ranged("longitude_deg", -77.61)
    """Of the place, east positive."""
    date: datetime.date = datetime.date(2010, 7, 15)
    """Sets the earth-sun distance, and with place and time the sun."""
    local_time_h: float = _ranged("local_time_h", 15.0)
    """Local *standard* time, also in summer (docs/study.md, "The hours of Table 1")."""
    utc_offset_h: float | None = _ranged("utc_offset_h", None)
    """Of local standard time; by default the time zone of the longitude."""
    ground_albedo: float = _ranged("ground_albedo", 0.15)
    """Mean reflectance of the ground around, Lambertian."""
    wavelength_start_um: float = _ranged("wavelength_start_um", 0.4)
    """First wavelength of an even grid."""
    wavelength_stop_um: float = _ranged("wavelength_stop_um", 1.0)
    """Last wavelength of an even grid."""
    wavelength_step_um: float = _ranged("wavelength_step_um", 0.01)
    """Step of an even grid."""
    wavelengths_um: tuple[_Wavelength, ...] | None = None
    """A list of wavelengths from 0.4 to 2.5 µm instead of an even grid."""
    altitudes_m: tuple[_Height, ...] = (
        500.0,
        1000.0,
        2000.0,
        3000.0,
        5000.0,
        10000.0,
    )
    """Heights above the ground at which the path is tabulated, rising."""
    streams: int = Field(default=16, ge=4, le=40)
    """Discrete ordinates over the full sphere, even."""
    adjacency: bool = True
    """Whether the ground around the target brightens the path."""

    @field_validator("aerosol", mode="before")
    @classmethod
    def _known_aerosol(cls, value):
        if value not in AEROSOLS:
            raise ValueError(f"`aerosol` must be one of {', '.join(AEROSOLS)}, got {value!r}")
        return value

    @field_validator(*_RANGES, mode="after")
    @classmethod
    def _within_range(cls, value, info):
        low, high, unit = _RANGES[info.field_name]
        if value is not None and not low <= value <= high:
            remedy = "; the sun must stand above 10° elevation" if info.field_name == "sun_zenith_deg" else ""
            raise ValueError(
                f"`{info.field_name}` must lie within {low:g} to {high:g} {unit}, got {value:g}{remedy}"
            )
        return value

    @model_validator(mode="after")
    def _consistent(self):
        if self.visibility_km is not None and self.aod_550 is not None:
            raise ValueError(
                f"`visibility_km` must not be given together with `aod_550`, got {self.visibility_km:g} km "
                f"and {self.aod_550:g}"
            )
        if self.aerosol == "none" and (self.visibility_km is not None or self.aod_550):
            raise ValueError("`aerosol` must not be 'none' where `visibility_km` or `aod_550` is given")
        if (self.sun_zenith_deg is None) != (self.sun_azimuth_deg is None):
            raise ValueError("`sun_zenith_deg` must be given with `sun_azimuth_deg`, got only one of them")
        if self.streams % 2:
            raise ValueError(f"`streams` must be even, got {self.streams}")
        _ = self.wavelength_um
        heights = self.altitudes_m
        rising = all(a < b for a, b in itertools.pairwise(heights))
        if not (heights and rising and LOWEST_SENSOR_M <= heights[0] and heights[-1] <= HIGHEST_SENSOR_M):
            raise ValueError(
                f"`altitudes_m` must rise within {LOWEST_SENSOR_M:g} to {HIGHEST_SENSOR_M:g} m, got {heights}"
            )
        return self

    @property
    def wavelength_um(self) -> Float[Array, "wavelength"]:
        """Rising wavelengths of the tables. [µm]"""
        if self.wavelengths_um is not None:
            return check_wavelengths(self.wavelengths_um, "wavelengths_um")
        return wavelength_grid(self.wavelength_start_um, self.wavelength_stop_um, self.wavelength_step_um)

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

    def content_key(self) -> str:
        """Hash of the design's content and of the format of its tables: the same key, the same numbers."""
        content = json.dumps(
            {"design": self.model_dump(mode="json"), "format": FORMAT_VERSION}, sort_keys=True
        )
        return content_hash(content, 32)


def rochester_summer(local_time_h: Literal[12, 15, 17] = 15, **changes) -> AtmosphereDesign:
    """The paper's atmosphere: Rochester, NY, 15 July, at 12, 15 or 17 h local standard time.

    Parameters
    ----------
    local_time_h
        Hour of the case. [h]
    changes
        Any other key of `AtmosphereDesign`.
    """
    return AtmosphereDesign(local_time_h=local_time_h, **changes)
