"""Estimate of a study's cost, from the times of its finished cases."""

from collections.abc import Iterable

from glintrack.case.design import Case
from glintrack.io.messages import in_words
from glintrack.study.folder import StudyFolder
from glintrack.study.plan import Plan

# processor time on one core, of flights of quickstart with 3 × 3 rays and of an eighth of its rays: imports,
# city, sky; an element of a frame with three channels; each of its rays; a frame of the ladder, in plain ones
ROUGH_BUILD_S, ROUGH_SECONDS_AN_ELEMENT, ROUGH_SECONDS_A_RAY, ROUGH_LADDER = 9.0, 3e-6, 0.7e-6, 2.3
ROUGH_FURTHER_RAYS = 20.0  # of an element of the quickstart beyond four, times sensor.sampling_error
ROUGH_BYTES_A_FRAME = 20e3  # of a result, for each channel of the quickstart


def rays_an_element(case: Case) -> float:
    """Mean over a frame; of the embedded city's streets where `sampling_error` decides."""
    sensor = case.sensor
    if sensor.oversampling:
        return sensor.oversampling**2
    return 4.0 + ROUGH_FURTHER_RAYS / sensor.sampling_error


def rough_s(case: Case) -> float:
    """Processor time of a whole flight, roughly: what cases are weighed by before any has been flown. [s]"""
    sensor, frames, every = case.sensor, case.flight.frames, case.bound.every
    measured = (frames - 1) // every if every else 0
    an_element = ROUGH_SECONDS_AN_ELEMENT + ROUGH_SECONDS_A_RAY * rays_an_element(case)
    frame_s = sensor.rows * sensor.columns * an_element
    return ROUGH_BUILD_S + frame_s * (frames + (ROUGH_LADDER - 1) * measured)


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
        self._work = {key: rough_s(plan.cases[key]) for key in todo}
        self._left = dict(self._work)
        self.whole = sum(self._work.values())
        self._seconds = self._flown = 0.0
        for key, case in plan.cases.items():
            told = None if key in self._left else folder.finished(key)
            if told:
                self._seconds += float(told["seconds"])
                self._flown += rough_s(case)

    @property
    def measured(self) -> bool:
        """Whether a case has finished from which the cost of others follows."""
        return self._flown > 0

    @property
    def done(self) -> float:
        """Work of cases that have ended, as `rough_s` weighs it. [s]"""
        return self.whole - sum(self._left.values())

    def ended(self, case_key: str, seconds: float | None) -> None:
        """A case has finished within a time, or failed for good, which says nothing of the cost. [s]"""
        work = self._left.pop(case_key, 0.0)
        if seconds is not None:
            self._seconds += seconds
            self._flown += work

    def left_s(self, workers: int) -> float:
        """Time until the last case ends: the work shared evenly, but no less than the longest case. [s]"""
        if not self._left:
            return 0.0
        cost = self._seconds / self._flown if self.measured else 1.0
        return cost * max(sum(self._left.values()) / max(workers, 1), *self._left.values())

    def summary(self, workers: int) -> str:
        """Cases and time left, for whoever watches."""
        count = f"{len(self._work) - len(self._left)}/{len(self._work)} cases"
        return f"{count}, {in_words(self.left_s(workers))} left" if self._left else count


def result_bytes(plan: Plan, folder: StudyFolder, todo: Iterable[str]) -> float:
    """Room that the results of some cases will take, as finished ones do. [byte]"""
    waiting, size, frames = set(todo), 0.0, 0
    for key, case in plan.cases.items():
        if key not in waiting:
            size += folder.size(key)
            frames += case.flight.frames * len(case.channels)
    each = size / frames if frames else ROUGH_BYTES_A_FRAME
    return each * sum(plan.cases[key].flight.frames * len(plan.cases[key].channels) for key in waiting)
