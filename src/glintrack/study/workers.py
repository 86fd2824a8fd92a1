"""Simulate cases on workers: in this process, in others of this machine, or on a Dask cluster."""

import contextlib
import json
import multiprocessing
import multiprocessing.connection
import os
import platform
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numba
import numpy as np
import xarray as xr

from glintrack.bounds.run import FlightBudget
from glintrack.case.design import Case
from glintrack.core.installation import require_extra
from glintrack.io import netcdf
from glintrack.io.toml import to_toml
from glintrack.loop import simulate
from glintrack.study.hits import HitsCache, geometry
from glintrack.study.plan import source_key

try:
    import resource
except ImportError:  # not on Windows, where a worker's memory has no bound
    resource = None  # type: ignore[assignment]
_CONNECT_S = 10.0
_MEMORY_SHARE = 0.8
# read when the libraries are loaded, so they have to be set before a worker starts
_THREAD_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_OF_THE_HOST = ("build_s", "compile_s", "_ms_per_frame", "_ms_ahead")  # attributes that say how fast it was
P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class Task:
    """How a worker simulates a case.

    Parameters
    ----------
    case_key
        Name of the case.
    cache
        Folder of kept hits; None keeps and reads none.
    keeps_hits
        Times of the frames that are kept once traced: other cases of the study need them too. [s]
    threads
        Threads of each kernel.
    source
        The driver's `source_key`: a worker with other code must not simulate the case.
    """

    case_key: str
    cache: str | None = None
    keeps_hits: tuple[float, ...] = ()
    threads: int = 1
    source: str | None = None


Fly = Callable[[Case, Task], Mapping[str, Any]]


def attempt(fly: Fly, case_json: str, task: Task) -> dict[str, Any]:
    """Fly a case and say how it went; what it raises comes back as text, so that no worker is lost to it.

    Returns
    -------
    ``scores`` by channel, ``files`` by name, ``seconds``, ``cpu_seconds`` (of the whole process), ``worker``
    and what ``fly`` adds, or ``error``: the traceback.
    """
    threads_before = numba.get_num_threads()
    numba.set_num_threads(min(task.threads, threads_before))
    start, start_cpu = time.perf_counter(), time.process_time()
    outcome: dict[str, Any] = {"worker": os.getpid()}
    try:
        if task.source not in (None, source_key()):
            raise ValueError(
                f"`scheduler` must have workers with the driver's source of glintrack, {task.source}, got "
                f"{source_key()} on {platform.node()} (install the same there)"
            )
        case = Case.model_validate_json(case_json)
        with _without_cluster_locks():
            outcome |= fly(case, task)
        outcome["files"] = {"case.toml": to_toml(case).encode(), **outcome.get("files", {})}
    except Exception as error:  # whatever it is, it belongs to this case, not to the study
        outcome["error"] = "".join(traceback.format_exception(error))
    finally:
        numba.set_num_threads(threads_before)
    took = {"seconds": time.perf_counter() - start, "cpu_seconds": time.process_time() - start_cpu}
    return outcome | took


def _without_cluster_locks() -> contextlib.AbstractContextManager:
    """On a Dask worker xarray asks the cluster for a lock of what it writes, in memory too, and fails."""
    dask = sys.modules.get("dask")
    return contextlib.nullcontext() if dask is None else dask.config.set(scheduler="threads")


def fly_case(case: Case, task: Task) -> dict[str, Any]:
    """Simulate a case with kept hits; scores, the loss budget's stages, and the whole result as NetCDF.

    Raises
    ------
    KeyboardInterrupt
        If the flight was interrupted: half a case is no result.
    """
    kept = HitsCache(Path(task.cache), geometry(case), task.keeps_hits) if task.cache else None
    steps = FlightBudget(case)
    tree = simulate(case, steps.measure, hits_cache=kept)
    if tree.attrs["interrupted"]:
        raise KeyboardInterrupt
    timing = {str(k): float(v) for k, v in tree.attrs.items() if str(k).endswith(_OF_THE_HOST)}
    for name in timing:
        del tree.attrs[name]
    budgets = steps.budgets(tree)
    told = {
        "scores": {ch: scores(case, tree, ch) | stage_scores(budgets.get(ch)) for ch in case.channels},
        "files": {"result.nc": _tree_bytes(tree), "timing.json": json.dumps(timing, indent=1).encode()},
    }
    if kept is not None:
        told |= {"frames_read": kept.read, "frames_traced": kept.traced, "bytes_kept": kept.bytes_kept}
    return told


def scores(case: Case, tree: xr.DataTree, channel: str) -> dict[str, Any]:
    """What a study compares of one channel: the run's scores, its data rate, and scores over time."""
    node = tree[channel]
    found: dict[str, Any] = {str(name): float(value) for name, value in node.attrs.items()}
    if "quality" in node.children:
        found |= {str(name): float(value) for name, value in node["quality"].attrs.items()}
    sensor = case.sensor
    bits_a_frame = sensor.rows * sensor.columns * sensor.bits
    found["data_rate_mbit_s"] = 1e-6 * bits_a_frame * case.flight.rate_hz
    over_time = {
        "completeness": "completeness",
        "completeness_visible": "completeness_visible",
        "false_per_epoch": "false_tracks",
        "held_per_km2": "held_per_km2",
        "false_per_km2": "false_per_km2",
    }
    found["over_time"] = {name: np.asarray(node[source]).tolist() for name, source in over_time.items()}
    return found


def stage_scores(budget: xr.Dataset | None) -> dict[str, float]:
    """Share of all movers on each stage that was measured, by ``stage_NAME``."""
    if budget is None:
        return {}
    values = zip(budget["stage"].values, budget["of_moving"].values.astype(float), strict=True)
    return {f"stage_{name}": float(share) for name, share in values if np.isfinite(share)}


def _tree_bytes(tree: xr.DataTree) -> bytes:
    with tempfile.TemporaryDirectory(prefix="glintrack-") as scratch:
        path = Path(scratch) / "result.nc"
        netcdf.write_tree(path, tree)
        return path.read_bytes()


@dataclass
class Pool:
    """An executor and what the runner has to know of it.

    Parameters
    ----------
    executor
        Takes the calls.
    slots
        How many at a time; 0 while a cluster has no workers.
    name
        For whoever watches.
    threads
        Of each worker.
    renew
        Makes a new executor in place of one that a dying worker broke; None where that cannot happen.
    link
        Of a page that shows the work, where there is one.
    is_up
        Whether calls can still be made; a cluster may be gone.
    count_slots
        Counts them anew where workers come and go; None where they do not.
    abandoned
        Whether calls still run that nobody waits for: an interrupt.
    """

    executor: Executor
    slots: int
    name: str
    threads: int = 1
    renew: Callable[[], Executor] | None = None
    link: str | None = None
    is_up: Callable[[], bool] = field(default=lambda: True)
    count_slots: Callable[[], int] | None = None
    abandoned: bool = False

    def recount(self) -> None:
        """Look how many workers there are now: a queue starts jobs one by one, and ends them."""
        if self.count_slots is not None and self.is_up():
            with contextlib.suppress(OSError, TimeoutError):  # it went this moment: `is_up` will tell
                self.slots = self.count_slots()


class SerialExecutor(Executor):
    """Calls at once, in this process."""

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Call, and hand back a future that is done."""
        future: Future[T] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextlib.contextmanager
def serial() -> Iterator[Pool]:
    """One case after the other, in the process that asks."""
    yield Pool(SerialExecutor(), 1, "this process", threads=os.cpu_count() or 1)


@contextlib.contextmanager
def processes(workers: int | None = None, memory_bytes: int | None = None) -> Iterator[Pool]:
    """Processes of this machine, started anew (never forked), each with its share of cores and memory.

    Parameters
    ----------
    workers
        How many; one a core by default.
    memory_bytes
        Of each, beyond which it meets a MemoryError; its share of four fifths of the machine's by default.
    """
    workers = workers or os.cpu_count() or 1
    threads = max((os.cpu_count() or 1) // workers, 1)
    limit = memory_bytes or memory_share(workers)
    current: list[ProcessPoolExecutor] = []
    strangers = {process.pid for process in multiprocessing.active_children()}

    def start() -> ProcessPoolExecutor:
        for old in current:
            old.shutdown(wait=False, cancel_futures=True)
        context = multiprocessing.get_context("spawn")
        current[:] = [ProcessPoolExecutor(workers, context, _begin, (limit,))]
        return current[0]

    with _environment(threads):
        pool = Pool(start(), workers, f"{workers} processes", threads, start)
        try:
            yield pool
        except BaseException:
            pool.abandoned = True
            raise
        finally:
            # whoever still flies was interrupted; a pool that is not waited for can hang its process's end
            for process in multiprocessing.active_children() if pool.abandoned else ():
                if process.pid not in strangers:
                    process.terminate()
            current[0].shutdown(wait=True, cancel_futures=True)


@contextlib.contextmanager
def dask(address: str, workers: int | None = None, memory_bytes: int | None = None) -> Iterator[Pool]:
    """A Dask cluster: that of a scheduler's address, or one on this machine if the address is ``local``.

    Raises
    ------
    ValueError
        If Dask is not installed, nobody answers at the address, or the cluster has no workers.
    """
    distributed = require_extra("distributed", "cluster", "use a Dask scheduler")
    with contextlib.ExitStack() as stack:
        if address == "local":
            count = workers or os.cpu_count() or 1
            threads = max((os.cpu_count() or 1) // count, 1)
            stack.enter_context(_environment(threads))
            target: Any = stack.enter_context(
                distributed.LocalCluster(
                    n_workers=count,
                    threads_per_worker=1,
                    processes=True,
                    memory_limit=memory_bytes or memory_share(count),
                    dashboard_address="127.0.0.1:0",
                    silence_logs=50,
                )
            )
        else:
            threads, target = 1, address
        try:
            client: Any = stack.enter_context(
                distributed.Client(target, timeout=_CONNECT_S, set_as_default=False)
            )
        except (OSError, TimeoutError, ValueError) as error:
            raise ValueError(
                f"`scheduler` must be the address of a Dask scheduler that answers within {_CONNECT_S:g} s, "
                f"got {address} (is it running, and is the port open?)"
            ) from error
        with contextlib.suppress(TimeoutError):  # told below
            client.wait_for_workers(1, timeout=_CONNECT_S)
        slots = sum(client.nthreads().values())
        if slots == 0:
            raise ValueError(
                f"`scheduler` must have workers, got {address} with none within {_CONNECT_S:g} s (start one, "
                "or wait until the queue has)"
            )
        # a call is never taken for an earlier one of equal arguments: it may be a case's second attempt
        executor = client.get_executor(pure=False, retries=0)
        link = client.dashboard_link if "dashboard" in client.scheduler_info()["services"] else None
        yield Pool(
            executor,
            slots,
            address,
            threads,
            link=link,
            is_up=lambda: client.status == "running",
            count_slots=lambda: sum(client.nthreads().values()),
        )


def is_worker_loss(error: BaseException) -> bool:
    """Whether a future failed because its worker or its cluster died rather than by what was called."""
    named = {"KilledWorker", "CommClosedError", "FutureCancelledError"}
    return isinstance(error, (BrokenExecutor, CancelledError)) or type(error).__name__ in named


def memory_share(workers: int) -> int | None:
    """Each worker's part of four fifths of this machine's memory, where that is known. [byte]"""
    try:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return None
    return int(_MEMORY_SHARE * total / workers)


@contextlib.contextmanager
def _environment(threads: int) -> Iterator[None]:
    """Thread counts as workers inherit them while they start."""
    before = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, str(threads)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _begin(memory_bytes: int | None) -> None:
    """In a new worker: an interrupt is the driver's business, memory has its bound, and it ends with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_driver, daemon=True).start()
    if memory_bytes and resource is not None and sys.platform == "linux":
        resource.setrlimit(resource.RLIMIT_DATA, (memory_bytes, memory_bytes))


def _end_with_driver() -> None:
    """Leave when the driver is gone: a worker of a killed one would wait for work forever."""
    driver = multiprocessing.parent_process()
    if driver is not None:
        multiprocessing.connection.wait([driver.sentinel])
        os._exit(1)
