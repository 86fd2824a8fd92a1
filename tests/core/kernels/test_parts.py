"""Parts of kernels: compiled within their callers alone, plain Python elsewhere, kept with their callers."""

import os
import subprocess
import sys

import numba as nb
import numpy as np
import pytest

from glintrack.core.kernels.parts import kernel_part

MODULE = """
import math
import numba as nb
from glintrack.core import parallel
from glintrack.core.kernels.parts import kernel_part

@kernel_part()
def root(x):
    return math.sqrt(max(x, 0.0))

@kernel_part(fastmath=True, forceinline=True)
def total(values):
    total = 0.0
    for value in values:
        total += root(value)
    return total

@kernel_part()
def halvings(n):
    return 0 if n < 2 else 1 + halvings(n // 2)

@nb.njit(cache=True)
def kernel(values):
    return total(values) + halvings(len(values))
"""
CALL = """
import numpy as np, kernels
print(kernels.kernel(np.arange(64.0)))
print(sum(kernels.kernel.stats.cache_hits.values()), sum(kernels.kernel.stats.cache_misses.values()))
print(kernels.root(4.0), kernels.total([4.0, 9.0]))
print(sum(len(one.overloads) for one in (kernels.root, kernels.total, kernels.halvings)))
"""


def test_a_part_lives_in_its_kernel(tmp_path):
    (tmp_path / "kernels.py").write_text(MODULE)
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(tmp_path / "kept"),
        "PYTHONPATH": os.pathsep.join(sys.path),
    }

    def called():
        command = [sys.executable, "-c", CALL]
        done = subprocess.run(
            command, capture_output=True, text=True, cwd=tmp_path, env=environment, check=True
        )
        return done.stdout.splitlines()

    first, later = called(), called()
    assert float(first[0]) == pytest.approx(np.sqrt(np.arange(64.0)).sum() + 6)
    assert first[0] == later[0]
    assert (first[1], later[1]) == ("0 1", "1 0")
    assert first[2] == later[2] == "2.0 5.0"
    assert (first[3], later[3]) == ("3", "0")  # what is kept of a kernel is all that it calls
    assert {path.name.split("-")[0] for path in (tmp_path / "kept").rglob("*.nbi")} == {"kernels.kernel"}


def test_a_part_raises_what_it_says():
    @kernel_part()
    def checked(x):
        if x < 0:
            raise ValueError("below zero")
        return x

    @nb.njit
    def kernel(x):
        return checked(x) + 1

    assert kernel(1.0) == 2.0
    with pytest.raises(ValueError, match="below zero"):
        kernel(-1.0)
