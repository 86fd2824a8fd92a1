"""The ``[flight]`` table of a case: the path, the gimbal, and when the shutter opens."""

import math
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from glintrack.core.designs import Design, refuse_ignored
from glintrack.core.schema import EARTH_RADIUS_M
from glintrack.io.untrusted import resolve_path

MIN_ALTITUDE_M, MAX_ALTITUDE_M = 200.0, 20_000.0
# keys by the choice, and its values, that use them
_USES = {
    ("kind", ("straight",)): ["course_deg"],
    ("kind", ("racetrack",)): ["leg_m", "turn_radius_m"],
    ("kind", ("waypoints",)): ["waypoint_datum_m"],
    ("kind", ("orbit", "racetrack", "straight")): ["azimuth_from_sun_deg", "direction"],
    ("gimbal", ("fixed",)): ["gimbal_azimuth_deg", "gimbal_depression_deg"],
}
_EARTH_GM = 3.986004e14  # m³ s⁻² (IERS 2010)


class FlightDesign(Design):
    """Path, gimbal and frame times; the ``[flight]`` table of a case.

    Altitude, off-nadir angle (the declination of Table 1) and azimuth from the sun put the aircraft at its
    *viewpoint*. An orbit starts there and keeps its distance; a straight flight and a racetrack pass it at
    the first frame.
    """

    kind: Literal["orbit", "racetrack", "straight", "waypoints"] = "orbit"
    """Shape of the path."""
    altitude_m: float = Field(default=1928.0, ge=MIN_ALTITUDE_M, le=MAX_ALTITUDE_M)
    """Height of the lens above the stare point, up to the highest of atmosphere.altitudes_m."""
    off_nadir_deg: float = Field(default=50.0, ge=0, le=70)
    """Angle of the line of sight from nadir at the viewpoint."""
    azimuth_from_sun_deg: float = Field(default=0.0, ge=-360, le=360)
    """Azimuth of the line of sight from the sun's, clockwise; 0 looks toward the sun."""
    speed_m_s: float = Field(default=80.0, ge=0, le=400, description="Speed along the path")
    direction: Literal["clockwise", "counterclockwise"] = "clockwise"
    """Sense of the path, seen from above."""
    stare_east_m: float = Field(default=0.0, ge=-1e6, le=1e6, description="Stare point, ENU")
    stare_north_m: float = Field(default=0.0, ge=-1e6, le=1e6, description="Stare point, ENU")
    stare_up_m: float = Field(default=0.0, ge=-500, le=9000, description="Stare point, ENU")
    course_deg: float | None = Field(default=None, ge=-360, le=360)
    """Course of a straight flight, clockwise from north; across the line of sight if left out."""
    leg_m: float = Field(default=4000.0, gt=0, le=1e5, description="Straight legs of a racetrack")
    turn_radius_m: float = Field(default=1000.0, gt=0, le=5e4)
    """Half circles of a racetrack, between its legs."""
    waypoint_file: str | None = None
    """CSV or KML with the path, relative to the case (docs/guide/case.md)."""
    waypoint_datum_m: float | None = Field(default=None, ge=-1000, le=20000)
    """Height of ENU zero in the waypoint file's altitudes; by default that of the ground at the origin, if
    `scene.dem_file` gives it, else 0."""
    gimbal: Literal["stare", "fixed"] = "stare"
    """Pointed at the stare point, or at fixed angles to the airframe."""
    gimbal_azimuth_deg: float = Field(default=0.0, ge=-360, le=360)
    """Azimuth of a fixed gimbal, clockwise from the nose."""
    gimbal_depression_deg: float = Field(default=90.0, gt=0, le=90)
    """Angle of a fixed gimbal below the airframe's horizon."""
    jitter_rms_urad: float = Field(default=0.0, ge=0, le=1e4)
    """True jitter of the line of sight about the stare point, RMS of each axis."""
    start_s: float = Field(default=0.0, ge=0, le=1e6)
    """Time of the first frame on the traffic's clock."""
    frames: int = Field(default=60, ge=1, le=100000, description="Number of frames")
    rate_hz: float = Field(default=2.0, gt=0, le=1000, description="Frame rate")

    @field_validator("altitude_m", mode="before")
    @classmethod
    def _refuse_orbits(cls, value: Any) -> Any:
        """Say what to do about an altitude that only satellites or low drones have."""
        if isinstance(value, (int, float)) and 0 < value < MIN_ALTITUDE_M:
            scale = MIN_ALTITUDE_M / value
            units = " If it is in km, write it in m." if value <= MAX_ALTITUDE_M / 1000 else ""
            raise ValueError(
                f"`flight.altitude_m` must be at least {MIN_ALTITUDE_M:g} m; got {value:g} m.{units} "
                "Lower views are outside the model's range. To approximate the sampling of one, fly at "
                f"{MIN_ALTITUDE_M:g} m with `sensor.focal_length_mm` × {scale:.3g} (docs/howto/my_camera.md)."
            )
        if isinstance(value, (int, float)) and MAX_ALTITUDE_M < value < 1e8:
            scale, radius_m = 10_000 / value, EARTH_RADIUS_M + value
            ground_m_s = math.sqrt(_EARTH_GM / radius_m) * EARTH_RADIUS_M / radius_m
            raise ValueError(
                f"`flight.altitude_m` must be at most {MAX_ALTITUDE_M:,.0f} m; got {value:,.0f} m. "
                "Orbits are outside the model's range. To approximate a satellite with the same sampling and "
                f"change of view, fly at 10,000 m with `sensor.focal_length_mm` × {scale:.3g}, `flight.kind` "
                f"= 'straight' and `flight.speed_m_s` = {ground_m_s * scale:.3g} (docs/howto/my_camera.md)."
            )
        return value

    @model_validator(mode="after")
    def _keys_fit_the_kind(self) -> Self:
        if (self.kind == "waypoints") != (self.waypoint_file is not None):
            raise ValueError(
                "`flight.waypoint_file` must be given with kind = 'waypoints' and only then; got "
                f"kind = {self.kind!r} and {self.waypoint_file!r}."
            )
        refuse_ignored(self, _USES)
        return self

    def resolve_files(self, folder: Path) -> "FlightDesign":
        """Resolve a relative file name from a folder."""
        if self.waypoint_file is None:
            return self
        return self.model_copy(update={"waypoint_file": str(resolve_path(folder / self.waypoint_file))})
