"""Name the step that long work is at, for whoever listens: the command line prints it.

The library calls `step`. Nothing happens unless `listen` was called in the same thread.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Listener = Callable[[str], None]
_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)
_current: ContextVar[str] = ContextVar("current", default="")


@contextmanager
def listen(listener: Listener) -> Iterator[None]:
    """Call a function with the text of each step that begins, and with an empty text after the last."""
    before = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(before)


@contextmanager
def step(name: str) -> Iterator[Callable[[float], None]]:
    """Report a step while it runs.

    Parameters
    ----------
    name
        Description, such as "solving the sky".

    Yields
    ------
    Function to call with the finished share of the step, 0 to 1. [1]
    """
    listener = _listener.get() or (lambda text: None)
    outer = _current.get()
    before = _current.set(name)
    listener(name)
    try:
        yield lambda share: listener(f"{name}, {100 * share:.0f} %")
    finally:
        _current.reset(before)
        listener(outer)
