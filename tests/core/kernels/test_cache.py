"""A damaged cache of compiled kernels is rebuilt."""

import os
import subprocess
import sys
import time

import numba as nb
import pytest

from glintrack.core.kernels.cache import compiled

PROGRAM = """
import numba as nb
import glintrack.core.parallel

@nb.njit(cache=True)
def twice(x):
    return 2 * x

print(twice(21))
"""


@pytest.mark.parametrize("ending", [".nbi", ".nbc"])
def test_a_kernel_cut_short_is_compiled_anew(tmp_path, ending):
    (tmp_path / "program.py").write_text(PROGRAM)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    command = [sys.executable, str(tmp_path / "program.py")]

    def run():
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)

    assert run().stdout == "42\n"
    files = list((tmp_path / "cache").rglob(f"*{ending}"))
    assert files
    for size in (0, 20):
        for file in files:
            os.truncate(file, size)
        done = run()
        assert (done.returncode, done.stdout) == (0, "42\n"), done.stderr


def test_a_full_disk_costs_the_cache_not_the_flight(tmp_path):
    (tmp_path / "program.py").write_text(PROGRAM)
    full = "import errno, os\nfrom numba.core import caching\n\ndef full(*_):\n"
    full += "    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))\n\n"
    full += "caching.IndexDataCacheFile._save_data = full\n"
    (tmp_path / "full.py").write_text(full + PROGRAM)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    for name in ("full.py", "full.py", "program.py"):  # nothing that was half kept is in the way later
        command = [sys.executable, str(tmp_path / name)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout) == (0, "42\n"), done.stderr
        assert "Traceback" not in done.stderr
        assert ("compiled kernels cannot be kept" in done.stderr) == (name == "full.py")


def test_compiling_is_counted_and_timed_once():
    """A kernel and the one it calls: two kernels, and no more time than went by."""
    before, began = (compiled.kernels, compiled.seconds), time.perf_counter()

    @nb.njit
    def inner(x):
        return 2.0 * x

    @nb.njit
    def outer(x):
        return inner(x) + 1.0

    assert outer(1.0) == 3.0
    spent = compiled.seconds - before[1]
    assert compiled.kernels - before[0] == 2 and not compiled.under_way
    assert 0 < spent <= time.perf_counter() - began
    outer(2.0)  # compiled already
    assert compiled.seconds - before[1] == spent
