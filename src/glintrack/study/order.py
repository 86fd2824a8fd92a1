"""In which order cases fly, so that as few rays as possible are traced twice."""

from collections import Counter, deque
from collections.abc import Iterable, Mapping


class WorkQueue:
    """Cases to do, by geometry.

    First come cases whose hits are there, then one of each geometry that nobody traces yet, widely shared
    ones before others, and last those whose hits are being traced at the time: an idle worker would be worse.

    Parameters
    ----------
    keys
        Cases to do.
    geometry_of
        What each case's hits are addressed by.
    """

    def __init__(self, keys: Iterable[str], geometry_of: Mapping[str, str]):
        self._geometry_of = geometry_of
        self._groups: dict[str, deque[str]] = {}
        self._traced: set[str] = set()
        self._ready: deque[str] = deque()
        self._left: Counter[str] = Counter()
        self._count = 0  # all that is left: a sum over a thousand geometries for each case would cost minutes
        for key in keys:
            self._groups.setdefault(geometry_of[key], deque()).append(key)
            self._left[geometry_of[key]] += 1
            self._count += 1
        widest = sorted(self._groups, key=lambda place: -len(self._groups[place]))
        self._fresh: dict[str, None] = dict.fromkeys(widest)  # in order, and quick to leave

    def __len__(self) -> int:
        return self._count

    def pop(self) -> str:
        """The next case to fly."""
        if self._ready:
            key = self._ready.popleft()
        else:
            place = next(iter(self._fresh or self._groups))
            self._fresh.pop(place, None)
            key = self._groups[place].popleft()
            if not self._groups[place]:
                del self._groups[place]
        self._left[self._geometry_of[key]] -= 1
        self._count -= 1
        return key

    def push(self, key: str) -> None:
        """A case to be flown once more."""
        place = self._geometry_of[key]
        self._left[place] += 1
        self._count += 1
        if place in self._traced:
            self._ready.append(key)
            return
        if place not in self._groups:
            self._fresh[place] = None
        self._groups.setdefault(place, deque()).append(key)

    def traced(self, place: str) -> None:
        """A geometry's hits are there now."""
        if place not in self._traced:
            self._traced.add(place)
            self._ready.extend(self._groups.pop(place, ()))
            self._fresh.pop(place, None)

    def left(self, place: str) -> int:
        """How many cases of a geometry are still to be flown."""
        return self._left[place]
