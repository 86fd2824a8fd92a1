"""Signatures of kernels as plain text: numba's types to JSON values and back.

A scalar is its name (``float64``), an array its type, dimensions and order (``float32 2C``; ``readonly`` if
it is), a tuple a list, a named tuple a list that begins with its class (``module:Class``).
"""

import importlib
from typing import Any

from numba.core import types

_NAMED = ":"


def to_plain(kind: Any) -> Any:
    """The JSON value of a type.

    Raises
    ------
    ValueError
        If kernels are not called with such types from Python.
    """
    if isinstance(kind, types.Array):
        return f"{kind.dtype} {kind.ndim}{kind.layout}{'' if kind.mutable else ' readonly'}"
    if isinstance(kind, types.BaseTuple):
        whole: Any = kind  # numba's classes tell type checkers little
        parts = [to_plain(part) for part in whole]
        if isinstance(kind, types.BaseNamedTuple):
            made = whole.instance_class
            return [f"{made.__module__}{_NAMED}{made.__qualname__}", *parts]
        return parts
    if isinstance(kind, (types.Number, types.Boolean, types.NoneType)):
        return str(kind)
    raise ValueError(f"the kernels' signatures must be of arrays, numbers and tuples, got {kind}")


def from_plain(value: Any) -> Any:
    """The type of a JSON value."""
    if isinstance(value, list):
        if value and isinstance(value[0], str) and _NAMED in value[0]:
            return types.BaseTuple.from_types([from_plain(part) for part in value[1:]], attribute(value[0]))
        return types.BaseTuple.from_types([from_plain(part) for part in value])
    scalar, _, rest = value.partition(" ")
    if not rest:
        return types.none if scalar == "none" else getattr(types, scalar)
    return types.Array(getattr(types, scalar), int(rest[0]), rest[1], readonly=rest.endswith("readonly"))


def attribute(name: str) -> Any:
    """What ``module:name`` stands for."""
    module, _, rest = name.partition(_NAMED)
    return getattr(importlib.import_module(module), rest)
