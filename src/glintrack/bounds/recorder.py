"""Measure the loss budget on some frames of a flight: with vehicles, without, and from past frames."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack import metrics
from glintrack.bounds.evidence import group_planes, groups_of
from glintrack.bounds.finder import cell_places, find_vehicles, ground_cells
from glintrack.bounds.frame import (
    ExposedFrame,
    ObservedFrame,
    element_points,
    expected_electrons,
    full_electrons,
    measured_electrons,
    touched,
    vehicles_on,
)
from glintrack.bounds.ideal_observer import hypotheses, ideal_observer, nearest_vehicle
from glintrack.bounds.loss_budget import FrameBudget, order_observers, score_detections
from glintrack.bounds.position import moved_frames, position_information
from glintrack.bounds.predictor import PAST, PredictedBackground, predict
from glintrack.camera import project
from glintrack.core.arrays import Array
from glintrack.core.parallel import BackgroundTask, map_threads
from glintrack.ortho import on_ground, seen_ground
from glintrack.render import Hits, Observer
from glintrack.scene import Snapshot
from glintrack.sensor import Sensor, dark_noise_e

UNPOLARIZED = ("dolp", "all")  # groups that polarized light changes
PLACED_EVERY = 4  # measured frames from one on which places are told to the next: it costs a third of one
_TALL_M = 2.2
_BESIDE_M = 12.0  # of the window: half a template, and what the navigator may err by


@dataclass
class BudgetRecorder:
    """Keeps a few past frames, and what each measured frame says of each group of elements.

    Parameters
    ----------
    observer, sensor
        Of the flight.
    noise
        Generator of a frame's own noise, by its index.
    seed
        Of the draws of the ideal observer of DoLP.
    every, false_per_frame, with_unpolarized
        As the ``[bound]`` table of a case has them.
    frames, unpolarized
        By group, in order of time; the latter under light with S1 = S2 = 0. Of use after `finish`.
    """

    observer: Observer
    sensor: Sensor
    noise: Callable[[int], np.random.Generator]
    seed: int = 0
    every: int = 5
    false_per_frame: float = 20.0
    with_unpolarized: bool = False
    frames: dict[str, list[FrameBudget]] = field(default_factory=dict)
    unpolarized: dict[str, list[FrameBudget]] = field(default_factory=dict)
    _measured: int = 0
    _past: deque[ExposedFrame] = field(default_factory=lambda: deque(maxlen=PAST))
    _beside: BackgroundTask = field(default_factory=BackgroundTask)

    def measures(self, index: int) -> bool:
        """Whether the loss budget is measured on this frame."""
        return self.every > 0 and index > 0 and index % self.every == 0

    def take(self, frame: ObservedFrame) -> None:
        """Take in the next frame, and measure the loss budget if it is one of those."""
        if self.every == 0:
            return
        if self.measures(frame.index):  # beside the flight, which goes on
            placed = not self._measured % PLACED_EVERY
            self._measured += 1
            self._beside.begin(partial(self._measure, frame, tuple(self._past), placed))
        tall = frame.truth["vehicle"].values[frame.truth["height"].values > _TALL_M]
        sun = self.observer.sky.sun_direction
        occluded = touched(vehicles_on(frame.hits), tall, self.observer.camera, frame.true_pose, sun)
        kept = frame.time_s, frame.true_pose, frame.reported_pose, frame.planes, occluded
        self._past.append(ExposedFrame(*kept))

    def finish(self) -> None:
        """Wait for the frame that is being measured, before `frames` are read."""
        self._beside.wait()

    def _measure(self, frame: ObservedFrame, past: tuple[ExposedFrame, ...], placed: bool) -> None:
        """Every stage down to the reported pose, for each group, with the light as it is and unpolarized."""
        hits, camera = frame.hits, self.observer.camera
        snapshot = self.observer.city.at(frame.time_s)
        bare = self.observer.trace_without_traffic(snapshot, frame.true_pose, hits)
        without = frame.planes_with(bare)
        below = seen_ground(self.observer.city.terrain, camera, frame.reported_pose)
        points = self._near(element_points(hits, camera, frame.true_pose, bare)), self._near(below)
        begin, nearest = self._vehicles(frame, snapshot), nearest_vehicle(vehicles_on(hits))
        moved = []
        if placed:
            ids = begin().vehicles["vehicle_id"]
            moved = moved_frames(self.observer, snapshot, frame.true_pose, ids, frame.planes_with)
        for polarized, kept in ((True, self.frames), (False, self.unpolarized)):
            groups = [g for g in groups_of(self.sensor) if polarized or g in UNPOLARIZED]
            if not polarized and not self.with_unpolarized:
                continue
            known = expected_electrons(without, self.sensor, polarized)
            light = _Electrons(
                known=known,
                present=expected_electrons(frame.planes, self.sensor, polarized),
                moved=[expected_electrons(planes, self.sensor) for planes in moved if polarized],
                measured=measured_electrons(frame.planes, self.sensor, self.noise(frame.index), polarized),
                backgrounds=self._backgrounds(frame, past, known, points, polarized),
            )
            of_group = partial(self._of_group, begin, nearest, frame.truth, light)
            found = dict(zip(groups, map_threads(of_group, groups), strict=True))
            for group, one in found.items():
                kept.setdefault(group, []).append(one)
            if {"dolp", "all"} <= set(groups):
                order_observers(found)

    def _of_group(
        self,
        begin: Callable[[], FrameBudget],
        nearest: Array,
        truth: xr.Dataset,
        light: "_Electrons",
        group: str,
    ) -> FrameBudget:
        """The stages of one group: the ideal observer's, and templates fitted against each background."""
        one, area_m = begin(), self.observer.city.extent_m
        ids = one.vehicles["vehicle_id"]
        false_alarm = min(self.false_per_frame / hypotheses(area_m), 0.4)
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(one.index, 18)))
        one.probability, one.detectability = ideal_observer(
            group, light.known, light.present, nearest, ids, self.sensor, false_alarm, rng
        )
        if light.moved:
            one.information = position_information(group, light.moved, nearest, ids, self.sensor)
        middle = np.stack([truth["east"].values, truth["north"].values], axis=1)
        mine = _rows_of(truth["vehicle"].values, ids)
        for stage, (background, cells) in light.backgrounds.items():
            planes = group_planes(group, light.measured, background, self.sensor)
            found = find_vehicles(planes, cells, area_m, self.observer.sky.sun_direction)
            scored = score_detections(found.position, found.score, middle, truth["length"].values)
            one.scored[stage] = scored._replace(vehicle=scored.vehicle[mine])
        return one

    def _near(self, place: Float[Array, "row column 3"]) -> Float[Array, "row column 3"]:
        """What elements see, NaN where that is so far from the window that nothing is looked for. [m]"""
        west, south, east, north = self.observer.city.extent_m
        x, y = place[..., 0], place[..., 1]
        near = (x > west - _BESIDE_M) & (x < east + _BESIDE_M)
        near &= (y > south - _BESIDE_M) & (y < north + _BESIDE_M)
        return np.where(near[..., None], place, np.nan)

    def _backgrounds(
        self,
        frame: ObservedFrame,
        past: tuple[ExposedFrame, ...],
        known: Array,
        points: tuple[Array, ...],
        polarized: bool,
    ) -> dict[str, tuple[PredictedBackground, Array]]:
        """Known, predicted with true heights and poses, and with the reported ones and the terrain.

        With where the finder's cells are seen from the pose that each goes by.
        """
        dark2, sensor, full = dark_noise_e(self.sensor) ** 2, self.sensor, full_electrons(self.sensor)
        true_cells, reported_cells = (
            cell_places(self.observer.camera, pose, self._ground_m, self.observer.city.extent_m)
            for pose in (frame.true_pose, frame.reported_pose)
        )
        read = np.minimum(known, full)
        out = {"known_background": (PredictedBackground(read, np.maximum(read, 0) + dark2), true_cells)}
        before = [
            np.minimum(expected_electrons(p.planes, sensor, polarized), full).astype(np.float32) for p in past
        ]
        for stage, reported in (("predicted_background", False), ("reported_pose", True)):
            seen = [p.past(electrons, reported) for p, electrons in zip(past, before, strict=True)]
            found = predict(seen, points[reported], self.observer.camera, sensor.side, frame.time_s)
            variance = found.variance + np.maximum(found.electrons, 0) + dark2
            out[stage] = (
                PredictedBackground(found.electrons, variance),
                reported_cells if reported else true_cells,
            )
        return out

    @cached_property
    def _ground_m(self) -> Array:
        """Heights of the ground at the finder's cells. [m]"""
        city = self.observer.city
        x, y = ground_cells(city.extent_m)
        cells = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        return on_ground(city.terrain, cells)[:, 2].reshape(len(y), len(x))

    def _vehicles(self, frame: ObservedFrame, snapshot: Snapshot) -> Callable[[], FrameBudget]:
        """Begin a loss budget: the movers of the window, and what the visible ones are."""
        city, truth = self.observer.city, frame.truth
        movers = metrics.is_moving(truth) & metrics.is_in_window(truth, city.extent_m)
        visible = movers & metrics.is_visible(truth)
        middle = np.stack([truth[name].values for name in ("east", "north", "up")], axis=1)
        middle[:, 2] += truth["height"].values / 2
        camera = self.observer.camera
        pixel = project(camera, frame.true_pose, middle)
        with np.errstate(invalid="ignore"):
            framed = ((pixel >= -0.5) & (pixel <= np.array([camera.rows, camera.columns]) - 0.5)).all(axis=1)
        ids = truth["vehicle"].values[visible]
        rows = {
            "vehicle_id": ids,
            "length": truth["length"].values[visible],
            "speed": np.hypot(truth["east_speed"].values, truth["north_speed"].values)[visible],
            "visible_fraction": truth["visible_fraction"].values[visible],
            "sunlit": _sunlit(frame.hits, ids),
            "paint": _paints(snapshot, city.materials["material"].values, ids),
        }
        return partial(
            FrameBudget,
            index=frame.index,
            time_s=frame.time_s,
            movers=int(movers.sum()),
            in_view=int((movers & (framed | visible)).sum()),
            vehicles=rows,
            probability=np.zeros(len(ids)),
            detectability=np.zeros(len(ids)),
            information=np.zeros((len(ids), 2, 2)),
        )


@dataclass(frozen=True)
class _Electrons:
    """Electrons of a frame: without vehicles, with them, with them moved, as measured; and the backgrounds.

    ``backgrounds`` has by stage what the finder compares with, and where its cells are seen.
    """

    known: Array
    present: Array
    moved: list[Array]
    measured: Array
    backgrounds: dict[str, tuple[PredictedBackground, Array]]


def _rows_of(ids: Array, wanted: Array) -> Array:
    """Index of each wanted id among ids that are all different."""
    order = np.argsort(ids, kind="stable")
    return order[np.searchsorted(ids[order], wanted)]


def _sunlit(hits: Hits, ids: Array) -> Array:
    """Mean part of the sun's light that arrives on what is seen of each vehicle; 0 if nothing is. [1]"""
    met = hits.vehicle_id >= 0
    order = np.sort(ids)
    where = np.clip(np.searchsorted(order, hits.vehicle_id[met]), 0, max(len(order) - 1, 0))
    if not len(order):
        return np.zeros(0)
    same = order[where] == hits.vehicle_id[met]
    weight = hits.weight[met][same]
    part = np.bincount(where[same], weight, minlength=len(order))
    light = np.bincount(where[same], weight * hits.sun_visible[met][same], minlength=len(order))
    return (light / np.maximum(part, 1e-9))[np.searchsorted(order, ids)]


def _paints(snapshot: Snapshot, names: Array, ids: Array) -> Array:
    """Name of each vehicle's paint."""
    known = dict(
        zip(np.asarray(snapshot.vehicle_id).tolist(), np.asarray(snapshot.paint).tolist(), strict=True)
    )
    return np.array([str(names[known[int(i)]]) if int(i) in known else "" for i in ids], dtype=object)
