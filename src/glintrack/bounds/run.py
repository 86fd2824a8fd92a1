"""The loss budget of a flight: beside the tracker as it flies, or down to the reported pose without one."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.bounds.accuracy import Sighting, Turn, flight_accuracy, sighting, turn
from glintrack.bounds.frame import ObservedFrame
from glintrack.bounds.loss_budget import (
    FrameBudget,
    OracleRules,
    Scored,
    loss_budget,
    score_detections,
    track_by_oracle,
)
from glintrack.bounds.recorder import BudgetRecorder
from glintrack.case.build import build_scenario
from glintrack.case.design import Case
from glintrack.core.arrays import Array
from glintrack.loop import case_navigation_errors, frame_rngs, true_frame_at
from glintrack.render import Observer
from glintrack.results.epoch import Epoch, TrueFrame
from glintrack.track import Detections, TrackDesign
from glintrack.track.initiation import confirmation


@dataclass
class FlightBudget:
    """Watches a run: the stages above the tracker on some frames, the detector's and the tracker's on all.

    Parameters
    ----------
    case
        The design being flown.
    """

    case: Case
    recorder: BudgetRecorder | None = None
    _scores: dict[str, list[dict[int, float]]] = field(default_factory=dict)
    _likelihood_ratios: set[str] = field(default_factory=set)
    _times_s: list[float] = field(default_factory=list)
    _turns: dict[tuple[str, int], tuple] = field(default_factory=dict)
    _sightings: list[Sighting] = field(default_factory=list)
    _loops: dict[str, list[Turn]] = field(default_factory=dict)

    def measure(self, epoch: Epoch) -> None:
        """Called after every turn of a loop."""
        if self.case.bound.every == 0:
            return
        true_frame = epoch.true_frame
        if self.recorder is None:
            self.recorder = _recorder(self.case, epoch.observer, true_frame)
        if epoch.channel == self.case.channels[0]:
            self._times_s.append(epoch.time_s)
            self.recorder.take(_observed(epoch.index, epoch.time_s, true_frame, epoch.observer))
            area_m = epoch.city.extent_m
            self._sightings.append(sighting(epoch.time_s, true_frame.true_pose, true_frame.truth, area_m))
        truth, found = true_frame.truth, epoch.detections
        place = np.stack([truth["east"].values, truth["north"].values], axis=1)
        scored = score_detections(found.position, _score(found), place, truth["length"].values)
        ids = truth["vehicle"].values.tolist()
        now = turn(self._sightings[-1], found.position, epoch.tracks)
        self._loops.setdefault(epoch.channel, []).append(now)
        best = dict(zip(ids, scored.vehicle.tolist(), strict=True))
        self._scores.setdefault(epoch.channel, []).append(best)
        if found.log_likelihood_ratio is not None:
            self._likelihood_ratios.add(epoch.channel)
        if self.recorder.measures(epoch.index):
            self._turns[epoch.channel, epoch.index] = best, scored.false

    def budgets(self, tree: xr.DataTree) -> dict[str, xr.Dataset]:
        """Group of elements -> its loss budget; nothing if no frame was measured or nothing moved on them.

        Parameters
        ----------
        tree
            Result of the flight, whose tracks are the last stage.
        """
        recorder = self.recorder
        if recorder is None:
            return {}
        recorder.finish()
        if not any(f.movers for frames in recorder.frames.values() for f in frames):
            return {}
        for channel in self.case.channels:
            if channel in recorder.frames:  # a loop looks at the group of elements of its name
                rows = tree[channel]["tracks"].to_dataset()
                self._add_loop(channel, recorder.frames[channel], rows)
        return _budgets(recorder, self._sightings, self._loops)

    def _add_loop(self, channel: str, frames: list[FrameBudget], rows: xr.Dataset) -> None:
        """The detector's and the tracker's stages of each frame, and what an oracle would have held."""
        scores = self._scores.get(channel, [])
        done = min(len(scores), len(self._times_s))
        times = np.array(self._times_s[:done])
        frames = [f for f in frames if (channel, f.index) in self._turns]  # an interrupt cuts one in half
        at = np.searchsorted(times, np.array([f.time_s for f in frames]) - 1e-9).tolist()
        rules = oracle_rules(self.case.track, times, channel in self._likelihood_ratios)
        found: dict[int, Array] = {}
        for frame, now in zip(frames, at, strict=True):
            ids = frame.vehicles["vehicle_id"].tolist()
            for i in set(ids) - found.keys():
                score = np.array([one.get(i, -np.inf) for one in scores[:done]], float)
                found[i] = track_by_oracle(score, times, rules)
            best, false = self._turns[channel, frame.index]
            frame.scored["detector"] = Scored(np.array([best[i] for i in ids], float), false)
            frame.tracked["tracker"] = np.isin(ids, _matched(rows, frame.time_s))
            frame.tracked["oracle_association"] = np.array([found[i][now] for i in ids], bool)


def _matched(rows: xr.Dataset, time_s: float) -> Array:
    """Vehicles that a track was matched to at a time."""
    if not rows.sizes.get("row"):
        return np.empty(0, np.int64)
    return rows["vehicle_id"].values[np.isclose(rows["time_s"].values, time_s)]


def measure_bounds(case: Case, progress: Callable[[int], None] | None = None) -> dict[str, xr.Dataset]:
    """Measure the loss budget of a case down to the reported pose, without a tracker.

    Parameters
    ----------
    case
        The design.
    progress
        Called with the number of frames done.

    Raises
    ------
    ValueError
        If no frame is measured, or nothing moves on those that are.
    """
    every = max(case.bound.every, 1)
    last = (case.flight.frames - 1) // every * every
    if last == 0:
        raise ValueError(
            f"`flight.frames` must be more than bound.every, {every}, for a loss budget, "
            f"got {case.flight.frames}"
        )
    scenario = build_scenario(case)
    observer, flight = scenario.observer, scenario.flight
    errors = case_navigation_errors(case, flight.times_s)
    recorder, sightings = None, []
    for k, t in enumerate(flight.times_s[: last + 1]):
        true_frame = true_frame_at(scenario, t, errors[k])
        recorder = recorder or _recorder(case, observer, true_frame, True)
        recorder.take(_observed(k, float(t), true_frame, observer))
        sightings.append(sighting(float(t), true_frame.true_pose, true_frame.truth, scenario.city.extent_m))
        if progress is not None:
            progress(k + 1)
    if recorder is None:
        return {}
    recorder.finish()
    return _budgets(recorder, sightings, {})


def list_stages(found: xr.Dataset) -> list[tuple[str, float, float, float]]:
    """Stage, share of the movers, of the visible ones, and unpolarized, of those that were measured."""
    bare = found["unpolarized"].values if "unpolarized" in found else np.full(found.sizes["stage"], np.nan)
    rows = zip(
        found["stage"].values, found["of_moving"].values, found["of_visible"].values, bare, strict=True
    )
    return [(str(r), float(a), float(b), float(c)) for r, a, b, c in rows if np.isfinite(a)]


def _recorder(
    case: Case, observer: Observer, true_frame: TrueFrame, unpolarized: bool = False
) -> BudgetRecorder:
    def noise(frame: int) -> np.random.Generator:
        return frame_rngs(case.seed, frame).noise

    return BudgetRecorder(
        observer=observer,
        sensor=true_frame.sensor,
        noise=noise,
        seed=case.seed,
        every=max(case.bound.every, 1),
        false_per_frame=case.bound.false_per_frame,
        with_unpolarized=unpolarized,
    )


def _observed(index: int, time_s: float, frame: TrueFrame, observer: Observer) -> ObservedFrame:
    """The frame as the recorder takes it."""
    return ObservedFrame(
        index=index,
        time_s=time_s,
        true_pose=frame.true_pose,
        reported_pose=frame.reported_pose,
        hits=frame.hits,
        planes=frame.planes,
        planes_with=partial(frame.planes_with, observer),
        truth=frame.truth,
    )


def _budgets(
    recorder: BudgetRecorder, sightings: list[Sighting], loops: dict[str, list[Turn]]
) -> dict[str, xr.Dataset]:
    """The loss budget of each group of elements, and how well positions can be known."""
    out = {}
    for group, frames in recorder.frames.items():
        stages = loss_budget(frames, recorder.false_per_frame)
        if group in recorder.unpolarized:
            bare = loss_budget(recorder.unpolarized[group], recorder.false_per_frame)
            stages["unpolarized"] = bare["of_moving"]
        turns = loops.get(group)
        accuracy = flight_accuracy(sightings if turns is None else sightings[: len(turns)], frames, turns)
        out[group] = stages.merge(accuracy).assign_attrs(stages.attrs | accuracy.attrs)
    return out


def oracle_rules(
    design: TrackDesign, times_s: Float[Array, "time"], has_likelihood_ratio: bool
) -> OracleRules:
    """Rules of the tracker that are in use for detections with or without likelihood ratios."""
    design = design.effective(has_likelihood_ratio)
    begin = design.initiation
    hits, window = confirmation(design, float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0)
    single_score = begin.confirm_ratio if has_likelihood_ratio else np.inf
    lag_s = design.reporting.effective_lag_s
    return OracleRules(hits, window, begin.confirm_s, single_score, begin.coast_s, lag_s)


def _score(found: Detections) -> Array:
    """What a detector sorts its detections by."""
    return found.contrast if found.log_likelihood_ratio is None else found.log_likelihood_ratio
