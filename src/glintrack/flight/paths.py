"""The path flown: orbit, racetrack, straight line or waypoints, and the true pose at any time.

The viewpoint is fixed by altitude, off-nadir angle (the declination of Table 1 of Presnar et al., 2010) and
azimuth from the sun. Every path is a function of time, so that a pose can be asked for between frames too.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from glintrack.camera import Pose, look_at, nudged
from glintrack.core.arrays import Array
from glintrack.flight.design import FlightDesign
from glintrack.flight.waypoints import Waypoints, read_waypoints

Placed = tuple[float, float, float]  # east, north less the stare point's [m], heading [rad]
JITTER_HZ = 5.0, 100.0  # band of the jitter of a stabilised gimbal
_JITTER_TONES = 24  # enough that their sum is close to normal


@dataclass(frozen=True)
class Flight:
    """One flight, ready to be asked for its pose at any time.

    Parameters
    ----------
    design
        Path and gimbal.
    sun_azimuth_rad
        Where the sun stands, clockwise from north. [rad]
    waypoints
        With times, for a design of that kind; from `build_flight`.
    seed
        Of the line of sight's jitter.
    """

    design: FlightDesign
    sun_azimuth_rad: float
    waypoints: Waypoints | None = None
    seed: int = 0

    def __post_init__(self):
        """Waypoints and the kind of path belong together."""
        if (self.waypoints is not None) != (self.design.kind == "waypoints"):
            raise ValueError(
                "`waypoints` must be given with kind = 'waypoints' and only then (see `build_flight`), got "
                f"kind = {self.design.kind!r}"
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
        """Ground point that a staring gimbal keeps on the optical axis, ENU. [m]"""
        design = self.design
        return np.array([design.stare_east_m, design.stare_north_m, design.stare_up_m])

    def pose(self, time_s: float) -> Pose:
        """True pose at one time.

        An orbit at nadir has no circle to fly: the aircraft then stands over the stare point,
        heading north (the paper's nadir stare).
        """
        airframe = self._airframe(time_s)
        if self.design.gimbal == "stare":
            pose = look_at(airframe, self.stare_point)
        else:
            pose = replace(
                airframe,
                gimbal_azimuth_rad=math.radians(self.design.gimbal_azimuth_deg),
                gimbal_depression_rad=math.radians(self.design.gimbal_depression_deg),
            )
        return self._jittered(pose, time_s) if self.design.jitter_rms_urad > 0 else pose

    def _airframe(self, time_s: float) -> Pose:
        if self.waypoints is not None:
            place, (heading, roll, pitch) = self.waypoints.at(time_s)
            return Pose(*place.tolist(), heading_rad=heading, roll_rad=roll, pitch_rad=pitch)
        path: dict[str, Callable[[FlightDesign, float, float], Placed]] = {
            "orbit": _orbit,
            "straight": _straight,
            "racetrack": _racetrack,
        }
        look = self.sun_azimuth_rad + math.radians(self.design.azimuth_from_sun_deg)
        east, north, heading = path[self.design.kind](self.design, look, time_s - self.design.start_s)
        position = self.stare_point + [east, north, self.design.altitude_m]
        return Pose(*position.tolist(), heading_rad=heading)

    def _jittered(self, pose: Pose, time_s: float) -> Pose:
        """Line of sight off its command by a sum of tones of random phase on each axis."""
        low, high = JITTER_HZ
        rng = np.random.default_rng(np.random.SeedSequence(entropy=self.seed, spawn_key=(1 << 20,)))
        # one tone somewhere in each of equal parts of the band, so that their spacing is not a period
        tone = (
            low + (high - low) * (np.arange(_JITTER_TONES) + rng.random((2, _JITTER_TONES))) / _JITTER_TONES
        )
        phase = rng.uniform(0, 2 * math.pi, (2, _JITTER_TONES))
        waves = np.cos(2 * math.pi * tone * time_s + phase).sum(axis=1)
        right, up = 1e-6 * self.design.jitter_rms_urad * math.sqrt(2 / _JITTER_TONES) * waves
        return nudged(pose, right, up)


def build_flight(
    design: FlightDesign,
    sun_azimuth_rad: float,
    crs: str | None = None,
    origin_m: tuple[float, float] = (0.0, 0.0),
    seed: int = 0,
) -> Flight:
    """A flight with its waypoints read and checked.

    Parameters
    ----------
    design
        Path and gimbal.
    sun_azimuth_rad
        Clockwise from north. [rad]
    crs, origin_m
        The scene's projected CRS and the place of ENU (0, 0) in it, for waypoints in degrees. [m]
    seed
        Of the line of sight's jitter.

    Raises
    ------
    ValueError
        If the waypoint file cannot be read, or ends before the last frame.
    """
    if design.kind != "waypoints" or design.waypoint_file is None:
        return Flight(design, sun_azimuth_rad, seed=seed)
    path = Path(design.waypoint_file)
    read = read_waypoints(path, crs, origin_m, design.waypoint_datum_m, design.start_s)
    flight = Flight(design, sun_azimuth_rad, read.timed(design.start_s, design.speed_m_s), seed)
    times = flight.waypoints.time_s if flight.waypoints else None
    first, last = flight.times_s[0], flight.times_s[-1]
    if times is None or first < times[0] - 1e-9 or last > times[-1] + 1e-9:
        raise ValueError(
            f"`waypoint_file` must cover the frames, {first:g} to {last:g} s, got "
            f"{'none' if times is None else f'{times[0]:g} to {times[-1]:g} s'} in {path.name} "
            "(see flight.frames and flight.rate_hz)"
        )
    return flight


def check_waypoints(design: FlightDesign) -> None:
    """Refuse a waypoint file that cannot be read or flown, whatever the scene; see `build_flight`."""
    path, anywhere = Path(design.waypoint_file or ""), "EPSG:3857"  # degrees into metres all over the world
    read = read_waypoints(path, anywhere, (0.0, 0.0), design.waypoint_datum_m, design.start_s)
    read.timed(design.start_s, design.speed_m_s)


def check_recorded(design: FlightDesign, recorded_s: float) -> None:
    """Refuse a flight that lasts longer than the traffic under it is recorded. [s]"""
    frames = math.floor((recorded_s - design.start_s) * design.rate_hz + 1e-6) + 1
    if frames < 1:
        raise ValueError(
            f"`flight.start_s` must lie within the recorded traffic, 0 to {recorded_s:g} s, got "
            f"{design.start_s:g} (SUMO records longer by `scene.traffic_duration_s`)"
        )
    if design.frames > frames:
        raise ValueError(
            f"`flight.frames` must end within the recorded traffic: at most {frames} at "
            f"{design.rate_hz:g} Hz from {design.start_s:g} to {recorded_s:g} s, got {design.frames} "
            "(fly fewer; SUMO records longer by `scene.traffic_duration_s`)"
        )


def _radius(design: FlightDesign) -> float:
    """Distance on the ground from the stare point to the viewpoint. [m]"""
    return design.altitude_m * math.tan(math.radians(design.off_nadir_deg))


def _sense(design: FlightDesign) -> float:
    return 1.0 if design.direction == "clockwise" else -1.0


def _orbit(design: FlightDesign, look: float, after_s: float) -> Placed:
    radius, sense = _radius(design), _sense(design)
    if radius < 1e-6 * design.altitude_m:
        return 0.0, 0.0, 0.0
    viewpoint = look + math.pi + sense * design.speed_m_s * after_s / radius
    return radius * math.sin(viewpoint), radius * math.cos(viewpoint), viewpoint + sense * math.pi / 2


def _straight(design: FlightDesign, look: float, after_s: float) -> Placed:
    """Through the viewpoint at the first frame; by default on the course an orbit would start with."""
    radius, viewpoint = _radius(design), look + math.pi
    course = viewpoint + _sense(design) * math.pi / 2
    if design.course_deg is not None:
        course = math.radians(design.course_deg)
    way = design.speed_m_s * after_s
    east = radius * math.sin(viewpoint) + way * math.sin(course)
    return east, radius * math.cos(viewpoint) + way * math.cos(course), course


def _racetrack(design: FlightDesign, look: float, after_s: float) -> Placed:
    """Two legs and two half circles; the near leg's middle is the viewpoint, the far leg lies beyond it."""
    leg, turn, viewpoint = design.leg_m, design.turn_radius_m, look + math.pi
    way = (design.speed_m_s * after_s + leg / 2) % (2 * leg + 2 * math.pi * turn)
    half_circle = math.pi * turn
    # x along the near leg as flown, y outward from the stare point, both from the viewpoint
    if way < leg:
        x, y, turned = way - leg / 2, 0.0, 0.0
    elif way < leg + half_circle:
        turned = (way - leg) / turn
        x, y = leg / 2 + turn * math.sin(turned), turn * (1 - math.cos(turned))
    elif way < 2 * leg + half_circle:
        x, y, turned = leg / 2 - (way - leg - half_circle), 2 * turn, math.pi
    else:
        turned = math.pi + (way - 2 * leg - half_circle) / turn
        x, y = -leg / 2 + turn * math.sin(turned), turn * (1 - math.cos(turned))
    sense = _sense(design)
    # turning clockwise, the outward side is on the right: the near leg is flown 90° left of outward
    along = viewpoint - sense * math.pi / 2
    out = _radius(design) + y
    east = out * math.sin(viewpoint) + x * math.sin(along)
    return east, out * math.cos(viewpoint) + x * math.cos(along), along + sense * turned
