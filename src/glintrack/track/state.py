"""State of the tracker between two frames, as one frozen record."""

import math
from dataclasses import dataclass, field
from typing import Any

from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.track import hypotheses, identity
from glintrack.track.design import TrackDesign
from glintrack.track.detect.detections import Detections, no_detections
from glintrack.track.detect.detector import Detector
from glintrack.track.detect.frame import Grid
from glintrack.track.existence import Duplicates, no_duplicates
from glintrack.track.initiation import Targets
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

    @property
    def effective_design(self) -> TrackDesign:
        """Design in use for the detections of the last frame."""
        return self.design.effective(self.detections.log_likelihood_ratio is not None)
