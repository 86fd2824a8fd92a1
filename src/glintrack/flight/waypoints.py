"""A path through points, from CSV or KML: positions and, where known, attitude between them.

CSV is in ENU metres or in degrees; KML is a line, or a track with times. Nothing is guessed: a column
without its unit in its name, an altitude that hangs on the ground below (``clampToGround``) or a point
without altitude is refused.
"""

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.io.crs import change_crs
from glintrack.io.tables import read_csv
from glintrack.io.untrusted import plain, read_text

_COINCIDENT_M = 1e-6


@dataclass(frozen=True)
class Waypoints:
    """Places that an aircraft passes, in the order flown.

    Parameters
    ----------
    place_m
        East, north, up of each. [m]
    time_s
        When it is passed, on the clock of the case; None if the file does not say: then it is passed at the
        design's speed, the first at the first frame. [s]
    attitude_rad
        Heading, roll, pitch at each; None if the file does not say: then the nose points along the path,
        wings level. [rad]
    """

    place_m: Float[Array, "point 3"]
    time_s: Float[Array, "point"] | None = None
    attitude_rad: Float[Array, "point 3"] | None = None

    def timed(self, start_s: float, speed_m_s: float) -> "Waypoints":
        """The same points with a time each.

        Raises
        ------
        ValueError
            If there are fewer than two, two coincide, or the speed is nought where times are needed.
        """
        if len(self.place_m) < 2:
            raise ValueError(f"`waypoint_file` must hold two waypoints or more, got {len(self.place_m)}")
        if self.time_s is not None:
            late = np.flatnonzero(np.diff(self.time_s) <= 0)
            if late.size:
                raise ValueError(
                    f"`waypoint_file` must have rising times, got {self.time_s[late[0] + 1]:g} s after "
                    f"{self.time_s[late[0]]:g} s"
                )
            return self
        step = np.linalg.norm(np.diff(self.place_m, axis=0), axis=1)
        if (step < _COINCIDENT_M).any():
            raise ValueError(
                "`waypoint_file` must not hold the same place twice in a row without times, got "
                f"{self.place_m[int(step.argmin())].round(3).tolist()} twice"
            )
        if speed_m_s <= 0:
            raise ValueError("`flight.speed_m_s` must be positive to fly waypoints without times, got 0")
        time_s = start_s + np.concatenate([[0.0], np.cumsum(step)]) / speed_m_s
        return Waypoints(self.place_m, time_s, self.attitude_rad)

    def at(self, time_s: float) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Place [m] and heading, roll, pitch [rad] at one time, straight on beyond the ends."""
        times = self.time_s
        if times is None:
            raise ValueError("`waypoints` must have times before they are flown, got none (see `timed`)")
        k = int(np.clip(np.searchsorted(times, time_s, side="right") - 1, 0, len(times) - 2))
        part = (time_s - times[k]) / (times[k + 1] - times[k])
        step = self.place_m[k + 1] - self.place_m[k]
        place = self.place_m[k] + part * step
        if self.attitude_rad is None:
            return place, np.array([self._course(k), 0.0, 0.0])
        first, last = self.attitude_rad[k], self.attitude_rad[k + 1]
        turn = np.remainder(last - first + np.pi, 2 * np.pi) - np.pi  # the short way round
        return place, first + np.clip(part, 0, 1) * turn

    def _course(self, k: int) -> float:
        """Course of a leg; that of the leg before where it goes straight up or stands still."""
        while k >= 0:
            east, north, _ = self.place_m[k + 1] - self.place_m[k]
            if np.hypot(east, north) > _COINCIDENT_M:
                return float(np.arctan2(east, north))
            k -= 1
        return 0.0


ENU = ("east_m", "north_m", "up_m")
GEOGRAPHIC = ("longitude_deg", "latitude_deg", "altitude_m")
_FARTHEST_M, _LONGEST_S = 1e7, 1e11
ATTITUDE = ("heading_deg", "roll_deg", "pitch_deg")


def read_waypoints(
    path: Path, crs: str | None, origin_m: tuple[float, float], datum_m: float, start_s: float
) -> Waypoints:
    """Waypoints of a CSV or KML file in ENU.

    Parameters
    ----------
    path
        ``.csv`` or ``.kml``.
    crs, origin_m
        Projected CRS of the scene and the place of ENU (0, 0) in it, needed for longitudes. [m]
    datum_m
        Height of ENU zero in the file's altitudes; not used where the file itself counts from the ground
        (``relativeToGround``) or is in ENU. [m]
    start_s
        Time of the first frame; the first of a KML track's times is put there. [s]

    Raises
    ------
    ValueError
        In one sentence: what is wrong with the file.
    """
    readers = {".csv": _read_csv, ".kml": _read_kml}
    if path.suffix.lower() not in readers:
        raise ValueError(f"`waypoint_file` must end in .csv or .kml, got {path.name!r}")

    def to_enu(degrees: Array, datum: float) -> Array:
        if crs is None:
            raise ValueError(
                "`waypoint_file` must be in east_m, north_m, up_m over a scene without a CRS, got longitudes"
            )
        project = change_crs("EPSG:4326", crs)
        x, y = project.transform(degrees[:, 0], degrees[:, 1])
        enu = np.stack([np.subtract(x, origin_m[0]), np.subtract(y, origin_m[1]), degrees[:, 2] - datum], -1)
        if not np.isfinite(enu).all():
            raise ValueError(f"`waypoint_file` must lie within the reach of {crs}, got places outside it")
        return enu

    try:
        found = readers[path.suffix.lower()](path, to_enu, datum_m, start_s)
    except ValueError as error:
        raise ValueError(plain(error, 500)) from error
    if np.abs(found.place_m).max(initial=0) > _FARTHEST_M:
        raise ValueError(f"`waypoint_file` must lie within {_FARTHEST_M:g} m of the scene, got {path.name}")
    if found.time_s is not None and np.abs(found.time_s).max(initial=0) > _LONGEST_S:
        raise ValueError(f"`waypoint_file` must have times within ±{_LONGEST_S:g} s, got {path.name}")
    return found


def _read_csv(path: Path, to_enu, datum_m: float, start_s: float) -> Waypoints:
    name, table = path.name, read_csv(path, "waypoint_file", types=str)
    header = [] if table.empty else list(table.columns)
    places = [names for names in (ENU, GEOGRAPHIC) if set(names) <= set(header)]
    known = {*ENU, *GEOGRAPHIC, *ATTITUDE, "time_s"}
    stray = [key for key in header if key not in known]
    if len(places) != 1 or stray:
        raise ValueError(
            f"`waypoint_file` must have the columns {', '.join(ENU)} or {', '.join(GEOGRAPHIC)}, and may "
            f"have time_s, {', '.join(ATTITUDE)}, got {', '.join(header) or 'none'} in {name}"
        )

    def columns(names) -> Array:
        try:
            values = table[list(names)].map(float).to_numpy()
        except ValueError as error:
            raise ValueError(
                f"`waypoint_file` must hold numbers under {', '.join(names)}, got {error} in {name}"
            ) from error
        if not np.isfinite(values).all():
            raise ValueError(f"`waypoint_file` must hold finite numbers under {', '.join(names)}, got {name}")
        return values

    place = columns(places[0]) if places[0] is ENU else to_enu(columns(GEOGRAPHIC), datum_m)
    attitude = [key for key in ATTITUDE if key in header]
    if attitude and len(attitude) < len(ATTITUDE):
        raise ValueError(f"`waypoint_file` must give all of {', '.join(ATTITUDE)} or none, got {attitude}")
    return Waypoints(
        place,
        columns(("time_s",))[:, 0] if "time_s" in header else None,
        np.radians(columns(ATTITUDE)) if attitude else None,
    )


def _read_kml(path: Path, to_enu, datum_m: float, start_s: float) -> Waypoints:
    name, text = path.name, read_text(path, "waypoint_file")
    try:
        root = fromstring(text)
    except (ParseError, DefusedXmlException, ValueError) as error:
        raise ValueError(f"`waypoint_file` must be plain KML, got {name}: {error}") from error
    track = next((e for e in root.iter() if _tag(e) == "Track"), None)
    line = next((e for e in root.iter() if _tag(e) == "LineString"), None)
    found = track if track is not None else line
    if found is None:
        raise ValueError(f"`waypoint_file` must hold a LineString or a gx:Track, got neither in {name}")
    mode = next((str(e.text).strip() for e in found if _tag(e) == "altitudeMode"), "clampToGround")
    if mode not in ("absolute", "relativeToGround"):
        raise ValueError(
            f"`waypoint_file` must have altitudeMode absolute or relativeToGround, got {mode} in {name}"
        )
    if track is None:
        texts = str(next((e.text for e in found if _tag(e) == "coordinates"), "") or "").split()
        degrees = _triples([t.split(",") for t in texts], name)
        time_s = None
    else:
        degrees = _triples([str(e.text).split() for e in track if _tag(e) == "coord"], name)
        when = [_seconds(str(e.text), name) for e in track if _tag(e) == "when"]
        if len(when) != len(degrees):
            raise ValueError(
                f"`waypoint_file` must have a time for each place of its track, got {len(when)} times and "
                f"{len(degrees)} places in {name}"
            )
        time_s = start_s + np.array(when) - when[0] if when else None
    return Waypoints(to_enu(degrees, datum_m if mode == "absolute" else 0.0), time_s)


def _tag(element: Element) -> str:
    return str(element.tag).rpartition("}")[2]


def _triples(texts: list[list[str]], name: str) -> Array:
    try:
        values = np.array([[float(v) for v in text] for text in texts], float)
        if values.ndim != 2 or values.shape[1] != 3 or not np.isfinite(values).all():
            raise ValueError("a place without longitude, latitude and altitude")
    except ValueError as error:
        raise ValueError(
            f"`waypoint_file` must give longitude, latitude and altitude of each place, got {error} in {name}"
        ) from error
    return values


def _seconds(text: str, name: str) -> float:
    try:
        when = datetime.fromisoformat(text.strip().replace("Z", "+00:00"))
    except ValueError as error:
        raise ValueError(f"`waypoint_file` must have times as in ISO 8601, got {text!r} in {name}") from error
    return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()
