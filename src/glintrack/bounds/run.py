"""Loss budget of a flight: measured while it is simulated, or down to the reported pose without a tracker."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.bounds.accuracy import FrameTracking, FrameTruth, flight_accuracy
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
from glintrack.core.arrays import Array, is_at_time
from glintrack.loop import case_navigation_errors, frame_rngs, true_frame_at
from glintrack.render import Observer
from glintrack.results.epoch import Epoch, TrueFrame
from glintrack.track import TrackDesign
from glintrack.track.initiation import confirmation


@dataclass
class FlightBudget:
    """Measure the loss budget of a simulation; `measure` is its callback.

    The stages down to the reported pose are measured on some frames, detector and tracker on all.

    Parameters
    ----------
    case
        The simulated case.
    """

    case: Case
    recorder: BudgetRecorder | None = None
    _truths: list[FrameTruth] = field(default_factory=list)
    # of each channel, frame by frame
    _scored: dict[str, list[Scored]] = field(default_factory=dict)
    _tracking: dict[str, list[FrameTracking]] = field(default_factory=dict)
    _likelihood_ratios: set[str] = field(default_factory=set)

    def measure(self, epoch: Epoch) -> None:
        """Measure one frame of one channel, in the order in which `simulate` makes them."""
        if self.case.bound.every == 0:
            return
        true_frame, found = epoch.true_frame, epoch.detections
        if self.recorder is None:
            self.recorder = _recorder(self.case, epoch.observer, true_frame)
        if epoch.channel == self.case.channels[0]:
            self.recorder.take(_view(epoch.index, epoch.time_s, true_frame, epoch.observer))
            of_frame = true_frame.true_pose, true_frame.truth, true_frame.area
            self._truths.append(FrameTruth.of(epoch.time_s, *of_frame))
        truth, ratio = self._truths[-1], found.log_likelihood_ratio
        score = found.contrast if ratio is None else ratio
        scored = score_detections(found.position, score, truth.place, truth.length)
        tracking = FrameTracking.of(truth, found.position, epoch.tracks)
        self._scored.setdefault(epoch.channel, []).append(scored)
        self._tracking.setdefault(epoch.channel, []).append(tracking)
        if ratio is not None:
            self._likelihood_ratios.add(epoch.channel)

    def end_at(self, frames: int) -> None:
        """Keep the complete frames of an interrupted flight only."""
        self._truths = self._truths[:frames]
        self._scored = {channel: found[:frames] for channel, found in self._scored.items()}
        self._tracking = {channel: found[:frames] for channel, found in self._tracking.items()}
        if self.recorder is not None:
            self.recorder.end_at(frames)

    def budgets(self, tree: xr.DataTree) -> dict[str, xr.Dataset]:
        """Loss budget of each group of elements; empty if no frame was measured or nothing moved on them.

        Parameters
        ----------
        tree
            Result of the flight with the tracks.
        """
        recorder = self.recorder
        if recorder is None:
            return {}
        recorder.finish()
        if not any(f.movers for frames in recorder.frames.values() for f in frames):
            return {}
        for channel in self.case.channels:
            if channel in recorder.frames:  # a channel uses the group of elements of its name
                rows = tree[channel]["tracks"].to_dataset()
                self._add_channel(channel, recorder.frames[channel], rows)
        return _budgets(recorder, self._truths, self._tracking)

    def _add_channel(self, channel: str, frames: list[FrameBudget], rows: xr.Dataset) -> None:
        """Add the stages of detector, oracle association and tracker to the measured frames."""
        scored = self._scored.get(channel, [])
        times_s = np.array([truth.time_s for truth in self._truths[: len(scored)]])
        best = [
            dict(zip(truth.vehicle.tolist(), one.vehicle.tolist(), strict=True))
            for truth, one in zip(self._truths, scored, strict=False)
        ]
        rules = oracle_rules(self.case.track, times_s, channel in self._likelihood_ratios)
        tracked: dict[int, Array] = {}
        for frame in frames:
            if frame.index >= len(scored):  # an interrupt came before this channel
                continue
            ids, now = frame.vehicles["vehicle_id"].tolist(), np.empty(0, np.int64)
            for i in set(ids) - tracked.keys():
                score = np.array([one.get(i, -np.inf) for one in best], float)
                tracked[i] = track_by_oracle(score, times_s, rules)
            if rows.sizes.get("row"):
                now = rows["vehicle_id"].values[is_at_time(rows["time_s"].values, frame.time_s)]
            scores = np.array([best[frame.index][i] for i in ids], float)
            frame.scored["detector"] = Scored(scores, scored[frame.index].false)
            frame.tracked["tracker"] = np.isin(ids, now)
            frame.tracked["oracle_association"] = np.array([tracked[i][frame.index] for i in ids], bool)


def measure_bounds(case: Case, progress: Callable[[int], None] | None = None) -> dict[str, xr.Dataset]:
    """Loss budget of each group of elements down to the reported pose, without a tracker.

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
            f"`flight.frames` must be more than bound.every, {every}, for a loss budget; "
            f"got {case.flight.frames}."
        )
    scenario = build_scenario(case)
    observer, flight = scenario.observer, scenario.flight
    errors = case_navigation_errors(case, flight.times_s)
    recorder, truths = None, []
    for k, t in enumerate(flight.times_s[: last + 1]):
        true_frame = true_frame_at(scenario, t, errors[k])
        recorder = recorder or _recorder(case, observer, true_frame, True)
        recorder.take(_view(k, float(t), true_frame, observer))
        truths.append(FrameTruth.of(float(t), true_frame.true_pose, true_frame.truth, true_frame.area))
        if progress is not None:
            progress(k + 1)
    assert recorder is not None
    recorder.finish()
    return _budgets(recorder, truths, {})


def _recorder(
    case: Case, observer: Observer, true_frame: TrueFrame, unpolarized: bool = False
) -> BudgetRecorder:
    return BudgetRecorder(
        observer=observer,
        sensor=true_frame.sensor,
        noise=lambda frame: frame_rngs(case.seed, frame).noise,
        seed=case.seed,
        every=max(case.bound.every, 1),
        false_per_frame=case.bound.false_per_frame,
        first=1 if unpolarized else case.track.count_learning_frames(case.flight.rate_hz),
        with_unpolarized=unpolarized,
    )


def _view(index: int, time_s: float, frame: TrueFrame, observer: Observer) -> ObservedFrame:
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
    recorder: BudgetRecorder, truths: list[FrameTruth], tracking: dict[str, list[FrameTracking]]
) -> dict[str, xr.Dataset]:
    """Loss budget of each group of elements, with the accuracy of positions."""
    out = {}
    for group, frames in recorder.frames.items():
        budget = loss_budget(frames, recorder.false_per_frame)
        if group in recorder.unpolarized:
            bare = loss_budget(recorder.unpolarized[group], recorder.false_per_frame)
            budget["unpolarized"] = bare["of_moving"]
        of_group = tracking.get(group)
        seen = truths if of_group is None else truths[: len(of_group)]
        accuracy = flight_accuracy(seen, frames, of_group)
        out[group] = budget.merge(accuracy).assign_attrs(budget.attrs | accuracy.attrs)
    return out


def oracle_rules(
    design: TrackDesign, times_s: Float[Array, "time"], has_likelihood_ratio: bool
) -> OracleRules:
    """Rules of the tracker that are in use for detections with or without likelihood ratios."""
    design = design.effective(has_likelihood_ratio)
    rules = design.initiation.in_use
    hits, window = confirmation(rules, float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0)
    single_score = rules.confirm_ratio if has_likelihood_ratio else np.inf
    coast_s, lag_s = design.initiation.coast_s, design.reporting.effective_lag_s
    return OracleRules(hits, window, rules.confirm_min_age_s, single_score, coast_s, lag_s)
