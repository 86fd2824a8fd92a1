"""A damaged cache of compiled kernels is rebuilt."""

import os
import subprocess
import sys

import pytest

PROGRAM = """
import numba as nb
import glintrack.parallel

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
