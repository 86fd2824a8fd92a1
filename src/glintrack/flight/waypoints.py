"""Flight path through waypoints from CSV or KML: positions and, if given, attitudes between them.

CSV is in ENU metres or in degrees; KML is a line, or a track with times. Columns without units, points
without altitude, and altitudes relative to unknown ground (``clampToGround``) are errors.
"""

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring
from jaxtyping import Float

from glintrack.camera import Pose, from_yaw_pitch_roll, rotation
from glintrack.core.arrays import Array
from glintrack.io.crs import change_crs, check_not_exchanged
from glintrack.io.readings import report_reading
from glintrack.io.tables import read_csv, read_numbers
from glintrack.io.untrusted import plain, read_text

_MIN_STEP_M = 1e-6


@dataclass(frozen=True)
class Waypoints:
    """Waypoints in order.

    Parameters
    ----------
    place_m
        East, north, up of each. [m]
    time_s
        Time of each on the clock of the case; None for the design's speed from the first frame. [s]
    attitude_rad
        Heading, roll, pitch at each; None for a nose along the path and level wings. [rad]
    """

    place_m: Float[Array, "point 3"]
    time_s: Float[Array, "point"] | None = None
    attitude_rad: Float[Array, "point 3"] | None = None

    def with_times(self, start_s: float, speed_m_s: float) -> "Waypoints":
        """Check the waypoints, and compute their times if they have none.

        Raises
        ------
        ValueError
            If there are fewer than two, two coincide, or the speed is 0 and times are needed.
        """
        if len(self.place_m) < 2:
            raise ValueError(f"`waypoint_file` must hold two waypoints or more; got {len(self.place_m)}.")
        if self.time_s is not None:
            late = np.flatnonzero(np.diff(self.time_s) <= 0)
            if late.size:
                raise ValueError(
                    f"`waypoint_file` must have rising times; got {self.time_s[late[0] + 1]:g} s after "
                    f"{self.time_s[late[0]]:g} s."
                )
            return self
        step = np.linalg.norm(np.diff(self.place_m, axis=0), axis=1)
        if (step < _MIN_STEP_M).any():
            raise ValueError(
                "`waypoint_file` must not hold the same place twice in a row without times; got "
                f"{self.place_m[int(step.argmin())].round(3).tolist()} twice."
            )
        if speed_m_s <= 0:
            raise ValueError("`flight.speed_m_s` must be positive for waypoints without times; got 0.")
        time_s = start_s + np.concatenate([[0.0], np.cumsum(step)]) / speed_m_s
        return Waypoints(self.place_m, time_s, self.attitude_rad)

    def at(self, time_s: float) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Interpolate or extrapolate the position [m] and heading, roll, pitch [rad] at one time."""
        times = np.asarray(self.time_s)
        k = int(np.clip(np.searchsorted(times, time_s, side="right") - 1, 0, len(times) - 2))
        part = (time_s - times[k]) / (times[k + 1] - times[k])
        step = self.place_m[k + 1] - self.place_m[k]
        place = self.place_m[k] + part * step
        if self.attitude_rad is None:
            return place, np.array([self._course(k), 0.0, 0.0])
        first, last = self.attitude_rad[k], self.attitude_rad[k + 1]
        turn = np.remainder(last - first + np.pi, 2 * np.pi) - np.pi
        return place, first + np.clip(part, 0, 1) * turn

    def _course(self, k: int) -> float:
        """Course of a leg; that of the leg before for a vertical or empty leg."""
        for i in range(k, -1, -1):
            east, north, _ = self.place_m[i + 1] - self.place_m[i]
            if np.hypot(east, north) > _MIN_STEP_M:
                return float(np.arctan2(east, north))
        return 0.0


ENU = ("east_m", "north_m", "up_m")
GEOGRAPHIC = ("longitude_deg", "latitude_deg", "altitude_m")
MAX_DISTANCE_M = 1e7  # from the origin of a scene
_MAX_PLACE_M, _MAX_TIME_S = 1e8, 1e11  # of any projection
ATTITUDE = ("heading_deg", "roll_deg", "pitch_deg")
ORDERS = ("heading-roll-pitch", "yaw-pitch-roll")
_SAME_ATTITUDE_RAD = 1e-4  # a pixel of 12 µm behind a lens of 120 mm
_SAME_PLACE_DEG = 1e-9


def read_waypoints(
    path: Path, crs: str | None, origin_m: tuple[float, float], datum_m: float, start_s: float
) -> Waypoints:
    """Read the waypoints of a CSV or KML file in ENU.

    Parameters
    ----------
    path
        ``.csv`` or ``.kml``.
    crs, origin_m
        Projected CRS of the scene and the position of ENU (0, 0) in it, needed for longitudes. [m]
    datum_m
        Height of ENU zero in the file's altitudes; not used for altitudes ``relativeToGround`` or ENU. [m]
    start_s
        Time of the first frame, and of the first point of a KML track. [s]

    Raises
    ------
    ValueError
        If the file is missing, damaged, incomplete or out of range.
    """
    readers = {".csv": _read_csv, ".kml": _read_kml}
    if path.suffix.lower() not in readers:
        raise ValueError(f"`waypoint_file` must end in .csv or .kml; got {path.name!r}.")

    def to_enu(degrees: Array, datum: float) -> Array:
        if crs is None:
            raise ValueError(
                "`waypoint_file` must be in east_m, north_m, up_m over a scene without a CRS; got longitudes."
            )
        if len(degrees):
            longitude_deg, latitude_deg, _ = np.median(degrees, axis=0).tolist()
            check_not_exchanged(crs, longitude_deg, latitude_deg, "waypoint_file")
        project = change_crs("EPSG:4326", crs)
        x, y = project.transform(degrees[:, 0], degrees[:, 1])
        enu = np.stack([np.subtract(x, origin_m[0]), np.subtract(y, origin_m[1]), degrees[:, 2] - datum], -1)
        if not np.isfinite(enu).all():
            raise ValueError(f"`waypoint_file` must lie within the reach of {crs}; got places outside it.")
        return enu

    try:
        found = readers[path.suffix.lower()](path, to_enu, datum_m, start_s)
    except ValueError as error:
        raise ValueError(plain(error, 500)) from error
    if np.abs(found.place_m).max(initial=0) > _MAX_PLACE_M:
        raise ValueError(
            f"`waypoint_file` must have coordinates within ±{_MAX_PLACE_M:g} m; got {path.name}."
        )
    if found.time_s is not None and np.abs(found.time_s).max(initial=0) > _MAX_TIME_S:
        raise ValueError(f"`waypoint_file` must have times within ±{_MAX_TIME_S:g} s; got {path.name}.")
    return found


def _read_csv(path: Path, to_enu, datum_m: float, start_s: float) -> Waypoints:
    name, table = path.name, read_csv(path, "waypoint_file", types=str)
    header = [] if table.empty else list(table.columns)
    places = [names for names in (ENU, GEOGRAPHIC) if set(names) <= set(header)]
    unknown = set(header) - {*sum(places, ()), *ATTITUDE, "time_s", "order"}
    if len(places) != 1 or unknown:
        raise ValueError(
            f"`waypoint_file` must have the columns {', '.join(ENU)} or {', '.join(GEOGRAPHIC)}, and may "
            f"have time_s, {', '.join(ATTITUDE)}, order; got {', '.join(header) or 'none'} in {name}."
        )
    place = read_numbers(table, path, places[0])
    place = place if places[0] is ENU else to_enu(place, datum_m)
    attitude = [key for key in ATTITUDE if key in header]
    if attitude and len(attitude) < len(ATTITUDE):
        raise ValueError(f"`waypoint_file` must give all of {', '.join(ATTITUDE)} or none; got {attitude}.")
    time_s = read_numbers(table, path, ("time_s",))[:, 0] if "time_s" in header else None
    report_reading(path, "points", len(place), len(place), notes=[f"columns {', '.join(header)}"])
    if not attitude:
        return Waypoints(place, time_s)
    orders = sorted({str(one).strip() for one in table["order"]}) if "order" in header else []
    angles_rad = np.radians(read_numbers(table, path, ATTITUDE))
    return Waypoints(place, time_s, _in_our_order(angles_rad, orders, name))


def _in_our_order(angles_rad: Float[Array, "point 3"], orders: list[str], name: str) -> Array:
    """Convert heading, roll and pitch to our order; refuse them without an order if that matters. [rad]"""
    if orders == [ORDERS[0]]:
        return angles_rad
    if orders and orders != [ORDERS[1]]:
        raise ValueError(f"`order` must be {' or '.join(ORDERS)} in all rows; got {orders[0]!r} in {name}.")
    given = [Pose(0.0, 0.0, 0.0, *angles) for angles in angles_rad.tolist()]
    turned = [from_yaw_pitch_roll(pose) for pose in given]
    apart_rad = [np.linalg.norm(rotation(a) - rotation(b)) for a, b in zip(given, turned, strict=True)]
    if orders:
        return np.array([(pose.heading_rad, pose.roll_rad, pose.pitch_rad) for pose in turned])
    if max(apart_rad, default=0.0) > math.sqrt(2) * _SAME_ATTITUDE_RAD:
        raise ValueError(
            f"`waypoint_file` must have a column `order`, {' or '.join(ORDERS)} (as of inertial systems); "
            f"got none in {name}. The orders differ by {math.degrees(max(apart_rad)) / math.sqrt(2):.2g}°."
        )
    return angles_rad


@dataclass(frozen=True)
class _Part:
    """A line or track of a KML: tag, altitude mode, places, and times of a track. [°, m, s]"""

    tag: str
    mode: str
    degrees: Float[Array, "point 3"]
    seconds: Float[Array, "point"] | None


def _read_kml(path: Path, to_enu, datum_m: float, start_s: float) -> Waypoints:
    name, text = path.name, read_text(path, "waypoint_file")
    try:
        root = fromstring(text)
    except (ParseError, DefusedXmlException, ValueError) as error:
        raise ValueError(f"`waypoint_file` must be plain KML; got {name}: {error}.") from error
    elements = [e for e in root.iter() if _tag(e) in ("LineString", "Track")]
    if not elements:
        raise ValueError(f"`waypoint_file` must hold a LineString or a gx:Track; got neither in {name}.")
    multi = [e for e in root.iter() if _tag(e) == "MultiTrack"]
    modes = {track: _mode(parent, "clampToGround") for parent in multi for track in parent}
    parts = [_read_part(element, name, modes.get(element, "clampToGround")) for element in elements]
    if not all(_follows(a, b, len(multi) == 1) for a, b in pairwise(parts)):
        texts = (f"{part.tag} of {len(part.degrees)} points" for part in parts[:6])
        raise ValueError(
            f"`waypoint_file` must hold one line or track, or lines end to end; got {len(parts)} parts in "
            f"{name}: {', '.join(texts)}. Keep one."
        )
    first = parts[0]
    shared = [0] + [int(first.seconds is None)] * (len(parts) - 1)  # the last point of the line before
    degrees = np.concatenate([part.degrees[k:] for part, k in zip(parts, shared, strict=True)])
    angles = sum(_tag(e) == "angles" and bool(str(e.text or "").strip()) for e in root.iter())
    report_reading(
        path,
        "points",
        sum(len(part.degrees) for part in parts),
        len(degrees),
        {"ends that two lines share": sum(shared)},
        [f"{len(parts)} parts"] + [f"{angles} gx:angles are not used"] * (angles > 0),
    )
    times = [part.seconds for part in parts if part.seconds is not None]
    time_s = start_s + np.concatenate(times) - times[0][0] if times else None
    return Waypoints(to_enu(degrees, datum_m if first.mode == "absolute" else 0.0), time_s)


def _follows(a: _Part, b: _Part, is_one_multitrack: bool) -> bool:
    """Return True if a part goes on where, or in one gx:MultiTrack after, another ends."""
    if (a.tag, a.mode) != (b.tag, b.mode) or not (len(a.degrees) and len(b.degrees)):
        return False
    if a.tag == "LineString":
        return bool(np.abs(a.degrees[-1] - b.degrees[0]).max() <= _SAME_PLACE_DEG)
    if a.seconds is None or b.seconds is None or not is_one_multitrack:
        return False
    return bool(a.seconds[-1] < b.seconds[0])


def _mode(element: Element, default: str) -> str:
    return next((str(e.text).strip() for e in element if _tag(e) == "altitudeMode"), default)


def _read_part(element: Element, name: str, default_mode: str) -> _Part:
    """Read a LineString or gx:Track."""
    mode = _mode(element, default_mode)
    if mode not in ("absolute", "relativeToGround"):
        raise ValueError(
            f"`waypoint_file` must have altitudeMode absolute or relativeToGround; got {mode} in {name}."
        )
    if _tag(element) == "LineString":
        texts = str(next((e.text for e in element if _tag(e) == "coordinates"), "") or "").split()
        return _Part("LineString", mode, _triples([t.split(",") for t in texts], name), None)
    degrees = _triples([str(e.text).split() for e in element if _tag(e) == "coord"], name)
    try:
        when = [datetime.fromisoformat(str(e.text).strip()) for e in element if _tag(e) == "when"]
    except ValueError as error:
        raise ValueError(f"`waypoint_file` must have times as in ISO 8601; got {error} in {name}.") from error
    if len(when) != len(degrees):
        raise ValueError(
            f"`waypoint_file` must have a time for each place of its track; got {len(when)} times and "
            f"{len(degrees)} places in {name}."
        )
    seconds = [(t if t.tzinfo else t.replace(tzinfo=UTC)).timestamp() for t in when]
    return _Part("Track", mode, degrees, np.array(seconds) if when else None)


def _tag(element: Element) -> str:
    return str(element.tag).rpartition("}")[2]


def _triples(texts: list[list[str]], name: str) -> Array:
    try:
        values = np.array([[float(v) for v in text] for text in texts], float)
        if values.ndim != 2 or values.shape[1] != 3 or not np.isfinite(values).all():
            raise ValueError("a place without longitude, latitude and altitude")
    except ValueError as error:
        raise ValueError(
            f"`waypoint_file` must give longitude, latitude and altitude of each place; "
            f"got {error} in {name}."
        ) from error
    return values
