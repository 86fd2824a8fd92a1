"""What cases of a set share, so that it is made once: the city of one scene, the hits of one geometry.

The standard set flies each scene from three angles in two hazes. City, intersectors and probes of the sky are
the scene's; what rays meet is the angle's. Neither decides what a frame holds: the same bytes come of a case
flown alone (`tests/dataset/test_together.py`).
"""

from collections.abc import Callable, Iterable, Sequence

from glintrack.case.build import Scenario, build_scenario, decides_hits
from glintrack.case.design import Case
from glintrack.dataset.fly import LabelledFrame, labelled_frames
from glintrack.dataset.plan import Shard
from glintrack.io.toml import to_toml
from glintrack.render import TracedFrame


def by_scene(shards: Iterable[Shard]) -> list[list[list[Shard]]]:
    """Shards scene by scene as they are flown, those that see the same at the same times together."""
    scenes: dict[str, dict[tuple, list[Shard]]] = {}
    for shard in shards:
        groups = scenes.setdefault(to_toml(shard.case.scene), {})
        groups.setdefault((str(decides_hits(shard.case)), shard.frames), []).append(shard)
    return [list(groups.values()) for groups in scenes.values()]


class LastFrame:
    """The frame traced last, for the cases that look at it one after the other: a `render.FrameCache`."""

    def __init__(self) -> None:
        self._time_s: float | None = None
        self._frame: TracedFrame | None = None

    def get(self, time_s: float, observe: Callable[[], TracedFrame]) -> TracedFrame:
        """The frame of that time: the last one, or what ``observe`` gives."""
        if self._frame is None or time_s != self._time_s:
            self._frame = None  # no two at a time: they are large
            self._frame, self._time_s = observe(), time_s
        return self._frame


class SceneFlights:
    """Flies shards over one scene, whose city, intersectors and probes are built once."""

    def __init__(self) -> None:
        self._scenarios: dict[str, Scenario] = {}

    def fly(self, shards: Sequence[Shard], tell: Callable[[Shard], None]) -> list[list[LabelledFrame]]:
        """Frames of shards of one geometry, each as it is when its shard is flown alone.

        Parameters
        ----------
        shards
            One of the lists of `by_scene`.
        tell
            Called after each frame with its shard.
        """
        if self._coarsened:
            self._scenarios.clear()
        used = bool(self._scenarios)
        found = self._flown(shards, tell)
        if used and self._coarsened:  # as it would not be, had nothing been flown before
            self._scenarios.clear()
            found = self._flown(shards, lambda shard: None)
        return found

    @property
    def _coarsened(self) -> bool:
        return any(one.observer.tracer.probes.coarsened for one in self._scenarios.values())

    def _flown(self, shards: Sequence[Shard], tell: Callable[[Shard], None]) -> list[list[LabelledFrame]]:
        last, found = LastFrame(), [list[LabelledFrame]() for _ in shards]
        flights = [labelled_frames(s.case, self._scenario(s.case), s.frames, last) for s in shards]
        for frames in zip(*flights, strict=True):
            for shard, mine, frame in zip(shards, found, frames, strict=True):
                mine.append(frame)
                tell(shard)
        return found

    def _scenario(self, case: Case) -> Scenario:
        if case.name not in self._scenarios:
            near = next(iter(self._scenarios.values()), None)
            self._scenarios[case.name] = build_scenario(case, like=near)
        return self._scenarios[case.name]
