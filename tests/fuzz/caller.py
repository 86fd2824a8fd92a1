"""Call the program in child processes that are forked with everything loaded, with bounds on what they use.

A forked child costs milliseconds where a new interpreter costs seconds. The process that forks is one of its
own (``python -m tests.fuzz.caller``), because one in which threads have run must not be forked.
"""

import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

CPU_S = 600.0  # a first call compiles kernels
MEMORY_BYTES = 8_000_000_000
WALL_S = 900.0
_HUNG = -1


@dataclass(frozen=True)
class Outcome:
    """How a call ended.

    Parameters
    ----------
    code
        Exit code; negative for a signal.
    out, err
        What was said.
    cpu_s
        Used by it and its children. [s]
    """

    code: int
    out: str
    err: str
    cpu_s: float


class Caller:
    """Calls the program; use it as a context.

    Parameters
    ----------
    three_cars
        Whether every case flies over three cars on a plane instead of its city, which costs nothing.
    """

    def __init__(self, three_cars: bool = True):
        words = ["-m", "tests.fuzz.caller", *(["--three-cars"] if three_cars else [])]
        self._process = subprocess.Popen(
            [sys.executable, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def __enter__(self) -> "Caller":
        return self

    def __exit__(self, *_) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()

    def call(
        self,
        words: list[str],
        folder: Path,
        largest_file: int | None = None,
        stopped: tuple[int, float] | None = None,
        cache: Path | None = None,
    ) -> Outcome:
        """The program with some words, in a folder.

        Parameters
        ----------
        words, folder
            What is typed, and where.
        largest_file
            That it may write. [byte]
        stopped
            A signal that it gets, and how long after its begin. [1, s]
        cache
            What is the user's cache to it.
        """
        asked = {"words": words, "folder": str(folder), "largest_file": largest_file, "stopped": stopped}
        asked["cache"] = None if cache is None else str(cache)
        assert self._process.stdin is not None and self._process.stdout is not None
        print(json.dumps(asked), file=self._process.stdin, flush=True)
        return Outcome(**json.loads(self._process.stdout.readline()))


def _serve(three_cars: bool) -> None:
    import glintrack.cli.app as program
    from glintrack.case import build as scenario
    from tests.conftest import ThreeCars, load_materials

    program.load_program()
    if three_cars:
        scenario.build_scene = lambda design: ThreeCars(load_materials())
        _load_kernels()
    answers = os.fdopen(os.dup(1), "w")
    for line in sys.stdin:
        print(json.dumps(_answer(program, json.loads(line))), file=answers, flush=True)


def _load_kernels() -> None:
    """Fly once here, so that no child loads or compiles the kernels again."""
    from glintrack.results.run import run
    from tests.fuzz.calls import FILES

    with tempfile.TemporaryDirectory() as scratch:
        case = Path(scratch) / "case.toml"
        FILES["case.toml"](case)
        run(case, Path(scratch) / "flown")


def _answer(program, asked: dict) -> dict:
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        child = os.fork()
        if child == 0:
            code = 70
            try:
                os.setsid()
                code = _child(program, asked, out.fileno(), err.fileno())
            finally:
                os._exit(code)
        began, (number, after_s) = time.monotonic(), asked["stopped"] or (0, WALL_S)
        done, status, used = 0, 0, None
        while not done and time.monotonic() - began < WALL_S:
            done, status, used = os.wait4(child, os.WNOHANG)
            if number and not done and time.monotonic() - began > after_s:
                os.kill(child, number)
                number = 0
            if not done:
                time.sleep(0.002)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)
        if not done:
            _, _, used = os.wait4(child, 0)
        code = os.waitstatus_to_exitcode(status) if done else _HUNG
        assert used is not None
        return {
            "code": code, "out": _said(out), "err": _said(err), "cpu_s": used.ru_utime + used.ru_stime
        }  # fmt: skip


def _said(file) -> str:
    file.seek(0)
    return file.read(200_000).decode("utf-8", "backslashreplace")


def _child(program, asked: dict, out: int, err: int) -> int:
    os.dup2(out, 1)
    os.dup2(err, 2)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
    os.chdir(asked["folder"])
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    if asked["cache"]:
        os.environ["XDG_CACHE_HOME"] = asked["cache"]
    resource.setrlimit(resource.RLIMIT_CPU, (int(CPU_S), int(CPU_S) + 5))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    if asked["largest_file"] is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (asked["largest_file"],) * 2)
    sys.argv = ["glintrack", *asked["words"]]
    try:
        program.main()
        return 0
    except SystemExit as done:
        return done.code if isinstance(done.code, int) else 0 if done.code is None else 1
    except BaseException:
        sys.excepthook(*sys.exc_info())
        return 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()


if __name__ == "__main__":
    _serve("--three-cars" in sys.argv)
