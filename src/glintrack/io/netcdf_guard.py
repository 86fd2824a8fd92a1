"""The process that tries NetCDF-4 files before this one opens them.

It loads HDF5 once and forks a child for each file (`netcdf_probe`), which takes milliseconds where a new
interpreter takes half a second. It ends with this process, or when nothing was asked for a while. Where
processes cannot be forked each file has an interpreter of its own.
"""

import atexit
import contextlib
import functools
import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

_COMMAND = [sys.executable, "-P", str(Path(__file__).with_name("netcdf_probe.py"))]
_WALL_S, _BYTES_PER_S = 60.0, 5e6
_ENDLESS, _BROKEN = "reading it does not end", "the HDF5 library cannot read it"


def fault_of(path: str, size: int) -> str:
    """What is wrong with a file of that size [byte]; empty if nothing is."""
    seconds = _WALL_S + size / _BYTES_PER_S
    asked = json.dumps({"path": path, "seconds": int(seconds), "endless": _ENDLESS, "broken": _BROKEN}) + "\n"
    answer = _guard(os.getpid()).ask(asked) if hasattr(os, "fork") else _ask_alone(asked, seconds)
    return json.loads(answer) if answer else _BROKEN


class Guard:
    """The process, started when it is first asked and whenever it has ended since."""

    def __init__(self):
        self._lock, self._owner = threading.Lock(), os.getpid()
        self._process: subprocess.Popen[str] | None = None
        atexit.register(self.end)

    def ask(self, line: str) -> str:
        """Its answer to a question; nothing if it ended twice over it."""
        with self._lock:
            try:
                return self._told(line) or self._told(line)
            except BaseException:  # its answer would pass for that of the next file
                self.end()
                raise

    def _told(self, line: str) -> str:
        process = self._process or _started(start_new_session=True, cwd=os.sep)
        self._process = process
        assert process.stdin is not None and process.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(line)
            process.stdin.flush()
            if answer := process.stdout.readline():
                return answer
        self.end()
        return ""

    def end(self) -> None:
        """End the process, if this one started it."""
        process, self._process = self._process, None
        if process is not None and self._owner == os.getpid():
            with contextlib.suppress(BrokenPipeError), process:  # of what was left to write
                process.kill()


@functools.lru_cache(maxsize=1)
def _guard(_process: int) -> Guard:
    """That of this process: one that was forked from it has its own."""
    return Guard()


def _started(**more: Any) -> "subprocess.Popen[str]":
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "encoding": "utf-8"}
    return subprocess.Popen(_COMMAND, stderr=subprocess.DEVNULL, env=environment, **pipes, **more)


def _ask_alone(line: str, seconds: float) -> str:
    with _started() as process:
        try:
            return process.communicate(line, seconds)[0]
        except subprocess.TimeoutExpired:
            process.kill()
            return json.dumps(_ENDLESS)
