"""Indices of our kernels count from the start, those of others as numba has them."""

import ast
import sys
import types
from pathlib import Path

import numba as nb
import numpy as np
import pytest

import glintrack
from glintrack.core.kernels import indices
from glintrack.core.kernels.parts import compile_parts_once
from tests.architecture.test_kernels import options

PACKAGE = Path(glintrack.__file__).parent
SOURCE = """
def at(values, k):
    return values[k]
"""


@pytest.fixture
def of_module(monkeypatch):
    """The functions of `SOURCE` in a module of a name."""
    compile_parts_once()  # as before every kernel

    def made(name):
        module = types.ModuleType(name)
        exec(SOURCE, vars(module))
        monkeypatch.setitem(sys.modules, name, module)
        return module

    return made


def test_others_may_count_from_the_end(of_module):
    assert nb.njit(of_module("somebody.kernels").at)(np.arange(3.0), -1) == 2.0


def test_ours_ask_for_no_sign(of_module):
    asked = {}
    for name in ("somebody.kernels", "glintrack.kernels_of_a_test"):
        kernel = nb.njit(of_module(name).at)
        assert kernel(np.arange(3.0), 1) == 1.0
        (code,) = kernel.inspect_llvm().values()
        asked[name] = any(word in code for word in ("select", "ashr"))
    assert asked == {"somebody.kernels": True, "glintrack.kernels_of_a_test": False}


def test_an_index_under_0_is_told_where_that_is_asked_for(of_module, monkeypatch):
    monkeypatch.setattr(indices, "CHECKED", True)
    kernel = nb.njit(of_module("glintrack.kernels_of_a_test").at)
    assert kernel(np.arange(3.0), 2) == 2.0
    with pytest.raises(IndexError, match="must not be under 0"):
        kernel(np.arange(3.0), -1)


def counted_from_the_end(source):
    """Lines of compiled functions that name an element by a number under 0; of tuples it is no index."""
    found = []
    for function in ast.walk(ast.parse(source)):
        if not isinstance(function, ast.FunctionDef) or options(function) is None:
            continue
        for part in ast.walk(function):
            if isinstance(part, ast.Subscript) and not ast.unparse(part.value).endswith(".shape"):
                named = part.slice.elts if isinstance(part.slice, ast.Tuple) else [part.slice]
                if any(isinstance(one, ast.UnaryOp) and isinstance(one.op, ast.USub) for one in named):
                    found.append(part.lineno)
    return found


def test_no_kernel_counts_from_the_end():
    assert counted_from_the_end("@nb.njit(cache=True)\ndef last(a):\n    return a[-1] + a.shape[-1]\n") == [3]
    found = {
        path.relative_to(PACKAGE): lines
        for path in PACKAGE.rglob("*.py")
        if (lines := counted_from_the_end(path.read_text(encoding="utf-8")))
    }
    assert not found, f"kernels count from the start (docs: kernels/indices.py), got {found}"
