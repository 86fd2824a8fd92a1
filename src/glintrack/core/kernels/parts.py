"""Functions that only kernels call: compiled within their callers, and not by themselves as well.

numba translates each function that a kernel calls into machine code of its own, with two wrappers for callers
from outside, keeps all of it on disk, and compiles it again within every caller. Where calls lie five deep,
most of what it compiles is never run.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba.core.analysis import compute_cfg_from_blocks
from numba.core.codegen import JITCodeLibrary
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import BaseNativeLowering

from glintrack.core.kernels.indices import count_from_start, lowering

Function = TypeVar("Function", bound=Callable[..., Any])

_ONLY_LINKED = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


class _Part(CPUDispatcher):
    """A compiled function for kernels; plain Python where Python calls it."""

    def __call__(self, *arguments: Any) -> Any:
        return self.py_func(*arguments)


def kernel_part(counted: bool | None = None, **options: Any) -> Callable[[Function], Function]:
    """Mark a function that only kernels call.

    Parameters
    ----------
    counted
        False for what makes no array and returns none: it and what it calls then need not count who holds
        those that they are given, which all cores would wait for and is much of what there is to compile.
    options
        As of ``nb.njit``.
    """
    if counted is not None:
        options["_nrt"] = counted

    def mark(function: Function) -> Function:
        given = {"nopython": True, "boundscheck": None, **_ONLY_LINKED, **options}
        return cast(Function, _Part(py_func=function, targetoptions=given))

    return mark


class _NoEnvironment:
    """In place of what hands Python objects to machine code, where there is none."""

    @staticmethod
    def set_env(name: str, environment: Any) -> None:
        """Nothing to do."""


class _LinkedLibrary(JITCodeLibrary):
    """LLVM's code of a function, for its callers to take in."""

    with_loops: bool

    @property
    def codegen(self) -> Any:
        return _NoEnvironment

    def _optimize_final_module(self) -> None:
        within = any(getattr(library, "with_loops", False) for library in self._linking_libraries)
        if self.with_loops and not within:  # innermost loops: run in lanes where a compiler sees them alone
            super()._optimize_final_module()
        self.with_loops |= within

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """None: there is no machine code."""
        self._ensure_finalized()
        return 0

    def serialize_using_object_code(self) -> Any:
        """Without it."""
        return self.serialize_using_bitcode()


def compile_parts_once() -> None:
    """Let numba only link what has no wrappers, ours and its own; called before the first kernel.

    And compile ours without asking whether an index counts from the end (`indices`).
    """
    lower = BaseNativeLowering.run_pass
    if getattr(lower, "links_parts", False):
        return

    def lower_or_link(self: BaseNativeLowering, state: Any) -> Any:
        flags = state.flags
        if not flags.no_cpython_wrapper or state.func_id.modname.startswith("numba."):
            flags.no_cfunc_wrapper = True  # for callers in C, of which there are none
        if state.library is None and flags.no_cpython_wrapper and flags.no_cfunc_wrapper:
            library = _LinkedLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
            library.with_loops = bool(compute_cfg_from_blocks(state.func_ir.blocks).loops())
            state.library = library
        with lowering(state.func_id.modname):
            return lower(self, state)

    count_from_start()
    lower_or_link.links_parts = True  # pyright: ignore[reportFunctionMemberAccess]
    BaseNativeLowering.run_pass = lower_or_link
