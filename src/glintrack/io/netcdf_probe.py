"""Read all of HDF5 files and tell what is wrong with them: a program of its own, started by `netcdf_guard`.

Some damaged files make the HDF5 library loop for ever or crash; here that ends a child forked for the file
alone. Links to other files, raw data kept in other files, and more data than a file of its size can hold are
refused. It reads a question a line, and answers with what is wrong: nothing, or a few words; both as JSON.
"""

import contextlib
import json
import os
import select
import signal
import sys
from pathlib import Path

import h5py
import numpy as np

try:
    import resource
except ImportError:  # not on Windows, where the time limit alone bounds it
    resource = None

_MOST_BYTES, _MANY_BYTES, _MOST_RATIO = 16e9, 64e6, 1000
_MOST_OBJECTS, _MOST_DEPTH, _MOST_TEXT_BYTES = 20_000, 32, 1_000_000
_SLAB_BYTES = 32e6
_MEMORY_BYTES, _CPU_S, _BYTES_PER_CPU_S = 3_000_000_000, 2, 10e6
_IDLE_S = 10.0  # after which the process ends
_MOST_REASON_BYTES = 400  # less than a pipe holds


class Refused(Exception):
    """What is wrong, in a few words."""


def probe(path: Path) -> None:
    """Visit every group, attribute and chunk of a file."""
    size = path.stat().st_size
    total = count = 0
    with h5py.File(path, "r") as file:
        waiting: list[tuple[h5py.Group, int]] = [(file, 0)]
        seen = {h5py.h5o.get_info(file.id).addr}  # pyright: ignore[reportAttributeAccessIssue]
        while waiting:
            group, depth = waiting.pop()
            _read_attributes(group)
            for name in group:
                if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                    raise Refused("it links to elsewhere")
                item = group[name]
                count += 1
                if count > _MOST_OBJECTS or depth > _MOST_DEPTH:
                    raise Refused("it holds too many groups and variables")
                address = h5py.h5o.get_info(item.id).addr  # pyright: ignore[reportAttributeAccessIssue]
                if address in seen:
                    raise Refused("one variable has two names")
                seen.add(address)
                if isinstance(item, h5py.Group):
                    waiting.append((item, depth + 1))
                elif isinstance(item, h5py.Dataset):
                    _read_attributes(item)
                    total += item.nbytes
                    if total > min(_MOST_BYTES, max(_MANY_BYTES, _MOST_RATIO * size)):
                        raise Refused(f"it says to hold {total / 1e6:.0f} MB in {size / 1e6:.3f}")
                    _read_data(item)


def _read_attributes(item: h5py.Group | h5py.Dataset) -> None:
    for value in item.attrs.values():
        if isinstance(value, (str, bytes)) and len(value) > _MOST_TEXT_BYTES:
            raise Refused("a text in it is too long")


def _read_data(data: h5py.Dataset) -> None:
    if data.external or data.is_virtual:
        raise Refused("its data lie in other files")
    if data.shape is None or not data.size:
        return
    if not data.shape:
        data[()]
        return
    if data.dtype.kind == "O" and data.size > _MOST_TEXT_BYTES:
        raise Refused("it holds too many texts")
    rows = max(int(_SLAB_BYTES // max(data.nbytes / data.shape[0], 1)), 1)
    for start in range(0, data.shape[0], rows):
        np.asarray(data[start : start + rows])


def fault_of(path: Path) -> str:
    """What is wrong with a file, found in this process; empty if nothing is."""
    try:
        probe(path)
    except Refused as reason:
        return str(reason)
    except MemoryError:
        return "it takes too much memory"
    except Exception as error:  # whatever a damaged file makes the library say
        return str(error).split("\n")[0][:120] or type(error).__name__
    return ""


def _bound(size: int, wall_s: int) -> None:
    """Bound what this process may use for a file of that size. [byte, s]"""
    if resource is None:
        return
    seconds = int(_CPU_S + size / _BYTES_PER_CPU_S)
    for limit, most in ((resource.RLIMIT_CPU, seconds), (resource.RLIMIT_AS, _MEMORY_BYTES)):
        with contextlib.suppress(ValueError, OSError):  # a lower limit holds already
            resource.setrlimit(limit, (most, most + 1))
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(wall_s)


def _found_by_a_child(asked: dict) -> str:
    """What is wrong with a file, or what its reader ended of."""
    mine, its = os.pipe()
    child = os.fork()
    if child == 0:
        code = 1
        try:
            path = Path(asked["path"])
            _bound(path.stat().st_size, asked["seconds"])
            os.write(its, fault_of(path).encode("utf-8", "replace")[:_MOST_REASON_BYTES])
            code = 0
        finally:
            os._exit(code)
    os.close(its)
    with os.fdopen(mine, "rb") as told:
        reason = told.read().decode("utf-8", "replace")
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if code in (-signal.SIGXCPU, -signal.SIGKILL, -signal.SIGALRM):
        return asked["endless"]
    return asked["broken"] if code else reason


def main() -> None:
    """Answer until there are no more questions, or none for a while."""
    forks = hasattr(os, "fork")
    if forks:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # meant for who asks
    while not forks or select.select([sys.stdin], [], [], _IDLE_S)[0]:
        line = sys.stdin.readline()
        if not line:
            return
        asked = json.loads(line)
        fault = _found_by_a_child(asked) if forks else fault_of(Path(asked["path"]))
        print(json.dumps(fault), flush=True)


if __name__ == "__main__":
    main()
