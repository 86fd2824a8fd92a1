"""Flight path (orbit, racetrack, straight line or waypoints), and the true pose at any time.

Altitude, off-nadir angle (the declination of Table 1 of Presnar et al., 2010) and azimuth from the sun define
the viewpoint. Every path is a function of time, also between frames.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from glintrack.camera import Pose, look_at, rotate_line_of_sight
from glintrack.core.arrays import Array
from glintrack.flight.design import FlightDesign
from glintrack.flight.waypoints import MAX_DISTANCE_M, Waypoints, read_waypoints

JITTER_HZ = 5.0, 100.0  # band of the jitter of a stabilised gimbal
_JITTER_TONES = 24  # enough that their sum is close to normal


@dataclass(frozen=True)
class Flight:
    """One flight, with its pose at any time.

    Parameters
    ----------
    design
        Path and gimbal.
    sun_azimuth_rad
        Azimuth of the sun, clockwise from north. [rad]
    waypoints
        Waypoints with times, for a design of that kind; from `build_flight`.
    seed
        Seed of the line of sight's jitter.
    """

    design: FlightDesign
    sun_azimuth_rad: float
    waypoints: Waypoints | None = None
    seed: int = 0

    def __post_init__(self):
        """Check that there are waypoints only with that kind of path."""
        if (self.waypoints is not None) != (self.design.kind == "waypoints"):
            raise ValueError(
                "`waypoints` must be given with kind = 'waypoints' and only then (see `build_flight`); got "
                f"kind = {self.design.kind!r}."
            )

    @property
    def times_s(self) -> Array:
        """Time of each frame. [s]"""
        return self.design.start_s + np.arange(self.design.frames) / self.design.rate_hz

    @property
    def mean_altitude_m(self) -> float:
        """Height of the lens above the stare point, mean over the frames. [m]"""
        if self.waypoints is None:
            return self.design.altitude_m
        ups = [self.waypoints.at(t)[0][2] for t in self.times_s]
        return float(np.mean(ups)) - self.design.stare_up_m

    @property
    def stare_point(self) -> Float[Array, "3"]:
        """Ground point on the optical axis of a staring gimbal, ENU. [m]"""
        return np.array([getattr(self.design, f"stare_{axis}_m") for axis in ("east", "north", "up")])

    def pose(self, time_s: float) -> Pose:
        """Compute the true pose at one time.

        At nadir an orbit has no circle: the aircraft then stays over the stare point, heading north (the
        paper's nadir stare).
        """
        design = self.design
        if self.waypoints is not None:
            place, (heading, roll, pitch) = self.waypoints.at(time_s)
            pose = Pose(*place.tolist(), heading_rad=heading, roll_rad=roll, pitch_rad=pitch)
        else:
            look = self.sun_azimuth_rad + math.radians(design.azimuth_from_sun_deg)
            east, north, heading = _position(design, look, time_s - design.start_s)
            position = self.stare_point + [east, north, design.altitude_m]
            pose = Pose(*position.tolist(), heading_rad=heading)
        if design.gimbal == "stare":
            pose = look_at(pose, self.stare_point)
        else:
            angles = design.gimbal_azimuth_deg, design.gimbal_depression_deg
            azimuth, depression = map(math.radians, angles)
            pose = replace(pose, gimbal_azimuth_rad=azimuth, gimbal_depression_rad=depression)
        return self._add_jitter(pose, time_s) if design.jitter_rms_urad > 0 else pose

    def _add_jitter(self, pose: Pose, time_s: float) -> Pose:
        """Displace the line of sight by a sum of tones of random phase on each axis."""
        low, high = JITTER_HZ
        rng = np.random.default_rng(np.random.SeedSequence(entropy=self.seed, spawn_key=(1 << 20,)))
        # one tone in each of equal parts of the band, at random, so that the sum has no short period
        part = np.arange(_JITTER_TONES) + rng.random((2, _JITTER_TONES))
        tone = low + (high - low) * part / _JITTER_TONES
        phase = rng.uniform(0, 2 * math.pi, (2, _JITTER_TONES))
        waves = np.cos(2 * math.pi * tone * time_s + phase).sum(axis=1)
        right, up = 1e-6 * self.design.jitter_rms_urad * math.sqrt(2 / _JITTER_TONES) * waves
        return rotate_line_of_sight(pose, right, up)


def build_flight(
    design: FlightDesign,
    sun_azimuth_rad: float,
    crs: str | None = None,
    origin_m: tuple[float, float] = (0.0, 0.0),
    seed: int = 0,
) -> Flight:
    """Build a flight, and read and check its waypoints.

    Parameters
    ----------
    design
        Path and gimbal.
    sun_azimuth_rad
        Clockwise from north. [rad]
    crs, origin_m
        The scene's projected CRS and the position of ENU (0, 0) in it, for waypoints in degrees. [m]
    seed
        Seed of the line of sight's jitter.

    Raises
    ------
    ValueError
        If the waypoint file cannot be read, or ends before the last frame.
    """
    if design.kind != "waypoints" or design.waypoint_file is None:
        return Flight(design, sun_azimuth_rad, seed=seed)
    path = Path(design.waypoint_file)
    read = read_waypoints(path, crs, origin_m, design.waypoint_datum_m or 0.0, design.start_s)
    if np.abs(read.place_m).max(initial=0) > MAX_DISTANCE_M:
        raise ValueError(
            f"`waypoint_file` must lie within {MAX_DISTANCE_M:g} m of the scene; got {path.name}."
        )
    waypoints = read.with_times(design.start_s, design.speed_m_s)
    flight, times = Flight(design, sun_azimuth_rad, waypoints, seed), np.asarray(waypoints.time_s)
    first, last = flight.times_s[0], flight.times_s[-1]
    if first < times[0] - 1e-9 or last > times[-1] + 1e-9:
        raise ValueError(
            f"`waypoint_file` must cover the frames, {first:g} to {last:g} s; got {times[0]:g} to "
            f"{times[-1]:g} s in {path.name}. See flight.frames and flight.rate_hz."
        )
    return flight


def check_waypoints(design: FlightDesign) -> None:
    """Raise ValueError for a bad waypoint file, for any scene; see `build_flight`."""
    path, world = Path(design.waypoint_file or ""), "EPSG:3857"  # has metres everywhere
    read = read_waypoints(path, world, (0.0, 0.0), design.waypoint_datum_m or 0.0, design.start_s)
    read.with_times(design.start_s, design.speed_m_s)


def check_recorded(design: FlightDesign, recording_duration_s: float) -> None:
    """Raise ValueError for a flight that is longer than the recorded traffic. [s]"""
    frames = math.floor((recording_duration_s - design.start_s) * design.rate_hz + 1e-6) + 1
    if frames < 1:
        raise ValueError(
            f"`flight.start_s` must lie within the recorded traffic, 0 to {recording_duration_s:g} s; got "
            f"{design.start_s:g}. Increase `scene.traffic_duration_s`."
        )
    if design.frames > frames:
        raise ValueError(
            f"`flight.frames` must end within the recorded traffic: at most {frames} at "
            f"{design.rate_hz:g} Hz from {design.start_s:g} to {recording_duration_s:g} s; got "
            f"{design.frames}. Use fewer, or increase `scene.traffic_duration_s`."
        )


def _position(design: FlightDesign, look: float, after_s: float) -> tuple[float, float, float]:
    """East and north of the stare point [m], and heading [rad], at a time after the first frame."""
    radius = design.altitude_m * math.tan(math.radians(design.off_nadir_deg))
    sense = 1.0 if design.direction == "clockwise" else -1.0
    viewpoint, way = look + math.pi, design.speed_m_s * after_s
    if design.kind == "orbit":
        if radius < 1e-6 * design.altitude_m:
            return 0.0, 0.0, 0.0
        viewpoint += sense * way / radius
        return radius * math.sin(viewpoint), radius * math.cos(viewpoint), viewpoint + sense * math.pi / 2
    if design.kind == "straight":  # through the viewpoint, by default on the course of an orbit there
        course = viewpoint + sense * math.pi / 2
        if design.course_deg is not None:
            course = math.radians(design.course_deg)
        east = radius * math.sin(viewpoint) + way * math.sin(course)
        return east, radius * math.cos(viewpoint) + way * math.cos(course), course
    # a racetrack: the near leg's middle is the viewpoint, the far leg is beyond it; x along the near leg,
    # y outward from the stare point, both from the viewpoint
    leg, turn = design.leg_m, design.turn_radius_m
    half_circle = math.pi * turn
    way = (way + leg / 2) % (2 * leg + 2 * math.pi * turn)
    if way < leg:
        x, y, angle = way - leg / 2, 0.0, 0.0
    elif way < leg + half_circle:
        angle = (way - leg) / turn
        x, y = leg / 2 + turn * math.sin(angle), turn * (1 - math.cos(angle))
    elif way < 2 * leg + half_circle:
        x, y, angle = leg / 2 - (way - leg - half_circle), 2 * turn, math.pi
    else:
        angle = math.pi + (way - 2 * leg - half_circle) / turn
        x, y = -leg / 2 + turn * math.sin(angle), turn * (1 - math.cos(angle))
    # clockwise, the outward side is on the right: the course of the near leg is 90° left of outward
    along = viewpoint - sense * math.pi / 2
    out = radius + y
    east = out * math.sin(viewpoint) + x * math.sin(along)
    return east, out * math.cos(viewpoint) + x * math.cos(along), along + sense * angle
