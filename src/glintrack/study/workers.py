"""Workers that fly cases: in this process, in others of this machine, or on a Dask cluster; one interface."""

import contextlib
import multiprocessing
import multiprocessing.connection
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Future, ProcessPoolExecutor
from dataclasses import dataclass, field
from typing import Any, ParamSpec, Protocol, TypeVar

from glintrack.core.extras import require_extra

try:
    import resource
except ImportError:  # not on Windows, where a worker's memory has no bound
    resource = None  # type: ignore[assignment]

_CONNECT_S = 10.0
_MEMORY_SHARE = 0.8
# read when the libraries are loaded, so they have to be set before a worker starts
_THREAD_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")

P = ParamSpec("P")
T = TypeVar("T")


class Submits(Protocol):
    """What every executor of `concurrent.futures` offers, and Dask's client too."""

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> "Future[T]":
        """Start a call."""
        ...


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

    executor: Submits
    slots: int
    name: str
    threads: int = 1
    renew: Callable[[], Submits] | None = None
    link: str | None = None
    is_up: Callable[[], bool] = field(default=lambda: True)
    count_slots: Callable[[], int] | None = None
    abandoned: bool = False

    def recount(self) -> None:
        """Look how many workers there are now: a queue starts jobs one by one, and ends them."""
        if self.count_slots is not None and self.is_up():
            with contextlib.suppress(OSError, TimeoutError):  # it went this moment: `is_up` will tell
                self.slots = self.count_slots()


class SerialExecutor:
    """Calls at once, in this process."""

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> "Future[T]":
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
