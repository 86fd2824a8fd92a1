"""The detections of an epoch before it is said whose they are, and where what is known of should be."""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.track import clutter, hypotheses
from glintrack.track.detect import detections
from glintrack.track.detect.detections import Detections, order, take
from glintrack.track.detect.detector import Detector, detector_of
from glintrack.track.detect.frame import Frame, Grid, grid_of, in_view
from glintrack.track.initiation import Targets
from glintrack.track.motion import (
    COAST_DAMPING_S,
    MAX_COAST_SIGMA_M,
    Motion,
    motion_over,
    predict_modes,
)
from glintrack.track.state import TrackerState


@dataclass(frozen=True)
class FrameDetections:
    """What was detected at an epoch, and where what is known of should be.

    Parameters
    ----------
    state
        From before the epoch: of use with that alone.
    time_s, interval_s
        Epoch, and time since the one before (0 for the first). [s]
    grid
        Area that was searched.
    motion, predicted
        Modes of motion over the interval, and all that targets may be, moved by them.
    in_view
        Share of each target's surroundings that had data. [1]
    found, density
        Detections from west to east, and the density of false ones about each. [m⁻²]
    frame, detector, memory, given, order
        The frame, the detector, its state before the frame, its detections in its own order, and the indices
        that sort them; None where detections came alone.
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
        """Refuse detections of another state or time.

        Raises
        ------
        ValueError
            If they are.
        """
        if self.state is not state:
            raise ValueError(
                f"frame detections must be of the state that they are used with, got those of frame "
                f"{self.state.frame} for a state of frame {state.frame}: detect again"
            )
        if time_s is not None and time_s != self.time_s:
            raise ValueError(f"`time_s` must be the detections' {self.time_s:g} s, got {time_s:g}")


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
    design = state.design
    interval_s = _interval(state, frame.time_s)
    grid = grid_of(frame, state.grid)
    motion = motion_since(state, interval_s)
    targets = predicted(believed(state), motion)
    on_map = targets.confirmed & (targets.unseen_s <= design.initiation.coast_s)
    if state.leaves is not None:  # what is but possible must not steer the search
        on_map &= state.leaves.chosen
    frame = replace(
        frame,
        grid=grid,
        channel=design.detect.channel,
        interval_s=interval_s,
        expected_m=targets.position[on_map],
    )
    detector = state.detector or detector_of(design.detect, frame)
    memory, given = found_in(detector, state.memory, frame)
    index = order(given)
    found = take(given, index)
    # where there is no data a target cannot be seen, and a miss says nothing
    share = in_view(frame, grid, targets.position)
    density = _density(state, grid, found)
    return FrameDetections(
        state=state,
        time_s=float(frame.time_s),
        interval_s=interval_s,
        grid=grid,
        motion=motion,
        predicted=targets,
        in_view=share,
        found=found,
        density=density,
        frame=frame,
        detector=detector,
        memory=memory,
        given=given,
        order=index,
    )


def found_in(detector: Detector, memory: object, frame: Frame) -> tuple[object, Detections]:
    """What a detector knew before a frame (from its `start`, if this is the first), and what it finds in it.

    Raises
    ------
    ValueError
        If that is no `Detections`, or not finite.
    """
    memory = detector.start(frame) if memory is None else memory
    given = detector.detect(memory, frame)
    if not isinstance(given, Detections):
        raise ValueError(
            f"`detect` of {type(detector).__name__} must return track.Detections (of boxes: "
            f"track.of_boxes, of nothing: track.no_detections()), got {type(given).__name__}"
        )
    return memory, detections.check(given)


def given_detections(state: TrackerState, found: Detections, time_s: float, grid: Grid) -> FrameDetections:
    """The same for somebody else's detections, of which `tracker.step_detections` makes one step.

    Parameters
    ----------
    state, found, time_s, grid
        As there.

    Raises
    ------
    ValueError
        If a detection is not finite or time does not advance.
    """
    interval_s = _interval(state, time_s)
    found = take(detections.check(found), order(found))
    motion = motion_since(state, interval_s)
    targets = predicted(believed(state), motion)
    return FrameDetections(
        state=state,
        time_s=float(time_s),
        interval_s=interval_s,
        grid=grid,
        motion=motion,
        predicted=targets,
        in_view=np.ones(len(targets)),
        found=found,
        density=_density(state, grid, found),
    )


def _interval(state: TrackerState, time_s: float) -> float:
    if not (math.isfinite(time_s) and time_s > state.time_s):
        raise ValueError(f"`time_s` must be later than the last frame's {state.time_s:g} s, got {time_s:g}")
    return time_s - state.time_s if state.frame else 0.0


def _density(state: TrackerState, grid: Grid, found: Detections) -> Float[Array, "detection"]:
    known = clutter.map_of(state, grid)
    return clutter.density_at(known, grid, found.position, state.design.association.clutter_density_m2)


def motion_since(state: TrackerState, interval_s: float) -> Motion:
    """Modes of motion over an interval; those of the last one serve again if it was as long."""
    if state.motion is not None and interval_s == state.interval_s:
        return state.motion
    return motion_over(state.design, interval_s)


def believed(state: TrackerState) -> Targets:
    """Everything that targets may be: themselves, or with many hypotheses all of them."""
    return state.targets if state.leaves is None else hypotheses.all_of(state.leaves, state.targets)


def predicted(targets: Targets, motion: Motion) -> Targets:
    """Targets after an interval."""
    damped = (targets.misses > 0) & (motion.stopped < 0)  # where standing is a mode, nothing need be damped
    damping_s = np.where(damped, COAST_DAMPING_S, np.inf)
    return targets.moved(predict_modes(targets.modes, motion, damping_s, MAX_COAST_SIGMA_M))
