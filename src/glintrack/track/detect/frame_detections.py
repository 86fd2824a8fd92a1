"""A frame, or an epoch of detections, as it is before it is said whose they are."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.arrays import Array
from glintrack.track import clutter
from glintrack.track import motion as kinematics
from glintrack.track.association import hypotheses
from glintrack.track.design import TrackDesign
from glintrack.track.detect import channel
from glintrack.track.detect.background import Background, empty_background
from glintrack.track.detect.blobs import Detections, order, take
from glintrack.track.detect.change import Change
from glintrack.track.detect.frame import Grid, unpack, visible_fraction
from glintrack.track.identity import polarization
from glintrack.track.initiation import Targets
from glintrack.track.state import TrackerState


@dataclass(frozen=True)
class Searched:
    """A frame that was searched for change.

    Parameters
    ----------
    image
        Of the schema ``image``.
    backgrounds, changes
        What was known of each product before, and what differs from it.
    choice
        The product whose detections count.
    """

    image: xr.Dataset
    backgrounds: Mapping[str, Background]
    changes: Mapping[str, Change]
    choice: channel.Choice


@dataclass(frozen=True)
class Look:
    """What was detected at an epoch, and where what is known of should be.

    Parameters
    ----------
    state
        From before the epoch: a look is of use with that alone.
    time_s, interval_s
        Epoch, and time since the one before (0 for the first). [s]
    grid
        Area that was looked at.
    motion, predicted
        Modes of motion over the interval, and all that targets may be, moved by them.
    seen
        Share of each target's surroundings that had data. [1]
    found, density
        Detections, and the density of false ones about each. [m⁻²]
    frame
        None where detections came alone.
    """

    state: TrackerState
    time_s: float
    interval_s: float
    grid: Grid
    motion: kinematics.Motion
    predicted: Targets
    seen: Float[Array, "target"]
    found: Detections
    density: Float[Array, "detection"]
    frame: Searched | None = None

    def check(self, state: TrackerState, time_s: float | None = None) -> None:
        """Refuse a look of another state or time.

        Raises
        ------
        ValueError
            If it is.
        """
        if self.state is not state:
            raise ValueError(
                f"a look must be of the state that it is used with, got one of frame {self.state.frame} "
                f"for a state of frame {state.frame}: look again"
            )
        if time_s is not None and time_s != self.time_s:
            raise ValueError(f"`time_s` must be the look's {self.time_s:g} s, got {time_s:g}")

    def polarization(self) -> Float[Array, "detection 2"]:
        """Polarization features of the detections; NaN without a frame, or where the design has none. [1]"""
        if self.frame is None or not self.state.design.feature_polarization:
            return np.full((len(self.found), 2), np.nan)
        return polarization.of_detections(self.frame.image, self.grid, self.found.position)

    @property
    def displacement_m(self) -> Float[Array, "2"]:
        """East and north by which places in this frame lie beyond those of the tracker. [m]"""
        if self.frame is None:
            return np.zeros(2)
        rows, columns = self.frame.changes[self.frame.choice.name].moved
        return self.grid.gsd_m * np.array([columns, -rows])


def look(state: TrackerState, image: xr.Dataset, time_s: float) -> Look:
    """Detect change in a frame; `tracker.step` does this itself, or takes what this returns.

    Parameters
    ----------
    state
        `TrackerState` before the frame; not changed.
    image, time_s
        As in `tracker.step`.

    Raises
    ------
    ValueError
        If the image breaks its schema, its grid has changed, or time does not advance.
    """
    design = state.design
    interval_s = _interval(state, time_s)
    grid, frames = unpack(image, design, state.grid)
    known = state.backgrounds or {name: empty_background(grid.shape) for name in frames}
    motion = motion_over(state, interval_s)
    targets = predicted(believed(state), design, motion)
    on_map = targets.confirmed & (targets.unseen_s <= design.coast_s)
    if state.leaves is not None:  # what is but possible must not steer the search
        on_map &= state.leaves.chosen
    changes = channel.look(design, known, frames, grid, targets.position[on_map], interval_s)
    choice = channel.choose(design, state.choice, changes, interval_s)
    # where there is no data a target cannot be seen, and a miss says nothing
    seen = visible_fraction(frames.get(choice.name, frames[design.products[0]]), grid, targets.position)
    found = changes[choice.name].detections
    density = _density(state, grid, found)
    frame = Searched(image, known, changes, choice)
    return Look(state, float(time_s), interval_s, grid, motion, targets, seen, found, density, frame)


def look_at_detections(state: TrackerState, found: Detections, time_s: float, grid: Grid) -> Look:
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
    if not (np.isfinite(found.position).all() and np.isfinite(found.covariance).all()):
        raise ValueError("`found` must have finite positions and covariances, got some that are not")
    found = take(found, order(found))
    motion = motion_over(state, interval_s)
    targets = predicted(believed(state), state.design, motion)
    density = _density(state, grid, found)
    ones = np.ones(len(targets))
    return Look(state, float(time_s), interval_s, grid, motion, targets, ones, found, density)


def _interval(state: TrackerState, time_s: float) -> float:
    if not (math.isfinite(time_s) and time_s > state.time_s):
        raise ValueError(f"`time_s` must be later than the last frame's {state.time_s:g} s, got {time_s:g}")
    return time_s - state.time_s if state.frame else 0.0


def _density(state: TrackerState, grid: Grid, found: Detections) -> Float[Array, "detection"]:
    known = clutter.map_of(state, grid)
    return clutter.density_at(known, grid, found.position, state.design.clutter_density_m2)


def motion_over(state: TrackerState, interval_s: float) -> kinematics.Motion:
    """Modes of motion over an interval; those of the last one serve again if it was as long."""
    if state.motion is not None and interval_s == state.interval_s:
        return state.motion
    return kinematics.motion_over(state.design, interval_s)


def believed(state: TrackerState) -> Targets:
    """Everything that targets may be: themselves, or with many hypotheses all of them."""
    return state.targets if state.leaves is None else hypotheses.all_of(state.leaves, state.targets)


def predicted(targets: Targets, design: TrackDesign, motion: kinematics.Motion) -> Targets:
    """Targets after an interval."""
    damped = (targets.misses > 0) & (motion.stopped < 0)  # where standing is a mode, nothing need be damped
    damping_s = np.where(damped, design.coast_damping_s, np.inf)
    return targets.moved(kinematics.predict(targets.modes, motion, damping_s, design.coast_sigma_m))
