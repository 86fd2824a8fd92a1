"""Arrays that a kernel borrows: without counting who holds them."""

from collections.abc import Callable
from typing import Any, cast

from numba import types
from numba.core import cgutils
from numba.extending import intrinsic


def _borrowed(context, value):
    """Give the same array, or tuple of arrays and numbers, without an owner.

    Numba counts the holders of an array wherever a function is handed one, with an atomic instruction that
    all cores wait for. A kernel whose caller holds the arrays need not. Borrow arguments only: what a
    function has made itself is gone after its last use.
    """

    def without_owner(context, builder, kind, given):
        if isinstance(kind, types.BaseTuple):
            parts = cgutils.unpack_tuple(builder, given, len(kind))
            bare = [without_owner(context, builder, *one) for one in zip(kind, parts, strict=True)]  # pyright: ignore
            even = isinstance(kind, types.UniTuple | types.NamedUniTuple)
            return (cgutils.pack_array if even else cgutils.pack_struct)(builder, bare)
        if not isinstance(kind, types.Array):
            return given
        view = context.make_array(kind)(context, builder, value=given)
        for owner in ("meminfo", "parent"):
            setattr(view, owner, cgutils.get_null_value(getattr(view, owner).type))
        return view._getvalue()

    def codegen(context, builder, signature, arguments):
        return without_owner(context, builder, value, arguments[0])

    return value(value), codegen


borrowed = cast("Callable[[Any], Any]", intrinsic(_borrowed))
