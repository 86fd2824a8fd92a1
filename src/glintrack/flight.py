"""The aircraft: a stare point, an orbit about it, and the true pose at every frame.

The position is fixed by altitude, declination from nadir and azimuth from the sun, the names of Table 1 of
Presnar et al. (2010).
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from .camera import Pose, look_at

Array = np.ndarray


class FlightDesign(BaseModel):
    """How the aircraft flies and when the shutter opens; the ``[flight]`` table of a case."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    altitude_m: float = Field(
        default=1928.0, ge=200, le=20000, description="Height of the lens above the stare point"
    )
    declination_deg: float = Field(
        default=50.0, ge=0, le=70, description="Of the line of sight from nadir at the start"
    )
    azimuth_from_sun_deg: float = Field(
        default=0.0,
        ge=-360,
        le=360,
        description="Azimuth of the line of sight from the sun's, clockwise; 0 looks toward the sun",
    )
    speed_m_s: float = Field(default=80.0, ge=0, le=400, description="Along the orbit")
    direction: Literal["clockwise", "counterclockwise"] = Field(
        default="clockwise", description="Seen from above"
    )
    stare_east_m: float = Field(default=0.0, description="Stare point, ENU")
    stare_north_m: float = Field(default=0.0, description="Stare point, ENU")
    start_s: float = Field(default=0.0, ge=0, description="Time of the first frame on the traffic's clock")
    frames: int = Field(default=60, ge=1, le=100000, description="How many frames")
    rate_hz: float = Field(default=2.0, gt=0, le=1000, description="Frames a second")


@dataclass(frozen=True)
class Flight:
    """One flight, ready to be asked for its pose at any time.

    Parameters
    ----------
    design
        The orbit.
    sun_azimuth_rad
        Where the sun stands, clockwise from north. [rad]
    """

    design: FlightDesign
    sun_azimuth_rad: float

    @property
    def times_s(self) -> Array:
        """Time of each frame. [s]"""
        return self.design.start_s + np.arange(self.design.frames) / self.design.rate_hz

    def pose(self, time_s: float) -> Pose:
        """True pose at one time, gimbal on the stare point.

        A zero declination has no orbit to fly: the aircraft then stands over the stare point, heading north
        (the paper's nadir stare).
        """
        design = self.design
        stare = np.array([design.stare_east_m, design.stare_north_m, 0.0])
        radius = design.altitude_m * math.tan(math.radians(design.declination_deg))
        if radius < 1e-6 * design.altitude_m:
            return Pose(*(stare + [0, 0, design.altitude_m]).tolist())
        sense = 1.0 if design.direction == "clockwise" else -1.0
        look = self.sun_azimuth_rad + math.radians(design.azimuth_from_sun_deg)
        station = look + math.pi + sense * design.speed_m_s * (time_s - design.start_s) / radius
        position = stare + [radius * math.sin(station), radius * math.cos(station), design.altitude_m]
        heading = station + sense * math.pi / 2
        return look_at(Pose(*position.tolist(), heading_rad=heading), stare)


def poses(design: FlightDesign, sun_azimuth_rad: float) -> tuple[Pose, ...]:
    """True pose of every frame of a flight; see `Flight`."""
    flight = Flight(design, sun_azimuth_rad)
    return tuple(flight.pose(t) for t in flight.times_s)
