"""Probes on disk: what those of a scene gathered, for the next flight that looks at the same places.

Files are addressed by all that a probe depends on: the scene that stands still, the sun, the level ground
beyond the edge, the lattice, and the program; within them a probe is found by its key (`probe_map`). What is
read is to the last bit what would have been gathered, so that a result does not depend on what was flown
before.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numba as nb
import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.io import cache
from glintrack.io.atomic import content_hash
from glintrack.scene import Snapshot

WORTH_KEEPING = 4000  # rows: fewer probes are gathered in a twentieth of a second
_WORTH_KEEPING_BYTES = 100_000  # of parked vehicles' probes, which are gathered in a fortieth of a second
MOST_BYTES = 300_000_000  # of all files: some ten first frames of a city
_SUFFIX = ".probes"


@dataclass(frozen=True)
class KeptProbes:
    """Where the probes of a scene are kept.

    Parameters
    ----------
    scene
        From `scene_content`.
    folder
        `cache_folder` by default.
    """

    scene: str
    folder: Path | None = None

    def whole(
        self, like: tuple[Array, ...], asked: tuple[Array, ...], make: Callable[[], tuple[Array, ...]]
    ) -> tuple[Array, ...]:
        """Arrays of lengths that only ``make`` knows: as they were kept, else as it makes them.

        Parameters
        ----------
        like
            Arrays of such rows.
        asked
            What they depend on beside the scene.
        make
            Makes them.
        """
        stem = self._stem("whole" + "".join(f"{one.dtype.str}{one.shape[1:]}" for one in like), asked)
        data = cache.read(stem, _SUFFIX, self._place)
        if data is None:
            arrays = make()
            if sum(one.nbytes for one in arrays) >= _WORTH_KEEPING_BYTES:
                self._write(stem, (np.array([len(one) for one in arrays], np.int64), *arrays))
            return arrays
        lengths = np.frombuffer(data, np.int64, len(like)).tolist()
        return tuple(one.copy() for one in _cut(data, 8 * len(like), like, lengths))  # to be written to

    def by_key(self, asked: tuple[Array, ...], like: tuple[Array, ...]) -> "ProbesByKey":
        """The probes that depend on ``asked`` beside the scene; ``like`` are arrays of such rows."""
        stem = self._stem("by key" + "".join(f"{one.dtype.str}{one.shape[1:]}" for one in like), asked)
        lots = [_unpack(data, like) for data in cache.read_all(stem, _SUFFIX, self._place)]
        return ProbesByKey(lots, lambda lot: self._write(stem, lot))

    @property
    def _place(self) -> Path:
        return cache.cache_folder("probes") if self.folder is None else self.folder

    def _stem(self, shapes: str, asked: tuple[Array, ...]) -> str:
        return cache.content_stem(content_hash([self.scene, shapes, *map(_bytes, asked)]))

    def _write(self, stem: str, arrays: tuple[Array, ...]) -> None:
        if cache.keep(stem, _SUFFIX, self._place, b"".join(map(_bytes, arrays))) is not None:
            cache.trim(_SUFFIX, self._place, MOST_BYTES)


class ProbesByKey:
    """Probes of one scene under one sun: those on disk, each until it is taken, and new ones that go there.

    Parameters
    ----------
    lots
        Of those on disk: how many probes [1], key of each, rows that each has, and then its rows.
    write
        Keeps another lot.
    """

    def __init__(self, lots: list[tuple[Array, ...]], write: Callable[[tuple[Array, ...]], None]):
        self._write = write
        self._new: list[tuple[Array, ...]] = []
        self._known: tuple[Array, ...] = ()
        if lots:
            _, keys, rows, *values = (np.concatenate(parts) for parts in zip(*lots, strict=True))
            first = np.cumsum(rows, dtype=np.int64) - rows
            unique, at = np.unique(keys, return_index=True)  # processes side by side may keep the same
            self._hold((unique, first[at], *values))

    def take(
        self, keys: Int[Array, "probe"], first: Int[Array, "probe"], rows: Int[Array, "probe"], to
    ) -> Bool[Array, "probe"]:
        """Write what is known of some probes into arrays, a row or more a probe; which of them it was.

        Parameters
        ----------
        keys, first, rows
            Of each probe: its key, its first row in the arrays, and how many it has.
        to
            The arrays.
        """
        if not self._known:
            return np.zeros(len(keys), np.bool_)
        known, begin, *values = self._known
        found = np.zeros(len(keys), np.bool_)
        held = known, begin, tuple(map(_row_bytes, values)), self._left, self._rows_left
        wanted = keys, first, rows, tuple(map(_row_bytes, to))
        over_rows(_take, len(keys), held, wanted, found, least=1024)
        self._forget()
        return found

    def _forget(self) -> None:
        """Let go of what was taken, once it is half of what is held: the table of who took it has it now."""
        known, begin, *values = self._known
        if 2 * np.count_nonzero(self._left) > len(self._left):
            return
        kept = self._left, self._rows_left
        first = np.cumsum(kept[1], dtype=np.int64) - 1
        self._hold((known[kept[0]], first[begin[kept[0]]], *(one[kept[1]] for one in values)))

    def _hold(self, known: tuple[Array, ...]) -> None:
        self._known = known if len(known[0]) else ()
        self._left, self._rows_left = np.ones(len(known[0]), np.bool_), np.ones(len(known[2]), np.bool_)

    def keep(
        self, keys: Int[Array, "probe"], first: Int[Array, "probe"], rows: Int[Array, "probe"], arrays
    ) -> None:
        """Keep probes that were gathered, as soon as they are enough to be worth it; see `take`."""
        chosen = _all_rows(first, rows)
        self._new.append(
            (np.array([len(keys)]), keys, rows.astype(np.int8), *(one[chosen] for one in arrays))
        )
        if sum(len(lot[3]) for lot in self._new) < WORTH_KEEPING:
            return
        _, *parts = (np.concatenate(part) for part in zip(*self._new, strict=True))
        self._new = []
        self._write((np.array([len(parts[0])]), *parts))


def _unpack(data: bytes, like: tuple[Array, ...]) -> tuple[Array, ...]:
    """A lot from a file: see `ProbesByKey`."""
    count = np.frombuffer(data, np.int64, 1)
    keys = np.frombuffer(data, np.int64, count[0], 8)
    rows, start = np.frombuffer(data, np.int8, count[0], 8 + keys.nbytes), 8 + keys.nbytes + count[0]
    total = int(rows.sum(dtype=np.int64))
    return count, keys, rows, *_cut(data, start, like, len(like) * [total])


def _cut(data: bytes, start: int, like: tuple[Array, ...], lengths: list[int]) -> list[Array]:
    """Arrays of such rows and so many that lie one after the other from ``start`` on."""
    values = []
    for one, rows in zip(like, lengths, strict=True):
        wide = int(np.prod(one.shape[1:], dtype=int))
        values.append(np.frombuffer(data, one.dtype, rows * wide, start).reshape(rows, *one.shape[1:]))
        start += values[-1].nbytes
    return values


def _row_bytes(array: Array) -> Int[Array, "row byte"]:
    """The memory of an array's rows."""
    return array.reshape(len(array), math.prod(array.shape[1:])).view(np.uint8)


@nb.njit(nogil=True, cache=True)
def _take(start, stop, held, wanted, found):
    """`ProbesByKey.take` of probes ``start`` to ``stop``; what is taken is no longer left."""
    known, begin, values, left, rows_left = held
    keys, first, rows, to = wanted
    for k in range(start, stop):
        at = np.searchsorted(known, keys[k])
        if at == len(known) or known[at] != keys[k]:
            continue
        found[k], left[at] = True, False
        for row in range(rows[k]):
            source, target = begin[at] + row, first[k] + row
            rows_left[source] = False
            for field in range(len(to)):
                for byte in range(to[field].shape[1]):
                    to[field][target, byte] = values[field][source, byte]


def _all_rows(first: Int[Array, "probe"], rows: Int[Array, "probe"]) -> Int[Array, "row"]:
    """The rows of some probes, one probe's after the other's."""
    ends = np.cumsum(rows, dtype=np.int64)
    return np.repeat(first - ends + rows, rows) + np.arange(ends[-1] if len(ends) else 0)


def scene_content(
    snapshot: Snapshot,
    gap_fraction: Float[Array, "material"] | None,
    shares: Float[Array, "row class"] | None,
    window: tuple[float, float, float, float] | None,
) -> str:
    """Hash of all that stands still in a scene, and of the programs that follow rays in it."""
    fixed = slice(0, snapshot.fixed)
    meshes = (snapshot.static, *snapshot.models)
    arrays = [part for mesh in meshes for part in (mesh.vertices, mesh.faces, mesh.material)]
    arrays += [snapshot.transforms[fixed], snapshot.model[fixed], snapshot.paint[fixed]]
    arrays += [np.zeros(0) if part is None else np.asarray(part) for part in (gap_fraction, shares, window)]
    described = [f"{one.dtype.str}{one.shape}" for one in arrays]
    return content_hash([_programs(), *described, *map(_bytes, arrays)])


@lru_cache(maxsize=1)
def _programs() -> str:
    """Hash of this folder's source, and the version of the library that traces."""
    try:
        tracer = version("embreex")
    except PackageNotFoundError:
        tracer = "none"
    sources = sorted(Path(__file__).parent.rglob("*.py"))
    return content_hash([tracer, *(source.read_bytes() for source in sources)])


def _bytes(array: Array) -> bytes:
    return np.ascontiguousarray(array).tobytes()
