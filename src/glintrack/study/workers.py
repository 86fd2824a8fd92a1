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
from glintrack.case.identity import source_key
from glintrack.case.quantities import data_rate_mbit_s, machine_memory_bytes
from glintrack.core.installation import require_extra
from glintrack.io import netcdf
from glintrack.io.toml import to_toml
from glintrack.loop import simulate
from glintrack.study.hits import HitsCache, geometry

try:
    import resource
except ImportError:  # not on Windows, where a worker's memory has no bound
    resource = None  # type: ignore[assignment]
_CONNECT_S = 10.0
_MEMORY_SHARE = 0.8
# which libraries read when they are loaded
_THREAD_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_OF_THE_HOST = ("build_s", "compile_s", "_ms_per_frame", "_ms_ahead")  # attributes that say how fast it was
P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class Task:
    """Settings of a worker for one case.

    Parameters
    ----------
    case_key
        Name of the case.
    cache
        Folder of the hits cache; None for none.
    keeps_hits
        Times of the frames to keep, which other cases of the study need. [s]
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


Simulate = Callable[[Case, Task], Mapping[str, Any]]


def attempt(simulate: Simulate, case_json: str, task: Task) -> dict[str, Any]:
    """Simulate a case and return its outcome, or its traceback as text, so that the worker survives.

    Returns
    -------
    ``scores`` by channel, ``files`` by name, ``seconds``, ``cpu_seconds`` (of the whole process), ``worker``
    and the other values of ``simulate``, or ``error``: the traceback.
    """
    threads_before = numba.get_num_threads()
    numba.set_num_threads(min(task.threads, threads_before))
    start, start_cpu = time.perf_counter(), time.process_time()
    outcome: dict[str, Any] = {"worker": os.getpid()}
    dask = sys.modules.get("dask")
    # on a Dask worker xarray would ask the cluster for a lock of its files, in memory too, and fail
    no_locks = contextlib.nullcontext() if dask is None else dask.config.set(scheduler="threads")
    try:
        if task.source not in (None, source_key()):
            raise ValueError(
                f"`scheduler` must have workers with the driver's source of glintrack, {task.source}; got "
                f"{source_key()} on {platform.node()}. Install the same there."
            )
        case = Case.model_validate_json(case_json)
        with no_locks:
            outcome |= simulate(case, task)
        outcome["files"] = {"case.toml": to_toml(case).encode(), **outcome.get("files", {})}
    except Exception as error:  # of this case, not of the study
        outcome["error"] = "".join(traceback.format_exception(error))
    finally:
        numba.set_num_threads(threads_before)
    times = {"seconds": time.perf_counter() - start, "cpu_seconds": time.process_time() - start_cpu}
    return outcome | times


def simulate_case(case: Case, task: Task) -> dict[str, Any]:
    """Simulate a case with the hits cache; return scores, stages of the loss budget, and the result.

    Raises
    ------
    KeyboardInterrupt
        If the flight was interrupted: half a case is no result.
    """
    cache = HitsCache(Path(task.cache), geometry(case), task.keeps_hits) if task.cache else None
    budget = FlightBudget(case)
    tree = simulate(case, budget.measure, hits_cache=cache)
    if tree.attrs["interrupted"]:
        raise KeyboardInterrupt
    timing = {str(k): float(v) for k, v in tree.attrs.items() if str(k).endswith(_OF_THE_HOST)}
    for name in timing:
        del tree.attrs[name]
    found = {ch: scores(case, tree, ch) for ch in case.channels}
    for channel, one in budget.budgets(tree).items():
        shares = zip(one["stage"].values, one["of_moving"].values.astype(float), strict=True)
        if channel in found:
            found[channel] |= {f"stage_{name}": float(v) for name, v in shares if np.isfinite(v)}
    with tempfile.TemporaryDirectory(prefix="glintrack-") as scratch:
        path = Path(scratch) / "result.nc"
        netcdf.write_tree(path, tree)
        files = {"result.nc": path.read_bytes(), "timing.json": json.dumps(timing, indent=1).encode()}
    outcome = {"scores": found, "files": files}
    if cache is not None:
        outcome |= {"frames_read": cache.read, "frames_traced": cache.traced, "bytes_kept": cache.bytes_kept}
    return outcome


def scores(case: Case, tree: xr.DataTree, channel: str) -> dict[str, Any]:
    """Scores of one channel for a study: those of the run, its data rate, and scores over time."""
    node = tree[channel]
    quality = node["quality"].attrs if "quality" in node.children else {}
    found: dict[str, Any] = {str(name): float(value) for name, value in {**node.attrs, **quality}.items()}
    found["data_rate_mbit_s"] = data_rate_mbit_s(case)
    names = ("completeness", "completeness_visible", "tracked_per_km2", "false_per_km2")
    over_time = {**dict(zip(names, names, strict=True)), "false_per_frame": "false_tracks"}
    found["frames"] = float(node.sizes["time"])  # simulated ones
    scored = slice(int(node.attrs["learning_frames"]), None)
    found["over_time"] = {name: np.asarray(node[of])[scored].tolist() for name, of in over_time.items()}
    return found


@dataclass
class Pool:
    """Executor with its number of workers.

    Parameters
    ----------
    executor
        Executor of the calls.
    slots
        Number of calls at a time; 0 while a cluster has no workers.
    name
        Name for messages.
    threads
        Threads of each worker.
    renew
        Makes a new executor after a worker's death; None where that cannot happen.
    link
        Address of a dashboard, if there is one.
    is_up
        Whether calls are possible; a cluster may be gone.
    count_slots
        Counts the workers of a cluster; None for a fixed number.
    abandoned
        Whether running calls were interrupted.
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
        """Update the number of workers, which a queue starts and ends one by one."""
        if self.count_slots is not None and self.is_up():
            with contextlib.suppress(OSError, TimeoutError):  # the cluster has just gone: see `is_up`
                self.slots = self.count_slots()


class SerialExecutor(Executor):
    """Executor that calls immediately in this process."""

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Call, and return a completed future."""
        future: Future[T] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextlib.contextmanager
def serial() -> Iterator[Pool]:
    """Pool of one case after the other in this process."""
    yield Pool(SerialExecutor(), 1, "this process", threads=os.cpu_count() or 1)


@contextlib.contextmanager
def processes(workers: int | None = None, memory_bytes: int | None = None) -> Iterator[Pool]:
    """Pool of processes of this machine, spawned with equal shares of cores and memory.

    Parameters
    ----------
    workers
        Number of processes; one per core by default.
    memory_bytes
        Memory limit of each; its share of four fifths of the machine's memory by default.
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
            # calls that still run were interrupted; without an end they could block the exit
            for process in multiprocessing.active_children() if pool.abandoned else ():
                if process.pid not in strangers:
                    process.terminate()
            current[0].shutdown(wait=True, cancel_futures=True)


@contextlib.contextmanager
def dask(address: str, workers: int | None = None, memory_bytes: int | None = None) -> Iterator[Pool]:
    """Pool of a Dask cluster at a scheduler's address, or on this machine for the address ``local``.

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
                f"`scheduler` must be the address of a Dask scheduler that answers within {_CONNECT_S:g} s; "
                f"got {address}. Is it running, and is the port open?"
            ) from error
        with contextlib.suppress(TimeoutError):  # see below
            client.wait_for_workers(1, timeout=_CONNECT_S)
        slots = sum(client.nthreads().values())
        if slots == 0:
            raise ValueError(
                f"`scheduler` must have workers; got {address} with none within {_CONNECT_S:g} s. Start one, "
                "or wait until the queue has."
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
    """Return True if a future failed because its worker or its cluster died."""
    named = {"KilledWorker", "CommClosedError", "FutureCancelledError"}
    return isinstance(error, (BrokenExecutor, CancelledError)) or type(error).__name__ in named


def memory_share(workers: int) -> int | None:
    """Share of each worker in four fifths of this machine's memory; None if not known. [byte]"""
    total = machine_memory_bytes()
    return None if total is None else int(_MEMORY_SHARE * total / workers)


@contextlib.contextmanager
def _environment(threads: int) -> Iterator[None]:
    """Set the thread counts that workers inherit while they start."""
    before = {name: os.environ[name] for name in _THREAD_VARIABLES if name in os.environ}
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, str(threads)))
    try:
        yield
    finally:
        for name in _THREAD_VARIABLES:
            del os.environ[name]
        os.environ.update(before)


def _begin(memory_bytes: int | None) -> None:
    """Start a worker: ignore interrupts, limit the memory, and end with the driver."""
    driver = multiprocessing.parent_process()
    assert driver is not None

    def end_with_driver() -> None:
        multiprocessing.connection.wait([driver.sentinel])
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=end_with_driver, daemon=True).start()
    if memory_bytes and resource is not None and sys.platform == "linux":
        resource.setrlimit(resource.RLIMIT_DATA, (memory_bytes, memory_bytes))
