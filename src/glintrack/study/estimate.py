"""Estimate of a study's cost, from the times of its finished cases."""

from collections.abc import Iterable

from glintrack.config import Case
from glintrack.study.folder import StudyFolder
from glintrack.study.plan import Plan

# of the quickstart with both channels on one core; benchmarks/study.py measures it
ROUGH_SECONDS_A_RAY = 2e-6
ROUGH_FURTHER_RAYS = 20.0  # of an element of the quickstart beyond four, times sensor.sampling_error
ROUGH_BYTES_A_FRAME = 20e3  # of a result, for each channel of the quickstart


def rays_an_element(case: Case) -> float:
    """Mean over a frame; of the embedded city's streets where `sampling_error` decides."""
    sensor = case.sensor
    if sensor.oversampling:
        return sensor.oversampling**2
    return 4.0 + ROUGH_FURTHER_RAYS / sensor.sampling_error


def rays(case: Case) -> int:
    """Rays of a whole flight, to which most of its cost is proportional."""
    sensor = case.sensor
    return round(sensor.rows * sensor.columns * rays_an_element(case) * case.flight.frames)


class Pace:
    """How much of a run is done, and when the rest will be.

    Parameters
    ----------
    plan, folder
        The study; what its finished cases took is the first estimate, a rough figure if there is none.
    todo
        Cases of this run.
    """

    def __init__(self, plan: Plan, folder: StudyFolder, todo: Iterable[str]):
        self._work = {key: rays(plan.cases[key]) for key in todo}
        self._left = dict(self._work)
        self.whole = sum(self._work.values())
        self._seconds = self._flown = 0.0
        for key, case in plan.cases.items():
            told = None if key in self._left else folder.finished(key)
            if told:
                self._seconds += float(told["seconds"])
                self._flown += rays(case)

    @property
    def measured(self) -> bool:
        """Whether a case has finished from which the cost of others follows."""
        return self._flown > 0

    @property
    def done(self) -> int:
        """Rays of cases that have ended."""
        return self.whole - sum(self._left.values())

    def ended(self, case_key: str, seconds: float | None) -> None:
        """A case has finished within a time, or failed for good, which says nothing of the cost. [s]"""
        work = self._left.pop(case_key, 0)
        if seconds is not None:
            self._seconds += seconds
            self._flown += work

    def left_s(self, workers: int) -> float:
        """Time until the last case ends: the work shared evenly, but no less than the longest case. [s]"""
        if not self._left:
            return 0.0
        cost = self._seconds / self._flown if self.measured else ROUGH_SECONDS_A_RAY
        return cost * max(sum(self._left.values()) / max(workers, 1), *self._left.values())

    def summary(self, workers: int) -> str:
        """Cases and time left, for whoever watches."""
        count = f"{len(self._work) - len(self._left)}/{len(self._work)} cases"
        return f"{count}, {in_words(self.left_s(workers))} left" if self._left else count


def in_words(seconds: float) -> str:
    """A time, roughly: ``40 s``, ``12 min``, ``3.4 h``."""
    if seconds < 90:
        return f"{max(round(seconds, -1), 10):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def result_bytes(plan: Plan, folder: StudyFolder, todo: Iterable[str]) -> float:
    """Room that the results of some cases will take, as finished ones do. [byte]"""
    waiting, size, frames = set(todo), 0.0, 0
    for key, case in plan.cases.items():
        if key not in waiting:
            size += folder.size(key)
            frames += case.flight.frames * len(case.channels)
    each = size / frames if frames else ROUGH_BYTES_A_FRAME
    return each * sum(plan.cases[key].flight.frames * len(plan.cases[key].channels) for key in waiting)
