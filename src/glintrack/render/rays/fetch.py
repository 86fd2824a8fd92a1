"""Ask memory for what a kernel will read soon, so that many such waits pass at once."""

from collections.abc import Callable
from typing import Any, cast

import llvmlite.ir as ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

_INT = ir.IntType(32)
_NAME, _KIND = "llvm.prefetch.p0i8", ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, _INT, _INT, _INT])
_TO_READ, _KEEP_SOME, _DATA = 0, 2, 1  # arguments of LLVM's intrinsic


def _fetch(context, array, index):
    """Ask for the value at a flat index of an array in C's order; one outside of it does no harm."""

    def codegen(context, builder, signature, arguments):
        kind, place = signature.args
        view = context.make_array(kind)(context, builder, value=arguments[0])
        at = builder.gep(view.data, [context.cast(builder, arguments[1], place, types.intp)])
        prefetch = cgutils.get_or_insert_function(builder.module, _KIND, _NAME)
        hints = [_INT(hint) for hint in (_TO_READ, _KEEP_SOME, _DATA)]
        builder.call(prefetch, [builder.bitcast(at, cgutils.voidptr_t), *hints])
        return context.get_dummy_value()

    return types.void(array, index), codegen


fetch = cast("Callable[[Any, Any], None]", intrinsic(_fetch))
