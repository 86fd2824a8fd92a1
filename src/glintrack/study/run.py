"""Run what of a study is not finished yet, on any executor, and estimate its cost."""

import errno
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from glintrack.case.design import Case
from glintrack.core.units import format_duration
from glintrack.study.folder import StudyFolder
from glintrack.study.hits import HitsCache, frame_times, geometry, packed_bytes
from glintrack.study.plan import Plan, source_key
from glintrack.study.workers import Fly, Pool, Task, attempt, fly_case, is_worker_loss

_LOOK_S = 1.0  # how often an interrupt is looked for while nothing ends
_WORKER_LOST = "The worker that flew the case was lost: killed, out of memory, or crashed."
# processor time on one core, of flights of quickstart with 3 × 3 rays and of an eighth of its rays: imports,
# city, sky; an element of a frame with three channels; each of its rays; a frame of the loss budget over a
# plain one
ROUGH_BUILD_S, ROUGH_SECONDS_AN_ELEMENT, ROUGH_SECONDS_A_RAY, ROUGH_BUDGET = 9.0, 3e-6, 0.7e-6, 2.3
ROUGH_BYTES_A_FRAME = 20e3  # of a result, for each channel of the quickstart


@dataclass(frozen=True)
class StudyEvent:
    """What just happened, for whoever watches.

    Parameters
    ----------
    kind
        ``finished``, ``failed`` (for good), ``retried``, ``lost`` (a worker, the case is tried again) or
        ``waiting`` (for workers, of which the cluster has none at the time).
    case_key, seconds, error
        Of the case.
    """

    kind: str
    case_key: str
    seconds: float = 0.0
    error: str = ""


@dataclass
class RunReport:
    """How a run went.

    Parameters
    ----------
    found
        Cases that were finished before.
    finished, failed
        Cases of this run.
    frames_read, frames_traced, bytes_kept
        What the cache saved and holds.
    interrupted
        Whether the user stopped it.
    """

    found: int = 0
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
    fly: Fly = fly_case,
    callback: Callable[[StudyEvent], None] | None = None,
) -> RunReport:
    """Fly every case that is not finished; call it again to resume.

    Parameters
    ----------
    plan, folder
        What to fly, and the folder, opened.
    pool
        Where; from `workers`.
    cache
        Folder of kept hits; none are kept without one.
    fly
        What a case is: a module's own function, so that workers can import it.
    callback
        Called after each event.

    Raises
    ------
    ValueError
        If results cannot be written any more (a full disk), or the cluster is gone; what is finished stays.
    """
    report, pending = RunReport(), []
    for key in plan.cases:
        if folder.outcome(key) is None:
            pending.append(key)
        else:
            report.found += 1
        folder.remove_failure(key)
    run = _Run(
        plan=plan,
        folder=folder,
        pool=pool,
        cache=cache,
        fly=fly,
        callback=callback or (lambda event: None),
        report=report,
        pending=pending,
    )
    return run.drive()


def work_order(keys: Iterable[str], geometry_of: Mapping[str, str]) -> list[str]:
    """Order cases so that few rays are traced twice: one case of each geometry first, then the others.

    Parameters
    ----------
    keys
        Cases to do.
    geometry_of
        What each case's hits are addressed by; widely shared geometries come before others.
    """
    groups: dict[str, list[str]] = {}
    for key in keys:
        groups.setdefault(geometry_of[key], []).append(key)
    widest = sorted(groups.values(), key=len, reverse=True)
    return [*(group[0] for group in widest), *(key for group in widest for key in group[1:])]


@dataclass
class _Run:
    """State of one run: what is pending, what flies, who is suspected of killing workers."""

    plan: Plan
    folder: StudyFolder
    pool: Pool
    cache: Path | None
    fly: Fly
    callback: Callable[[StudyEvent], None]
    report: RunReport
    pending: list[str]
    geometry_of: Mapping[str, str] = field(init=False)
    work: deque[str] = field(init=False)
    flying: dict[Future, str] = field(default_factory=dict)
    attempts: Counter = field(default_factory=Counter)
    suspects: list[str] = field(default_factory=list)
    alone: bool = False
    asked: dict[str, Counter[float]] = field(default_factory=dict)

    def drive(self) -> RunReport:
        cases = self.plan.cases
        self.geometry_of = {key: geometry(case) if self.cache else key for key, case in cases.items()}
        self.work = deque(work_order(self.pending, self.geometry_of))
        try:
            while self.work or self.suspects or self.flying:
                self._recount()
                self._submit()
                if not self.flying:
                    time.sleep(_LOOK_S)  # nobody works: a cluster without workers
                done, _ = wait(self.flying, timeout=_LOOK_S, return_when=FIRST_COMPLETED)
                lost = [future for future in done if not self._take(future)]
                if not self.pool.is_up():
                    self._renew()
                if lost:
                    self._recover(lost)
        except KeyboardInterrupt:
            self.report.interrupted = self.pool.abandoned = True
            for future in self.flying:
                future.cancel()
        return self.report

    def _recount(self) -> None:
        before = self.pool.slots
        self.pool.recount()
        if before and not self.pool.slots:
            self.callback(StudyEvent("waiting", "", error="the cluster has no workers"))

    def _submit(self) -> None:
        # a worker died and took its neighbours along: until it is known by which case, one flies at a time
        self.alone = bool(self.suspects) or (self.alone and bool(self.flying))
        while (self.work or self.suspects) and len(self.flying) < self._room():
            key = self.suspects.pop(0) if self.suspects else self.work.popleft()
            try:
                future = self._start(key)
            except Exception as error:
                if not is_worker_loss(error):
                    raise
                self.suspects.insert(0, key)
                self._renew()
                continue
            self.flying[future] = key

    def _room(self) -> int:
        return min(self.pool.slots, 1) if self.alone else self.pool.slots

    def _start(self, key: str) -> Future:
        case = self.plan.cases[key]
        place = self.geometry_of[key]
        shared: tuple[float, ...] = ()
        if self.cache:
            asked = self._asked(place)
            shared = tuple(t for t in frame_times(case.flight).tolist() if asked[t] > 1)
        folder = str(self.cache) if self.cache else None
        task = Task(key, folder, shared, self.pool.threads, source_key())
        return self.pool.executor.submit(attempt, self.fly, case.model_dump_json(), task)

    def _asked(self, place: str) -> Counter[float]:
        """How many cases of this run need each frame of a geometry."""
        if place not in self.asked:
            mine = (self.plan.cases[key].flight for key in self.pending if self.geometry_of[key] == place)
            self.asked[place] = Counter(t for flight in mine for t in frame_times(flight).tolist())
        return self.asked[place]

    def _take(self, future: Future) -> bool:
        """Deal with a future that is done; False if its worker was lost."""
        error = None if future.cancelled() else future.exception()
        if future.cancelled() or (error is not None and is_worker_loss(error)):
            return False
        key = self.flying.pop(future)
        if error is not None:
            raise error
        outcome = future.result()
        if "error" in outcome:
            self._failed(key, outcome["error"], outcome["seconds"])
            return True
        with self._room_for_results():
            self.folder.publish(key, outcome)
        self.report.finished += 1
        self.report.frames_read += outcome.get("frames_read", 0)
        self.report.frames_traced += outcome.get("frames_traced", 0)
        self.report.bytes_kept += outcome.get("bytes_kept", 0)
        self.callback(StudyEvent("finished", key, outcome["seconds"]))
        return True

    @contextmanager
    def _room_for_results(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            room = " (make room and run it again)" if error.errno == errno.ENOSPC else ""
            raise ValueError(
                f"`output` must have room for results, got {error.strerror or error} in "
                f"{self.folder.path}; finished cases are kept{room}"
            ) from error

    def _failed(self, key: str, error: str, seconds: float = 0.0) -> None:
        self.attempts[key] += 1
        with self._room_for_results():
            self.folder.record_failure(key, self.plan.cases[key], error, self.attempts[key])
        if self.attempts[key] <= self.plan.design.retries:
            self.work.append(key)
            self.callback(StudyEvent("retried", key, seconds, error))
        else:
            self.report.failed.append(key)
            self.callback(StudyEvent("failed", key, seconds, error))

    def _recover(self, lost: list[Future]) -> None:
        """A worker is gone: blame its case if it flew alone, else fly the suspected ones one by one."""
        if self.pool.renew is None:  # a cluster, which has tried the case on other workers itself
            keys = [self.flying.pop(future) for future in lost]
            for key in keys:
                self._failed(key, _WORKER_LOST)
            return
        victims = list(self.flying.values())
        self.flying.clear()
        self._renew()
        if len(victims) == 1:
            self._failed(victims[0], _WORKER_LOST)
            return
        self.suspects[:0] = victims
        for key in victims:
            self.callback(StudyEvent("lost", key))

    def _renew(self) -> None:
        if self.pool.renew is None:
            raise ValueError(
                f"`scheduler` must stay up, got none any more at {self.pool.name}; finished cases are kept "
                "(run the study again to resume)"
            )
        self.pool.executor = self.pool.renew()


class StudyPace:
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
            outcome = None if key in self._left else folder.outcome(key)
            if outcome:
                self._seconds += float(outcome["seconds"])
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
        return f"{count}, {format_duration(self.left_s(workers))} left" if self._left else count


def rough_s(case: Case) -> float:
    """Processor time of a whole flight, roughly: what cases are weighed by before any has been flown. [s]"""
    sensor, frames, every = case.sensor, case.flight.frames, case.bound.every
    measured = (frames - 1) // every if every else 0
    an_element = ROUGH_SECONDS_AN_ELEMENT + ROUGH_SECONDS_A_RAY * sensor.oversampling**2
    frame_s = sensor.rows * sensor.columns * an_element
    return ROUGH_BUILD_S + frame_s * (frames + (ROUGH_BUDGET - 1) * measured)


@dataclass(frozen=True)
class Forecast:
    """What cases that are to be flown will take.

    Parameters
    ----------
    frames, held
        All frames, and those in the cache.
    repeats
        Frames that some case has traced before another asks for them.
    kept_bytes, result_bytes
        Disk space of frames that are kept, and of results, roughly. [byte]
    """

    frames: int = 0
    held: int = 0
    repeats: int = 0
    kept_bytes: float = 0.0
    result_bytes: float = 0.0


def foresee(plan: Plan, keys: Iterable[str], cache: Path) -> Forecast:
    """Frames that the given cases will trace or read, and the disk space that they will take."""
    found = Forecast()
    places: dict[str, list[Case]] = {}
    for key in keys:
        places.setdefault(geometry(plan.cases[key]), []).append(plan.cases[key])
    for place, mine in places.items():
        kept, sensor = HitsCache(cache, place), mine[0].sensor
        asked = Counter(t for case in mine for t in frame_times(case.flight).tolist())
        there = {t for t in asked if kept.holds(t)}
        to_keep = sum(count > 1 and t not in there for t, count in asked.items())
        shown = sum(case.flight.frames * len(case.channels) for case in mine)
        found = Forecast(
            frames=found.frames + asked.total(),
            held=found.held + sum(asked[t] for t in there),
            repeats=found.repeats + sum(asked[t] - 1 for t in asked if t not in there),
            kept_bytes=found.kept_bytes
            + to_keep * packed_bytes(sensor.rows * sensor.columns, sensor.oversampling**2),
            result_bytes=found.result_bytes + ROUGH_BYTES_A_FRAME * shown,
        )
    return found
