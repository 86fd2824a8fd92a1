"""A kept kernel is compiled anew once any file that it was compiled from has changed, and no sooner."""

import os
import subprocess
import sys

from glintrack.core.kernels.sources import stamp
from glintrack.render.shading.pixels import shade_pixels

KERNEL = """
import numba as nb
import glintrack.core.parallel
from prog import more
from prog.numbers import (
    FACTOR,  # of what is given
    UNUSED,
)
from prog.part import scaled


@nb.njit(cache=True)
def kernel(x):
    return scaled(x) * FACTOR + more.beyond(x)
"""
PART = """
from glintrack.core.kernels.parts import kernel_part
from prog.numbers import OTHER


@kernel_part()
def scaled(x):
    return {} * x + OTHER
"""
MORE = """
from glintrack.core.kernels.parts import kernel_part


@kernel_part()
def beyond(x):
    return {}
"""
PROGRAM = """
from prog.kernel import kernel

print(kernel(1), len(kernel.stats.cache_hits))
"""


def test_a_change_of_a_part_or_a_number_in_another_file_is_seen(tmp_path):
    package = tmp_path / "prog"
    package.mkdir()
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}

    def write(name, text):
        (package / name).write_text(text)

    def run():
        command = [sys.executable, str(tmp_path / "program.py")]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        return done.stdout.strip() or done.stderr

    (tmp_path / "program.py").write_text(PROGRAM)
    write("__init__.py", "")
    write("kernel.py", KERNEL)
    write("part.py", PART.format(2))
    write("more.py", MORE.format(0))
    write("numbers.py", "FACTOR, OTHER, UNUSED = 10, 0, 0\n")
    write("beside.py", "ANY = 1\n")
    assert run() == "20 0" and run() == "20 1"
    write("beside.py", "ANY = 22\n")
    assert run() == "20 1"
    write("part.py", PART.format("(3)"))
    assert run() == "30 0" and run() == "30 1"
    write("numbers.py", "FACTOR, OTHER, UNUSED = 10, 100, 0\n")
    assert run() == "1030 0"
    write("more.py", MORE.format("(7)"))
    assert run() == "1037 0" and run() == "1037 1"


def test_shading_depends_on_its_parts_and_on_how_kernels_are_compiled():
    names = [name for name, _, _ in stamp(shade_pixels.py_func)]
    assert {"pixels.py", "diffuse.py", "stokes.py", "parts.py", "indices.py"} <= {*names}
    assert not {"trace.py", "samples.py", "shade.py"} & {*names}


def test_a_kernel_without_a_file_depends_on_how_it_is_compiled():
    given: dict = {"__name__": "cell"}
    exec(compile("def kernel(x):\n    return x", "/nowhere/cell.py", "exec"), given)
    assert [name for name, _, _ in stamp(given["kernel"])] == ["indices.py", "parts.py"]
