"""When a flight will be over, from what its frames took.

Frames on which the ladder is measured take longer than plain ones, and after the last frame come scores,
pictures and files. Both are known in plain frames before they are met: a measured frame of `quickstart` takes
2.3 of them, the end of 22 frames 3.3 by processor time and 7 by the clock, as frames use both cores.
"""

from dataclasses import dataclass, field

import numpy as np

from glintrack.case.design import Case

_MEASURED = 2.3  # plain frames
_END, _END_A_FRAME = 3.5, 0.06  # plain frames


@dataclass
class FlightPace:
    """Watches a flight, and says how long the rest will take.

    Parameters
    ----------
    frames
        Of the whole flight.
    every
        The ladder is measured on each such frame but the first; 0 for none.
    """

    frames: int
    every: int
    _ended: list[tuple[int, float]] = field(default_factory=list)

    @classmethod
    def of(cls, case: Case) -> "FlightPace":
        """Of a case."""
        return cls(case.flight.frames, case.bound.every)

    def ended(self, frame: int, at_s: float) -> None:
        """A frame has ended, at a time by any clock that leaves out compiling. [s]"""
        self._ended.append((frame, at_s))

    def left_s(self) -> float | None:
        """Time until everything is written; None before two frames have ended. [s]

        The first frame counts for nothing: what it took holds what is done once.
        """
        if len(self._ended) < 2:
            return None
        took: dict[bool, list[float]] = {True: [], False: []}
        for (_, before), (frame, at_s) in zip(self._ended, self._ended[1:], strict=False):
            took[self._measured(frame)].append(at_s - before)
        measured = float(np.median(took[True])) if took[True] else None
        plain = float(np.median(took[False])) if took[False] else (measured or 0.0) / _MEASURED
        if measured is None:
            measured = _MEASURED * plain
        rest = range(self._ended[-1][0] + 1, self.frames)
        frames_s = sum(measured if self._measured(frame) else plain for frame in rest)
        return frames_s + plain * (_END + _END_A_FRAME * self.frames)

    def _measured(self, frame: int) -> bool:
        return self.every > 0 and frame > 0 and frame % self.every == 0
