"""Run the unfinished cases of a study on any executor, and estimate time and disk space."""

import errno
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from glintrack.case.design import Case
from glintrack.case.identity import source_key
from glintrack.case.quantities import estimate_cpu_s
from glintrack.core.units import format_duration
from glintrack.study.folder import StudyFolder
from glintrack.study.hits import HitsCache, entry_size_bytes, frame_times, geometry
from glintrack.study.plan import Plan
from glintrack.study.workers import Pool, Simulate, Task, attempt, is_worker_loss, simulate_case

_POLL_S = 1.0  # interval at which interrupts and workers are checked
_WORKER_LOST = "The worker of the case was lost: killed, out of memory, or crashed."
BYTES_PER_FRAME = 20e3  # of a result, for each channel of the quickstart


@dataclass(frozen=True)
class StudyEvent:
    """Event of a run, for progress bars.

    Parameters
    ----------
    kind
        ``finished``, ``failed`` (for good), ``retried``, ``lost`` (a worker; the case is tried again) or
        ``waiting`` (the cluster has no workers).
    case_key, seconds, error
        The case, its duration, and its traceback. [s]
    """

    kind: str
    case_key: str
    seconds: float = 0.0
    error: str = ""


@dataclass
class RunReport:
    """Summary of a run.

    Parameters
    ----------
    finished_before
        Number of cases that were finished before.
    finished, failed
        Cases of this run.
    frames_read, frames_traced, bytes_kept
        Use of the cache.
    interrupted
        Whether the user stopped it.
    """

    finished_before: int = 0
    finished: int = 0
    failed: list[str] = field(default_factory=list)
    frames_read: int = 0
    frames_traced: int = 0
    bytes_kept: int = 0
    interrupted: bool = False


def run_study(
    plan: Plan,
    folder: StudyFolder,
    pool: Pool,
    cache: Path | None = None,
    simulate: Simulate = simulate_case,
    callback: Callable[[StudyEvent], None] | None = None,
) -> RunReport:
    """Simulate every case that is not finished; call it again to resume.

    Parameters
    ----------
    plan, folder
        The study, and its folder, opened.
    pool
        Executor, from `workers`.
    cache
        Folder of the hits cache; none is used without one.
    simulate
        Function of a case: at the top level of a module, so that workers can import it.
    callback
        Called after each event.

    Raises
    ------
    ValueError
        If results cannot be written (a full disk), or the cluster is gone; finished cases stay.
    """
    pending = [key for key in plan.cases if folder.outcome(key) is None]
    for key in plan.cases:
        folder.remove_failure(key)
    callback = callback or (lambda event: None)
    places = {key: geometry(plan.cases[key]) if cache else key for key in pending}
    report = RunReport(finished_before=len(plan.cases) - len(pending))
    run = _Run(plan, folder, pool, cache, simulate, callback, geometry_of=places, report=report)
    return run.drive()


def work_order(geometry_of: Mapping[str, str]) -> list[str]:
    """Order cases so that few rays are traced twice: one case of each geometry first, then the others.

    Parameters
    ----------
    geometry_of
        Address of each case's hits; geometries of many cases come first.
    """
    groups: dict[str, list[str]] = {}
    for key, place in geometry_of.items():
        groups.setdefault(place, []).append(key)
    widest = sorted(groups.values(), key=len, reverse=True)
    return [*(group[0] for group in widest), *(key for group in widest for key in group[1:])]


@dataclass
class _Run:
    """State of a run: waiting and running cases, and suspects of a worker's loss."""

    plan: Plan
    folder: StudyFolder
    pool: Pool
    cache: Path | None
    simulate: Simulate
    callback: Callable[[StudyEvent], None]
    geometry_of: Mapping[str, str]
    report: RunReport
    work: deque[str] = field(init=False)
    running: dict[Future, str] = field(default_factory=dict)
    attempts: Counter = field(default_factory=Counter)
    suspects: list[str] = field(default_factory=list)
    alone: bool = False
    uses: dict[str, Counter[float]] = field(default_factory=dict)

    def drive(self) -> RunReport:
        self.work = deque(work_order(self.geometry_of))
        try:
            while self.work or self.suspects or self.running:
                before = self.pool.slots
                self.pool.recount()
                if before and not self.pool.slots:
                    self.callback(StudyEvent("waiting", "", error="the cluster has no workers"))
                self._submit()
                if not self.running:
                    time.sleep(_POLL_S)  # a cluster without workers
                done, _ = wait(self.running, timeout=_POLL_S, return_when=FIRST_COMPLETED)
                lost = [future for future in done if not self._take(future)]
                if not self.pool.is_up():
                    self._renew()
                if lost:
                    self._recover(lost)
        except KeyboardInterrupt:
            self.report.interrupted = self.pool.abandoned = True
            for future in self.running:
                future.cancel()
        return self.report

    def _submit(self) -> None:
        # a lost worker stops all others of its pool: run one case at a time until its case is known
        self.alone = bool(self.suspects) or (self.alone and bool(self.running))
        slots = min(self.pool.slots, 1) if self.alone else self.pool.slots
        while (self.work or self.suspects) and len(self.running) < slots:
            key = self.suspects.pop(0) if self.suspects else self.work.popleft()
            case, shared = self.plan.cases[key], ()
            if self.cache:
                uses = self._uses(self.geometry_of[key])
                shared = tuple(t for t in frame_times(case.flight).tolist() if uses[t] > 1)
            folder = str(self.cache) if self.cache else None
            task = Task(key, folder, shared, self.pool.threads, source_key())
            try:
                future = self.pool.executor.submit(attempt, self.simulate, case.model_dump_json(), task)
            except Exception as error:
                if not is_worker_loss(error):
                    raise
                self.suspects.insert(0, key)
                self._renew()
                continue
            self.running[future] = key

    def _uses(self, place: str) -> Counter[float]:
        """Count the cases of this run that need each frame of a geometry."""
        if place not in self.uses:
            mine = (self.plan.cases[key].flight for key, at in self.geometry_of.items() if at == place)
            self.uses[place] = Counter(t for flight in mine for t in frame_times(flight).tolist())
        return self.uses[place]

    def _take(self, future: Future) -> bool:
        """Record the outcome of a future; return False if its worker was lost."""
        error = None if future.cancelled() else future.exception()
        if future.cancelled() or (error is not None and is_worker_loss(error)):
            return False
        key = self.running.pop(future)
        outcome = future.result()
        if "error" in outcome:
            self._fail(key, outcome["error"], outcome["seconds"])
            return True
        with self._room_for_results():
            self.folder.publish(key, outcome)
        self.report.finished += 1
        for name in ("frames_read", "frames_traced", "bytes_kept"):
            setattr(self.report, name, getattr(self.report, name) + outcome.get(name, 0))
        self.callback(StudyEvent("finished", key, outcome["seconds"]))
        return True

    @contextmanager
    def _room_for_results(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            room = " Make room and run it again." if error.errno == errno.ENOSPC else ""
            raise ValueError(
                f"`output` must have room for results; got {error.strerror or error} in "
                f"{self.folder.path}. Finished cases are saved.{room}"
            ) from error

    def _fail(self, key: str, error: str, seconds: float = 0.0) -> None:
        self.attempts[key] += 1
        with self._room_for_results():
            self.folder.record_failure(key, self.plan.cases[key], error, self.attempts[key])
        is_last = self.attempts[key] > self.plan.design.retries
        (self.report.failed if is_last else self.work).append(key)
        self.callback(StudyEvent("failed" if is_last else "retried", key, seconds, error))

    def _recover(self, lost: list[Future]) -> None:
        """After a worker's loss, count it to its case if it ran alone, else run the suspects one by one."""
        if self.pool.renew is None:  # a cluster, which has tried the case on other workers itself
            for key in [self.running.pop(future) for future in lost]:
                self._fail(key, _WORKER_LOST)
            return
        victims = list(self.running.values())
        self.running.clear()
        self._renew()
        if len(victims) == 1:
            self._fail(victims[0], _WORKER_LOST)
            return
        self.suspects[:0] = victims
        for key in victims:
            self.callback(StudyEvent("lost", key))

    def _renew(self) -> None:
        if self.pool.renew is None:
            raise ValueError(
                f"`scheduler` must stay up; got none any more at {self.pool.name}. Finished cases are saved. "
                "Run the study again to resume."
            )
        self.pool.executor = self.pool.renew()


class StudyPace:
    """Progress of a run, and an estimate of the time left.

    Parameters
    ----------
    plan, folder
        The study; the times of its finished cases are the first estimate, else `estimate_cpu_s`.
    todo
        Cases of this run.
    """

    def __init__(self, plan: Plan, folder: StudyFolder, todo: Iterable[str]):
        self._left = {key: estimate_cpu_s(plan.cases[key]) for key in todo}
        self.count, self.whole = len(self._left), sum(self._left.values())
        self._seconds = self._estimated = 0.0
        for key, case in plan.cases.items():
            outcome = None if key in self._left else folder.outcome(key)
            if outcome:
                self._seconds += float(outcome["seconds"])
                self._estimated += estimate_cpu_s(case)

    @property
    def is_measured(self) -> bool:
        """Return True if a case has finished, so that times are measured."""
        return self._estimated > 0

    @property
    def done(self) -> float:
        """Work of the cases that have ended, as `estimate_cpu_s`. [s]"""
        return self.whole - sum(self._left.values())

    def add(self, case_key: str, seconds: float | None) -> None:
        """Add the end of a case with its time, or None if it failed. [s]"""
        work = self._left.pop(case_key, 0.0)
        if seconds is not None:
            self._seconds += seconds
            self._estimated += work

    def remaining_s(self, workers: int) -> float:
        """Time until the last case ends: the work divided evenly, but at least the longest case. [s]"""
        if not self._left:
            return 0.0
        cost = self._seconds / self._estimated if self.is_measured else 1.0
        return cost * max(sum(self._left.values()) / max(workers, 1), *self._left.values())

    def summary(self, workers: int) -> str:
        """State the number of finished cases and the time left."""
        count = f"{self.count - len(self._left)}/{self.count} cases"
        return f"{count}, {format_duration(self.remaining_s(workers))} left" if self._left else count


@dataclass
class Forecast:
    """Frames and disk space of the cases to be simulated.

    Parameters
    ----------
    frames, in_cache
        Number of all frames, and of those in the cache.
    repeats
        Number of frames that an earlier case of the run traces.
    kept_bytes, result_bytes
        Rough disk space of the cache and of results. [byte]
    """

    frames: int = 0
    in_cache: int = 0
    repeats: int = 0
    kept_bytes: float = 0.0
    result_bytes: float = 0.0


def forecast(plan: Plan, keys: Iterable[str], cache: Path) -> Forecast:
    """Frames that cases will trace or read, and their disk space."""
    total = Forecast()
    places: dict[str, list[Case]] = {}
    for key in keys:
        places.setdefault(geometry(plan.cases[key]), []).append(plan.cases[key])
    for place, cases in places.items():
        entries, sensor = HitsCache(cache, place), cases[0].sensor
        uses = Counter(t for case in cases for t in frame_times(case.flight).tolist())
        new = {t: count for t, count in uses.items() if not entries.contains(t)}
        to_keep = sum(count > 1 for count in new.values())
        total.frames += uses.total()
        total.in_cache += uses.total() - sum(new.values())
        total.repeats += sum(count - 1 for count in new.values())
        total.kept_bytes += to_keep * entry_size_bytes(sensor.rows * sensor.columns, sensor.oversampling**2)
        total.result_bytes += BYTES_PER_FRAME * sum(case.flight.frames * len(case.channels) for case in cases)
    return total
