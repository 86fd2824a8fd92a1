"""Kernels compiled ahead: signatures survive their text, the next needed comes first, the table is full."""

import json
import os
import subprocess
import sys
from typing import NamedTuple

import numba as nb
import numpy as np
import pytest

from glintrack.core.kernels import ahead, early, processes
from glintrack.core.kernels.ahead import Kernel, listed_kernels
from glintrack.core.kernels.cache import CompilationCount
from glintrack.core.kernels.types import attribute, from_plain, to_plain
from tests.fuzz.disks import mounted

FLIGHT = """
import json, sys
from numba.core.dispatcher import Dispatcher
from glintrack import run
from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.core.kernels import ahead
from glintrack.core.kernels.types import to_plain
ahead.FEW = 0  # a kernel that is compiled in flight brings what it calls
run(Case.from_toml(find_case("quickstart")).replace({"flight.frames": 8}), sys.argv[1])
called = []
for name, module in list(sys.modules.items()):
    for value in vars(module).values() if name.startswith("glintrack.") and module else ():
        if isinstance(value, Dispatcher) and value.py_func.__module__ == name and "embree_leaves" not in name:
            for types in value.overloads:
                called.append([f"{name}:{value.py_func.__qualname__}", [to_plain(t) for t in types]])
print(json.dumps(called))
"""


class Pair(NamedTuple):
    """Of an array and a number."""

    values: np.ndarray
    scale: float


def readonly():
    values = np.zeros((2, 3), np.float32)
    values.flags.writeable = False
    return values


@pytest.mark.parametrize(
    "value",
    [1, 1.5, True, None, np.float32(1), np.zeros(3), np.zeros((4, 2))[:, 0], np.zeros((4, 2)).T, readonly(),
     np.zeros(2, bool), (1, 2.0), (1, 2), Pair(np.zeros(3), 1.0), (Pair(np.zeros((1, 1), np.int16), 2.0), 3)],
)  # fmt: skip
def test_a_type_comes_back_from_its_text(value):
    kind = nb.typeof(value)
    assert from_plain(json.loads(json.dumps(to_plain(kind)))) == kind


def test_types_that_no_kernel_takes_are_refused():
    with pytest.raises(ValueError, match="arrays, numbers and tuples"):
        to_plain(nb.typeof("text"))


def row(name, seconds, needed):
    return {"name": name, "arguments": ["int64"], "seconds": seconds, "needed": needed}


def test_what_the_first_frame_needs_comes_first_and_what_is_waited_for_before_all(tmp_path):
    rows = [row("a", 9.0, 1), row("b", 1.0, 0), row("c", 2.0, 0), row("d", 1.0, 1)]
    asked = processes.Helpers(rows, 2, tmp_path, lambda: False, lambda: None)
    assert asked.ready("e", ["int64"]) is None and asked.ready("d", ["float64"]) is None
    told = asked.ready("d", ["int64"])
    assert [asked._next()["name"] for _ in range(4)] == ["d", "c", "b", "a"]
    assert asked._next() is None
    assert told is not None and not told.is_set()


WAITS = """
import json
import numpy as np
from glintrack.core.kernels import early
from glintrack.core.kernels.ahead import compile_ahead
from glintrack.core.kernels.cache import compiled
from glintrack.track.initiation_kernels import all_bits_of
rows = [one for one in early.listed_rows() if one["name"].endswith(":all_bits_of")]
started = early.start([{**rows[0], "needed": 0}, {**rows[0], "name": "glintrack.core.about:nothing"}])
compile_ahead()
bits = all_bits_of(np.array([0, 7, 8]))
hits, misses = (sum(one.values()) for one in (all_bits_of.stats.cache_hits, all_bits_of.stats.cache_misses))
started.wait()
waited = compiled.seconds > 0
print(json.dumps([bits.tolist(), hits, misses, compiled.kernels, waited, started.done, started.of]))
"""


@pytest.mark.slow
def test_a_kernel_under_way_is_waited_for(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept"), "XDG_CACHE_HOME": str(tmp_path)}
    words = [sys.executable, "-c", WAITS]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [[0, 3, 1], 1, 0, 0, True, 2, 2]


def test_processes_start_early_unless_all_is_kept(monkeypatch, tmp_path):
    begun = []
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(early, "start", begun.append)
    monkeypatch.setattr(processes, "_started", [])
    monkeypatch.delenv("NUMBA_DISABLE_JIT", raising=False)
    early.start_early()
    assert len(begun) == 1 and len(begun[0]) == len(listed_kernels())
    early.note_all_kept()
    early.start_early()
    assert len(begun) == 1
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "elsewhere"))
    early.start_early()
    assert len(begun) == 2


def test_table_names_kernels_that_exist():
    for kernel in listed_kernels():
        assert isinstance(attribute(kernel.name), nb.core.dispatcher.Dispatcher), kernel.name
        assert [to_plain(from_plain(part)) for part in kernel.arguments] == kernel.arguments


def test_waiting_is_timed():
    count = CompilationCount()
    with count.waiting():
        assert count.under_way
    assert not count.under_way and count.kernels == 0
    assert count.seconds > 0


def test_what_is_kept_starts_no_process(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(processes, "_started", [])
    monkeypatch.setattr(Kernel, "is_kept", lambda self: True)
    monkeypatch.setattr(processes.subprocess, "Popen", lambda *a, **k: pytest.fail("a process was started"))
    ahead.compile_ahead()


@pytest.mark.slow
def test_table_holds_what_a_flight_calls(tmp_path):
    """Run `python scripts/list_kernels.py` if this fails."""
    words = [sys.executable, "-c", FLIGHT, str(tmp_path / "r")]
    nothing_kept = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    called = subprocess.run(words, env=nothing_kept, capture_output=True, text=True)
    assert called.returncode == 0, called.stderr[-4000:]
    listed = {(kernel.name, json.dumps(kernel.arguments)) for kernel in listed_kernels()}
    flown = {(name, json.dumps(types)) for name, types in json.loads(called.stdout.splitlines()[-1])}
    assert len(flown) > 60
    assert not flown - listed


FULL = """
import json, warnings
import numpy as np
from glintrack.core.kernels import ahead
from glintrack.core.kernels.cache import compiled
from glintrack.track.initiation_kernels import all_bits_of
ahead.compile_ahead(wait=True)
done_ahead = compiled.kernels
with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    bits = all_bits_of(np.array([0, 7, 8]))
print(json.dumps([done_ahead, bits.tolist(), sorted({str(one.message) for one in said})]))
"""


@pytest.mark.slow
def test_on_a_full_disk_nothing_is_compiled_ahead_and_a_kernel_gives_its_answer(tmp_path):
    with mounted(tmp_path / "disk", "size=4k") as disk:
        (disk / "full").write_bytes(bytes(4096))
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(disk), "XDG_CACHE_HOME": str(tmp_path)}
        program = [sys.executable, "-c", FULL]
        done = subprocess.run(program, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        done_ahead, bits, said = json.loads(done.stdout)
        assert done_ahead == 0 and bits == [0, 3, 1]
        assert len(said) == 1 and said[0].startswith("compiled kernels cannot be kept, and are compiled each")
        assert not [path for path in disk.rglob("*.nbc") if path.stat().st_size]
