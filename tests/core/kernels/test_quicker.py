"""What is quicker than numba's own in processes that compile says the same."""

import itertools

import numba as nb
import numpy as np
import pytest
from numba.core import ir
from numba.core.compiler import Flags, run_frontend
from numba.core.targetconfig import TargetConfig
from numba.core.types.functions import BaseFunction

from glintrack.core.kernels import quicker


def listed(statement):
    return [one.name for one in statement.list_vars()]


def loops(values, scale=2.0):
    total = np.zeros(3)
    for k, value in enumerate(values):
        if value > 0 and k % 2:
            total[k : k + 1] += scale * value
        else:
            total[0] = max(total[0], -value)
    return {"a": total, "b": (total, scale)}, [total, *values]


def test_variables_of_statements(monkeypatch):
    statements = [one for block in run_frontend(loops).blocks.values() for one in block.body]
    assert len(statements) > 50
    before = [listed(one) for one in statements]
    monkeypatch.setattr(ir.Inst, "_rec_list_vars", quicker._rec_list_vars)
    assert [listed(one) for one in statements] == before
    assert any(len(one) > 2 for one in before)


def flags(**values):
    made = Flags()
    for name, value in values.items():
        setattr(made, name, value)
    return made


def test_flags_are_equal_as_before():
    every = [flags(), flags(nrt=False), flags(nrt=True), flags(fastmath=True), flags(fastmath=False),
             flags(fastmath={"contract"}), flags(nrt=True, error_model="numpy"), flags(error_model="python"),
             flags(inline="always"), TargetConfig(), 3]  # fmt: skip
    for one, other in itertools.product(every[:-2], every):
        same = TargetConfig.__eq__(one, other)
        assert quicker._equal(one, other) is same or quicker._equal(one, other) == same
        if same is True:
            assert quicker._hash(one) == quicker._hash(other)
    assert quicker._hash(every[1]) != quicker._hash(every[0]) or every[0] == every[1]


def test_the_type_of_a_call_is_looked_for_once(monkeypatch):
    asked = []

    def told(self, context, arguments, named):
        asked.append((self.typing_key, arguments))
        return before(self, context, arguments, named)

    before = quicker._call_type
    monkeypatch.setattr(quicker, "_call_type", told)
    monkeypatch.setattr(BaseFunction, "get_call_type", quicker._known_call_type)

    @nb.njit
    def kernel(values, scale):
        return values[0] * scale + values[1] * scale + values[2] * 2 + np.hypot(values[3], scale)

    @nb.njit
    def wrong(values):
        return values[0] * "no number"

    values = np.arange(4.0)
    assert kernel(values, 0.5) == 0.5 + 4.0 + np.hypot(3.0, 0.5)
    assert asked and len(asked) == len(set(asked))
    count = len(asked)
    assert nb.njit(kernel.py_func)(values, 0.5) == kernel(values, 0.5)
    assert len(asked) == count
    for _ in range(2):
        with pytest.raises(nb.TypingError, match="No implementation"):
            wrong(values)


def test_a_kernel_compiles_the_same(monkeypatch):
    @nb.njit
    def kernel(values):
        total = 0.0
        for value in values:
            total += np.sqrt(value) if value > 0 else np.exp(value)
        return total

    values = np.linspace(-3, 3, 101)
    before = kernel(values)
    monkeypatch.setattr(ir.Inst, "_rec_list_vars", quicker._rec_list_vars)
    monkeypatch.setattr(TargetConfig, "__eq__", quicker._equal)
    monkeypatch.setattr(TargetConfig, "__hash__", quicker._hash)
    monkeypatch.setattr(BaseFunction, "get_call_type", quicker._known_call_type)
    assert nb.njit(kernel.py_func)(values) == before
