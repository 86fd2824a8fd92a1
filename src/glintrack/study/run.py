"""Run what of a study is not finished yet, on any executor, and survive what can happen on the way."""

import errno
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from glintrack.case.design import Case
from glintrack.render import Sampling
from glintrack.study.estimate import rays_an_element
from glintrack.study.folder import StudyFolder
from glintrack.study.hits import HitsCache, frame_times, geometry, packed_bytes, shared_samplings
from glintrack.study.order import WorkQueue
from glintrack.study.plan import Plan
from glintrack.study.source import source_key
from glintrack.study.task import Fly, Task, attempt, fly_case
from glintrack.study.workers import Pool, is_worker_loss

_LOOK_S = 1.0  # how often an interrupt is looked for while nothing ends
_WORKER_LOST = "The worker that flew the case was lost: killed, out of memory, or crashed."


@dataclass(frozen=True)
class Event:
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
class Report:
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
    callback: Callable[[Event], None] | None = None,
) -> Report:
    """Fly every case that is not finished; call it again to resume.

    Parameters
    ----------
    plan, folder
        What to fly, and the folder, opened.
    pool
        Where; from `executors`.
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
    report, pending = Report(), []
    for key in plan.cases:
        if folder.finished(key) is None:
            pending.append(key)
        else:
            report.found += 1
        folder.forget_failure(key)
    return _Run(plan, folder, pool, cache, fly, callback or _ignored, report, pending).drive()


def _ignored(event: Event) -> None:
    """Nobody looks."""


def geometries(cases: Mapping[str, Case]) -> dict[str, str]:
    """What each case's hits are addressed by."""
    samplings = shared_samplings(cases)
    return {key: geometry(case, samplings[key]) for key, case in cases.items()}


@dataclass
class _Run:
    """State of one run: what is pending, what flies, who is suspected of killing workers."""

    plan: Plan
    folder: StudyFolder
    pool: Pool
    cache: Path | None
    fly: Fly
    callback: Callable[[Event], None]
    report: Report
    pending: list[str]
    geometry_of: Mapping[str, str] = field(init=False)
    samplings: Mapping[str, Sampling | None] = field(init=False)
    work: WorkQueue = field(init=False)
    flying: dict[Future, str] = field(default_factory=dict)
    attempts: Counter = field(default_factory=Counter)
    suspects: list[str] = field(default_factory=list)
    alone: bool = False
    asked: dict[str, Counter[float]] = field(default_factory=dict)

    def drive(self) -> Report:
        self.samplings = shared_samplings(self.plan.cases) if self.cache else {}
        self.geometry_of = (
            geometries(self.plan.cases) if self.cache else {key: key for key in self.plan.cases}
        )
        self.work = WorkQueue(self.pending, self.geometry_of)
        try:
            while len(self.work) or self.suspects or self.flying:
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
            self.callback(Event("waiting", "", error="the cluster has no workers"))

    def _submit(self) -> None:
        # a worker died and took its neighbours along: until it is known by which case, one flies at a time
        self.alone = bool(self.suspects) or (self.alone and bool(self.flying))
        while (len(self.work) or self.suspects) and len(self.flying) < self._room():
            key = self.suspects.pop(0) if self.suspects else self.work.pop()
            try:
                future = self.pool.executor.submit(attempt, self.fly, self._json(key), self._errand(key))
            except Exception as error:
                if not is_worker_loss(error):
                    raise
                self.suspects.insert(0, key)
                self._renew()
                continue
            self.flying[future] = key

    def _room(self) -> int:
        return min(self.pool.slots, 1) if self.alone else self.pool.slots

    def _json(self, key: str) -> str:
        return self.plan.cases[key].model_dump_json()

    def _errand(self, key: str) -> Task:
        place = self.geometry_of[key]
        shared: tuple[float, ...] = ()
        if self.cache and self.work.left(place):
            asked, mine = self._asked(place), frame_times(self.plan.cases[key].flight).tolist()
            shared = tuple(t for t in mine if asked[t] > 1)
        sampling = self.samplings[key] if self.cache else None
        folder = str(self.cache) if self.cache else None
        return Task(key, folder, shared, self.pool.threads, source_key(), sampling)

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
        told = future.result()
        if "error" in told:
            self._failed(key, told["error"], told["seconds"])
            return True
        self._publish(key, told)
        self.work.traced(self.geometry_of[key])
        self.report.finished += 1
        self.report.frames_read += told.get("frames_read", 0)
        self.report.frames_traced += told.get("frames_traced", 0)
        self.report.bytes_kept += told.get("bytes_kept", 0)
        self.callback(Event("finished", key, told["seconds"]))
        return True

    def _publish(self, key: str, told: Mapping[str, Any]) -> None:
        try:
            self.folder.publish(key, told)
        except OSError as error:
            room = " (make room and run it again)" if error.errno == errno.ENOSPC else ""
            raise ValueError(
                f"`output` must have room for results, got {error.strerror or error} at case {key} in "
                f"{self.folder.path}; finished cases are kept{room}"
            ) from error

    def _failed(self, key: str, error: str, seconds: float = 0.0) -> None:
        self.attempts[key] += 1
        try:
            self.folder.note_failure(key, self.plan.cases[key], error, self.attempts[key])
        except OSError as fault:
            raise ValueError(
                f"`output` must have room for results, got {fault.strerror or fault} in {self.folder.path}; "
                "finished cases are kept"
            ) from fault
        if self.attempts[key] <= self.plan.design.retries:
            self.work.push(key)
            self.callback(Event("retried", key, seconds, error))
        else:
            self.report.failed.append(key)
            self.callback(Event("failed", key, seconds, error))

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
            self.callback(Event("lost", key))

    def _renew(self) -> None:
        if self.pool.renew is None:
            raise ValueError(
                f"`scheduler` must stay up, got none any more at {self.pool.name}; finished cases are kept "
                "(run the study again to resume)"
            )
        self.pool.executor = self.pool.renew()


@dataclass(frozen=True)
class HitsAtHand:
    """Frames of cases that are to be flown.

    Parameters
    ----------
    frames, held
        All of them, and those in the cache.
    repeats
        Frames that some case has traced before another asks for them.
    bytes_to_keep
        What they will fill on the disk, roughly. [byte]
    """

    frames: int
    held: int
    repeats: int
    bytes_to_keep: float


def hits_at_hand(plan: Plan, keys: Iterable[str], cache: Path) -> HitsAtHand:
    """What the cache of hits will save the given cases, and what it will take."""
    places: dict[str, list[str]] = {}
    places_of = geometries(plan.cases)
    for key in keys:
        places.setdefault(places_of[key], []).append(key)
    frames = held = repeats = 0
    size = 0.0
    for place, mine in places.items():
        kept = HitsCache(cache, place)
        asked = Counter(t for key in mine for t in frame_times(plan.cases[key].flight).tolist())
        there = {t for t in asked if kept.holds(t)}
        frames += asked.total()
        held += sum(asked[t] for t in there)
        repeats += sum(asked[t] - 1 for t in asked if t not in there)
        sensor = plan.cases[mine[0]].sensor
        a_frame = packed_bytes(sensor.rows * sensor.columns, rays_an_element(plan.cases[mine[0]]))
        to_keep = sum(count > 1 and t not in there for t, count in asked.items())
        size += to_keep * a_frame
    return HitsAtHand(frames, held, repeats, size)
