"""State of the tracker; detections of an epoch and the targets predicted to it, the input of association."""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.track import clutter, hypotheses, identity
from glintrack.track.design import TrackDesign
from glintrack.track.detect import detections
from glintrack.track.detect.detections import Detections, no_detections, order, take
from glintrack.track.detect.detector import Detector, detector_of
from glintrack.track.detect.frame import Frame, Grid, grid_of, in_view
from glintrack.track.existence import Duplicates, no_duplicates
from glintrack.track.flow import Flow, no_flow
from glintrack.track.initiation import Targets, is_slow, is_stopped
from glintrack.track.motion import (
    COAST_DAMPING_S,
    MAX_COAST_SIGMA_M,
    MAX_STOPPED_SIGMA_M,
    STOPPED_DAMPING_S,
    Motion,
    motion_model,
    predict_modes,
)
from glintrack.track.roads import Roads


@dataclass(frozen=True)
class TrackerState:
    """State of the tracker between two frames.

    Parameters
    ----------
    design, detector, seed
        See `start`; without a detector the first frame decides.
    frame
        Number of frames processed.
    time_s, interval_s
        Epoch of the last frame, and time between the last two (0 before the second). [s]
    grid, memory, clutter
        Grid of the frames, the detector's own state, and the clutter density [m⁻²]; None before the first.
    targets, next_id
        All targets, confirmed or not, and the id of the next one.
    population, ground
        Spectral features of vehicles, and of the road.
    detections
        Detections of the last frame.
    roads
        Road map, if one is used.
    leaves
        Hypotheses of every target, with multi-hypothesis tracking; `targets` are the best of them.
    duplicates
        Pairs of targets on one vehicle, with existence reporting.
    flow
        Flow of traffic, from which new targets take their velocity.
    """

    design: TrackDesign
    detector: Detector | None
    seed: int
    targets: Targets
    population: identity.Population
    ground: identity.Population
    frame: int = 0
    time_s: float = -math.inf
    interval_s: float = 0.0
    grid: Grid | None = None
    memory: Any = None
    clutter: Float[Array, "row column"] | None = None
    next_id: int = 0
    detections: Detections = field(default_factory=no_detections)
    roads: Roads | None = None
    leaves: hypotheses.Leaves | None = None
    duplicates: Duplicates = field(default_factory=no_duplicates)
    flow: Flow = field(default_factory=no_flow)
    has_ratios: bool = True

    @property
    def effective_design(self) -> TrackDesign:
        """Design in use for the detections so far."""
        return self.design.effective(self.has_ratios)


@dataclass(frozen=True)
class FrameDetections:
    """Detections of an epoch and the targets predicted to it.

    Parameters
    ----------
    state
        `TrackerState` before the epoch; valid with that one only.
    time_s, interval_s
        Epoch, and time since the one before (0 for the first). [s]
    grid
        Area that was searched.
    motion, predicted
        Motion model over the interval, and the predicted targets: with multiple hypotheses one for each leaf.
    in_view
        Share of each target's surroundings that had data. [1]
    found, density
        Detections from west to east, and the clutter density around each. [m⁻²]
    frame, detector, memory, given, order
        The frame, the detector, its state before the frame, its detections in its own order, and the indices
        that sort them; None for detections without a frame.
    """

    state: TrackerState
    time_s: float
    interval_s: float
    grid: Grid
    motion: Motion
    predicted: Targets
    in_view: Float[Array, "target"]
    found: Detections
    density: Float[Array, "detection"]
    frame: Frame | None = None
    detector: Detector | None = None
    memory: object = None
    given: Detections | None = None
    order: Int[Array, "detection"] | None = None

    def check(self, state: TrackerState, time_s: float | None = None) -> None:
        """Raise a ValueError for another state or time than that of the detections."""
        if self.state is not state:
            raise ValueError(
                f"`detections` must be of the state that they are used with; got those of frame "
                f"{self.state.frame} for a state of frame {state.frame}. Detect again."
            )
        if time_s is not None and time_s != self.time_s:
            raise ValueError(f"`time_s` must be the detections' {self.time_s:g} s; got {time_s:g}.")


def detect_frame(state: TrackerState, frame: Frame) -> FrameDetections:
    """Detect vehicles in a frame; `tracker.step` does this itself, or takes what this returns.

    Parameters
    ----------
    state
        `TrackerState` before the frame; not changed.
    frame
        On the same ground grid as before, later than the last.

    Raises
    ------
    ValueError
        If the image breaks its schema, its grid has changed, time does not advance, or the detector's
        detections are not finite.
    """
    design, interval_s = state.design, _interval(state, frame.time_s)
    grid = grid_of(frame, state.grid)
    targets = _predict_state(state, motion_model(design, interval_s))
    frame = replace(
        frame, grid=grid, channel=design.detect.channel, interval_s=interval_s,
        slow_m=targets.position[is_slow(targets)],
    )  # fmt: skip
    detector = state.detector or detector_of(design.detect, frame)
    memory = detector.start(frame) if state.memory is None else state.memory
    given = detector.detect(memory, frame)
    if not isinstance(given, Detections):
        raise ValueError(
            f"`detect` of {type(detector).__name__} must return track.Detections (of boxes: "
            f"track.of_boxes, of nothing: track.no_detections()); got {type(given).__name__}."
        )
    return replace(
        prepare_detections(state, given, frame.time_s, grid),
        in_view=in_view(frame, grid, targets.position),  # without data a miss is no evidence
        frame=frame,
        detector=detector,
        memory=memory,
        given=given,
        order=order(given),
    )


def prepare_detections(state: TrackerState, found: Detections, time_s: float, grid: Grid) -> FrameDetections:
    """Prepare the detections of another program for association; `tracker.step_detections` takes the result.

    Parameters
    ----------
    state, found, time_s, grid
        See `tracker.step_detections`.

    Raises
    ------
    ValueError
        If a detection is not finite or time does not advance.
    """
    interval_s = _interval(state, time_s)
    motion = motion_model(state.design, interval_s)
    found = take(detections.check(found), order(found))
    if 0 < interval_s < found.correlation_s:
        found = replace(found, covariance=found.covariance * (found.correlation_s / interval_s))
    targets = _predict_state(state, motion)
    least_m2 = state.design.association.clutter_density_m2
    return FrameDetections(
        state=state, time_s=float(time_s), interval_s=interval_s, grid=grid, motion=motion,
        predicted=targets, in_view=np.ones(len(targets)), found=found,
        density=clutter.density_at(clutter.map_of(state, grid), grid, found.position, least_m2),
    )  # fmt: skip


def _interval(state: TrackerState, time_s: float) -> float:
    if not (math.isfinite(time_s) and time_s > state.time_s):
        raise ValueError(f"`time_s` must be later than the last frame's {state.time_s:g} s; got {time_s:g}.")
    return time_s - state.time_s if state.frame else 0.0


def _predict_state(state: TrackerState, motion: Motion) -> Targets:
    """Predict the targets, or the leaves of all their hypotheses."""
    return predict_targets(state.targets if state.leaves is None else state.leaves.targets, motion)


def predict_targets(targets: Targets, motion: Motion) -> Targets:
    """Predict targets over an interval."""
    damped = (targets.misses > 0) & (motion.stopped < 0)  # with a stopped mode no damping is needed
    stopped = damped & is_stopped(targets)
    damping_s = np.where(damped, np.where(stopped, STOPPED_DAMPING_S, COAST_DAMPING_S), np.inf)
    widest_m = np.where(stopped, MAX_STOPPED_SIGMA_M, MAX_COAST_SIGMA_M)
    return targets.with_modes(predict_modes(targets.modes, motion, damping_s, widest_m))
