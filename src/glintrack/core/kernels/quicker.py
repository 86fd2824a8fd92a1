"""numba's own Python made quicker, in processes that only compile: what they compile stays the same.

Two thirds of the time to compile our kernels is numba's Python. An eighth of all of it goes into asking anew
what type a function of numba's gives for the types of its arguments, a tenth into comparing
flags, listing the variables of its intermediate code, and events for each call of LLVM that nobody reads.
What these touch is not numba's public face: where a later numba lacks it, all is as without.
"""

from contextlib import suppress
from typing import Any

import numpy as np
from llvmlite.binding import ffi
from numba.core import ir
from numba.core.targetconfig import TargetConfig
from numba.core.types.functions import BaseFunction

_call_type = BaseFunction.get_call_type
_PLAIN = frozenset({int, str, bool, float, type(None), ir.Loc, np.dtype})


def compile_quicker() -> None:
    """Let this process compile in less time."""
    with suppress(AttributeError):
        ffi.lib._lock._cblist.clear()
    ir.Inst._rec_list_vars = _rec_list_vars
    TargetConfig.__eq__ = _equal
    TargetConfig.__hash__ = _hash
    BaseFunction.get_call_type = _known_call_type


def _rec_list_vars(self: Any, val: Any) -> list:
    """As numba's, by class: most of what an instruction holds is plain."""
    kind, value = type(val), val
    if kind is ir.Var:
        return [value]
    if kind in _PLAIN:
        return []
    if isinstance(value, ir.Inst):
        return value.list_vars()
    if kind is dict:
        value = value.values()
    elif not isinstance(value, list | tuple):
        return []
    found = []
    for part in value:
        if type(part) is ir.Var:
            found.append(part)
        elif type(part) not in _PLAIN:
            found.extend(_rec_list_vars(self, part))
    return found


def _equal(self: Any, other: Any) -> Any:
    """As numba's, which asks for every option of both: only those that are set can differ."""
    if self is other:
        return True
    if type(self) is not type(other):
        return self.values() == other.values() if isinstance(other, TargetConfig) else NotImplemented
    mine, theirs = self._values, other._values
    if mine == theirs:
        return True
    options = type(self).options
    return all(
        mine.get(name, options[name].default) == theirs.get(name, options[name].default)
        for name in mine.keys() | theirs.keys()
    )


def _hash(self: Any) -> int:
    """Of what is set beyond the defaults; numba's is of the options' names, the same for all."""
    options = type(self).options
    return hash(frozenset(name for name, value in self._values.items() if value != options[name].default))


def _known_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
    """As numba's, which tries all that a function is for at each call: fifteen times for the same types."""
    known = self.__dict__.setdefault("_known", {})
    key = context, args, tuple(kws.items())
    if key not in known:  # what fits none is told, and not kept
        known[key] = _call_type(self, context, args, kws)
    return known[key]
