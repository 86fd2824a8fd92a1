"""numba's cache of compiled kernels: a file that is cut short is compiled anew, no traceback at every start.

numba takes a missing file for a kernel that is not compiled yet, but raises what unpickling says of a damaged
one, which a full disk or a killed process leaves behind.
"""

from typing import Any

from numba.core.caching import IndexDataCacheFile


def rebuild_damaged_kernels() -> None:
    """Let numba forget damaged files of its cache; called before the first kernel is."""
    load = IndexDataCacheFile.load
    if getattr(load, "forgets_damaged", False):
        return

    def load_or_forget(self: IndexDataCacheFile, key: Any) -> Any:
        try:
            return load(self, key)
        except Exception:  # whatever unpickling half a file says
            self.flush()
            return None

    load_or_forget.forgets_damaged = True  # pyright: ignore[reportFunctionMemberAccess]
    IndexDataCacheFile.load = load_or_forget
