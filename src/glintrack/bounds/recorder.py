"""Measure the loss budget on some frames of a flight: with vehicles, without, and from past frames."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack import metrics
from glintrack.bounds.evidence import element_groups, group_planes
from glintrack.bounds.finder import cell_places, find_vehicles, ground_cells
from glintrack.bounds.frame import (
    ExposedFrame,
    ObservedFrame,
    element_points,
    mean_electrons,
    sample_electrons,
    traffic_mask,
    vehicles_on,
)
from glintrack.bounds.ideal_observer import assign_elements, count_hypotheses, ideal_observer
from glintrack.bounds.loss_budget import FrameBudget, order_observers, score_detections
from glintrack.bounds.position import position_information, shift_vehicles
from glintrack.bounds.predictor import PAST, PredictedBackground, predict
from glintrack.camera import project
from glintrack.core.arrays import Array
from glintrack.core.parallel import BackgroundTask, map_threads
from glintrack.ortho import intersect_terrain, on_ground
from glintrack.render import Observer
from glintrack.scene import Snapshot
from glintrack.sensor import Sensor
from glintrack.track.detect.binning import binning_factor

POSITIONS_EVERY = 4  # interval of the measured frames with information on positions
_TALL_M = 2.2
_BORDER_M = 12.0  # about the window: half a template, and the navigation error


@dataclass
class BudgetRecorder:
    """Measure the stages down to the reported pose on some frames, for each group of elements.

    Parameters
    ----------
    observer, sensor
        Observer and sensor of the flight.
    noise
        Random generator of a frame's noise, by the frame's index.
    seed
        Seed of the ideal observer of DoLP.
    every, false_per_frame
        As in the ``[bound]`` table of a case.
    with_unpolarized
        Whether to measure with light of S1 = S2 = 0 too.
    first
        Index of the first scored frame.
    frames, unpolarized
        Results by group, in order of time; complete after `finish`.
    """

    observer: Observer
    sensor: Sensor
    noise: Callable[[int], np.random.Generator]
    seed: int
    every: int
    false_per_frame: float
    first: int = 1
    with_unpolarized: bool = False
    frames: dict[str, list[FrameBudget]] = field(default_factory=dict)
    unpolarized: dict[str, list[FrameBudget]] = field(default_factory=dict)
    _measured: int = 0
    _past: deque[ExposedFrame] = field(default_factory=lambda: deque(maxlen=PAST))
    _task: BackgroundTask = field(default_factory=BackgroundTask)

    def take(self, frame: ObservedFrame) -> None:
        """Add the next frame, and measure it in the background if it is one of those."""
        if frame.index >= max(self.first, 1) and frame.index % self.every == 0:
            with_positions = not self._measured % POSITIONS_EVERY
            self._measured += 1
            self._task.begin(partial(self._measure, frame, tuple(self._past), with_positions))
        tall = frame.truth["vehicle"].values[frame.truth["height_m"].values > _TALL_M]
        sun = self.observer.sky.sun_direction
        occluded = traffic_mask(vehicles_on(frame.hits), tall, self.observer.camera, frame.true_pose, sun)
        self._past.append(
            ExposedFrame(frame.time_s, frame.true_pose, frame.reported_pose, frame.planes, occluded)
        )

    def finish(self) -> None:
        """Wait for the frame that is being measured, before `frames` are read."""
        self._task.wait()

    def end_at(self, frames: int) -> None:
        """Drop frames from an index on, which an interrupt left incomplete."""
        self.finish()
        for found in (self.frames, self.unpolarized):
            for group, measured in found.items():
                found[group] = [one for one in measured if one.index < frames]

    def _measure(self, frame: ObservedFrame, past: tuple[ExposedFrame, ...], with_positions: bool) -> None:
        hits, camera = frame.hits, self.observer.camera
        gsd_m = float(np.median(hits.range_m)) * camera.pitch_m / camera.focal_length_m
        factor = min(binning_factor(gsd_m), min(camera.rows, camera.columns) // self.sensor.side)
        snapshot = self.observer.city.at(frame.time_s)
        bare = self.observer.trace_without_traffic(snapshot, frame.true_pose, hits)
        without = frame.planes_with(bare)
        below = intersect_terrain(self.observer.city.terrain, camera, frame.reported_pose)
        points = (
            self._limit_to_window(element_points(hits, camera, frame.true_pose, bare)),
            self._limit_to_window(below),
        )
        begin, nearest = self._vehicles(frame, snapshot), assign_elements(vehicles_on(hits))
        moved = []
        if with_positions:
            ids = begin().vehicles["vehicle_id"]
            moved = shift_vehicles(self.observer, snapshot, frame.true_pose, ids, frame.planes_with)
        for polarized in (True, False) if self.with_unpolarized else (True,):
            groups = [g for g in element_groups(self.sensor) if polarized or g != "pan"]
            known = mean_electrons(without, self.sensor, polarized)
            light = _Electrons(
                known=known,
                present=mean_electrons(frame.planes, self.sensor, polarized),
                moved=[mean_electrons(planes, self.sensor) for planes in moved if polarized],
                measured=sample_electrons(frame.planes, self.sensor, self.noise(frame.index), polarized),
                backgrounds=self._backgrounds(frame, past, known, points, polarized, factor * gsd_m),
                factor=factor,
            )
            of_group = partial(self._of_group, begin, nearest, frame.truth, light)
            found = dict(zip(groups, map_threads(of_group, groups), strict=True))
            for group, one in found.items():
                (self.frames if polarized else self.unpolarized).setdefault(group, []).append(one)
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
        """Stages of one group: the ideal observer, and templates fitted against each background."""
        one, area_m = begin(), self.observer.city.extent_m
        ids = one.vehicles["vehicle_id"]
        false_alarm = min(self.false_per_frame / count_hypotheses(area_m), 0.4)
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(one.index, 18)))
        one.probability, one.detectability = ideal_observer(
            group, light.known, light.present, nearest, ids, self.sensor, false_alarm, rng
        )
        if light.moved:
            one.information = position_information(group, light.moved, nearest, ids, self.sensor)
        middle = np.stack([truth["east_m"].values, truth["north_m"].values], axis=1)
        order = np.argsort(truth["vehicle"].values, kind="stable")
        mine = order[np.searchsorted(truth["vehicle"].values[order], ids)]
        for stage, (background, cells) in light.backgrounds.items():
            planes = group_planes(group, light.measured, background, self.sensor, light.factor)
            found = find_vehicles(planes, cells, area_m, self.observer.sky.sun_direction)
            scored = score_detections(found.position, found.score, middle, truth["length_m"].values)
            one.scored[stage] = scored._replace(vehicle=scored.vehicle[mine])
        return one

    def _limit_to_window(self, place: Float[Array, "row column 3"]) -> Float[Array, "row column 3"]:
        """Points that elements see, NaN far outside the window. [m]"""
        west, south, east, north = self.observer.city.extent_m
        low, high = np.array([west, south]) - _BORDER_M, np.array([east, north]) + _BORDER_M
        near = ((place[..., :2] > low) & (place[..., :2] < high)).all(axis=-1, keepdims=True)
        return np.where(near, place, np.nan)

    def _backgrounds(
        self,
        frame: ObservedFrame,
        past: tuple[ExposedFrame, ...],
        known: Array,
        points: tuple[Array, ...],
        polarized: bool,
        spacing_m: float,
    ) -> dict[str, tuple[PredictedBackground, Array]]:
        """Backgrounds by stage, each with the places of the finder's cells in the frame at its pose."""
        sensor, full = self.sensor, self.sensor.design.saturation_e
        ground_m, area_m = self._ground_m, self.observer.city.extent_m
        true_cells, reported_cells = (
            cell_places(self.observer.camera, pose, ground_m, area_m, spacing_m)
            for pose in (frame.true_pose, frame.reported_pose)
        )
        read = np.minimum(known, full)
        variance = sensor.design.noise_variance_e2(read)
        out = {"known_background": (PredictedBackground(read, variance), true_cells)}
        before = [
            np.minimum(mean_electrons(p.planes, sensor, polarized), full).astype(np.float32) for p in past
        ]
        for stage, reported in (("predicted_background", False), ("reported_pose", True)):
            seen = [p.past(electrons, reported) for p, electrons in zip(past, before, strict=True)]
            found = predict(seen, points[reported], self.observer.camera, sensor.side, frame.time_s)
            variance = found.variance + sensor.design.noise_variance_e2(found.electrons)
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
        """Prepare a frame's budget with the movers of the scored area."""
        city, truth = self.observer.city, frame.truth
        movers = metrics.is_moving(truth) & truth["inside"].values
        visible = movers & metrics.is_visible(truth)
        middle = np.stack([truth[name].values for name in ("east_m", "north_m", "up_m")], axis=1)
        middle[:, 2] += truth["height_m"].values / 2
        camera = self.observer.camera
        pixel = project(camera, frame.true_pose, middle)
        with np.errstate(invalid="ignore"):
            framed = ((pixel >= -0.5) & (pixel <= np.array([camera.rows, camera.columns]) - 0.5)).all(axis=1)
        ids, names = truth["vehicle"].values[visible], city.materials["material"].values
        paints = dict(zip(snapshot.vehicle_id.tolist(), snapshot.paint.tolist(), strict=True))
        rows = {
            "vehicle_id": ids,
            "length_m": truth["length_m"].values[visible],
            "speed_m_s": np.hypot(truth["east_speed_m_s"].values, truth["north_speed_m_s"].values)[visible],
            "visible_fraction": truth["visible_fraction"].values[visible],
            "paint": np.array([str(names[paints[i]]) if i in paints else "" for i in ids.tolist()], object),
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
            information=np.full((len(ids), 2, 2), np.nan),
        )


@dataclass(frozen=True)
class _Electrons:
    """Electrons of a frame without vehicles, with them, with them moved, as measured; and backgrounds."""

    known: Array
    present: Array
    moved: list[Array]
    measured: Array
    backgrounds: dict[str, tuple[PredictedBackground, Array]]
    factor: int
