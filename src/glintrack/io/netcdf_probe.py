"""Read all of an HDF5 file and tell what is wrong with it: a program of its own, started by `untrusted`.

Some damaged files make the HDF5 library loop for ever or crash; here that ends this process alone. Links to
other files, raw data kept in other files, and more data than a file of its size can hold are refused.
"""

import contextlib
import sys
from pathlib import Path

import h5py
import numpy as np

try:
    import resource
except ImportError:  # not on Windows, where the time limit alone bounds it
    resource = None

REFUSED = 3
_MOST_BYTES, _MANY_BYTES, _MOST_RATIO = 16e9, 64e6, 1000
_MOST_OBJECTS, _MOST_DEPTH, _MOST_TEXT_BYTES = 20_000, 32, 1_000_000
_SLAB_BYTES = 32e6
_MEMORY_BYTES, _CPU_S, _BYTES_PER_CPU_S = 3_000_000_000, 2, 10e6


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


def main() -> int:
    """Exit 0 for a file that is whole, 3 with the reason for one that is refused."""
    path = Path(sys.argv[1])
    if resource is not None:
        seconds = int(_CPU_S + path.stat().st_size / _BYTES_PER_CPU_S)
        for limit, most in ((resource.RLIMIT_CPU, seconds), (resource.RLIMIT_AS, _MEMORY_BYTES)):
            with contextlib.suppress(ValueError, OSError):  # a lower limit holds already
                resource.setrlimit(limit, (most, most + 1))
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        probe(path)
    except Refused as reason:
        print(reason)
        return REFUSED
    except MemoryError:
        print("it takes too much memory")
        return REFUSED
    except Exception as error:  # whatever a damaged file makes the library say
        print(str(error).split("\n")[0][:120] or type(error).__name__)
        return REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(main())
