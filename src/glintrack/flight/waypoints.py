"""A path through points: positions and, where known, attitude between them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array

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
