"""Processes that compile kernels while the flight is made ready and begins, those first that it needs first.

A process gets one kernel at a time (`kernels.worker`). The flight waits for a kernel that it calls and that
is not compiled yet, which then comes next. Nothing here loads numba, so that the program starts them at once.
"""

import atexit
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, cast

from glintrack.core.kernels.lock import alone

_FORKS = hasattr(os, "fork")  # of a process with a single thread, before it compiles anything
_started: list["Helpers"] = []  # one a process


class Helpers:
    """Kernels being compiled by processes.

    Parameters
    ----------
    rows
        Of the table: ``name``, ``arguments``, ``seconds``, and ``needed``, which is 0 for kernels that the
        first frame waits for, 1 for others.
    processes
        How many may work.
    folder
        Where a program that compiles is alone; another waits, and finds all done.
    all_kept
        Whether another program has done it all meanwhile.
    finished
        Called once all is compiled and kept.
    """

    def __init__(
        self,
        rows: Sequence[dict],
        processes: int,
        folder: Path,
        all_kept: Callable[[], bool],
        finished: Callable[[], None],
    ):
        self.of, self.done = len(rows), 0
        self._rows = sorted(rows, key=lambda row: (row["needed"], -row["seconds"]))
        self._ready = {_key(row): threading.Event() for row in rows}
        self._lock, self._folder = threading.Lock(), folder
        self._all_kept, self._finished = all_kept, finished
        self._processes, self._workers = min(processes, len(rows)), list[subprocess.Popen]()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def start(self) -> None:
        """Begin; what is not done when this process ends is left."""
        atexit.register(self.stop)
        self._thread.start()

    @property
    def under_way(self) -> bool:
        """Whether some kernels are not compiled yet."""
        return self._thread.is_alive()

    def ready(self, name: str, arguments: list[Any]) -> threading.Event | None:
        """Told once a kernel is compiled, or will not be; it comes next. None for others."""
        key = name, json.dumps(arguments)
        told = self._ready.get(key)
        if told is not None:
            with self._lock:
                self._rows.sort(key=lambda row: _key(row) != key)  # the others keep their order
        return told

    def wait(self) -> None:
        """Until all are compiled."""
        self._thread.join()

    def stop(self) -> None:
        """End the processes."""
        for worker in self._workers:
            with suppress(OSError):
                if _FORKS:
                    os.killpg(worker.pid, signal.SIGKILL)
                else:
                    worker.kill()

    def _work(self) -> None:
        try:
            with alone(self._folder):
                if self._all_kept():  # by another program, while this one waited
                    return
                self._share_out()
                if self.done == self.of:
                    self._finished()
        finally:
            for told in self._ready.values():  # the flight compiles what is left
                told.set()

    def _share_out(self) -> None:
        try:
            followers = [
                threading.Thread(target=self._follow, args=pipes, daemon=True) for pipes in self._begin()
            ]
            for follower in followers:
                follower.start()
            for follower in followers:
                follower.join()
        finally:
            self.stop()
            for worker in self._workers:
                worker.wait()
            self._workers.clear()

    def _begin(self) -> list[tuple[IO[str], IO[str]]]:
        """Start the processes: what each is asked through, and tells. One loads, and forks the others."""
        command = [sys.executable, "-m", "glintrack.core.kernels.worker"]
        pipes: dict[str, Any] = {
            "stdin": subprocess.PIPE,
            "stdout": subprocess.PIPE,
            "stderr": subprocess.DEVNULL,
            "text": True,
        }
        if not _FORKS:
            self._workers += [subprocess.Popen(command, **pipes) for _ in range(self._processes)]
            return [_ends(worker) for worker in self._workers]
        to, back = ([os.pipe() for _ in range(self._processes - 1)] for _ in range(2))
        theirs = [(asked[0], told[1]) for asked, told in zip(to, back, strict=True)]
        command += [f"{read}:{write}" for read, write in theirs]
        kept = [end for pair in theirs for end in pair]
        self._workers.append(subprocess.Popen(command, pass_fds=kept, process_group=0, **pipes))
        for end in kept:
            os.close(end)
        others = [(os.fdopen(a[1], "w"), os.fdopen(t[0])) for a, t in zip(to, back, strict=True)]
        return [_ends(self._workers[0]), *others]

    def _follow(self, asked: IO[str], told: IO[str]) -> None:
        """Give a process one kernel after the other."""
        with suppress(OSError):  # it died
            while (row := self._next()) is not None:
                try:
                    asked.write(json.dumps(row) + "\n")
                    asked.flush()
                    if not told.readline():
                        return
                    with self._lock:
                        self.done += 1
                finally:
                    self._ready[_key(row)].set()

    def _next(self) -> dict | None:
        with self._lock:
            return self._rows.pop(0) if self._rows else None


def _ends(worker: subprocess.Popen) -> tuple[IO[str], IO[str]]:
    return cast(IO[str], worker.stdin), cast(IO[str], worker.stdout)


def _key(row: dict) -> tuple[str, str]:
    return row["name"], json.dumps(row["arguments"])


def helpers() -> Helpers | None:
    """Those that this process started, if it did."""
    return _started[0] if _started else None


def start(
    rows: Sequence[dict], folder: Path, all_kept: Callable[[], bool], finished: Callable[[], None]
) -> Helpers:
    """Start compiling, in a process a core; see `Helpers`."""
    _started[:] = [Helpers(rows, os.cpu_count() or 1, folder, all_kept, finished)]
    _started[0].start()
    return _started[0]
