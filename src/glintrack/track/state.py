"""State of the tracker between two frames, as one frozen record."""

from dataclasses import dataclass, field
from functools import partial
from typing import Any

from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.track import hypotheses, identity
from glintrack.track.design import TrackDesign
from glintrack.track.detect.detections import Detections
from glintrack.track.detect.detector import Detector
from glintrack.track.detect.frame import Grid
from glintrack.track.existence import Duplicates, no_duplicates
from glintrack.track.initiation import Targets
from glintrack.track.motion import Motion
from glintrack.track.roads import Roads


@dataclass(frozen=True)
class TrackerState:
    """What the tracker knows between two frames.

    Parameters
    ----------
    design, detector, seed
        As given to `start`; without a detector the first frame decides.
    frame
        Number of frames seen.
    time_s, interval_s
        Epoch of the last frame, and time between the last two (0 before the second). [s]
    grid, memory, clutter
        Of the frames, the detector's own state, and the density of false detections [m⁻²]; None before the
        first.
    targets, next_id
        All targets, confirmed or not, and the id the next one will get.
    population
        Of spectral identity.
    detections
        Of the last frame, for pictures.
    polarized
        Population of polarization identity.
    roads
        The road map, if there is one to use.
    motion
        Over the last interval; the next is mostly as long.
    ground
        Spectral features of the road.
    leaves
        What every target may be, with association by many hypotheses; `targets` are the best of them.
    duplicates
        Pairs of targets on one vehicle, with existence reporting.
    """

    design: TrackDesign
    detector: Detector | None
    seed: int
    frame: int
    time_s: float
    interval_s: float
    grid: Grid | None
    memory: Any
    clutter: Float[Array, "row column"] | None
    targets: Targets
    next_id: int
    population: identity.Population
    detections: Detections
    roads: Roads | None = None
    motion: Motion | None = None
    ground: identity.Population = field(default_factory=partial(identity.empty_population, 8))
    leaves: hypotheses.Leaves | None = None
    duplicates: Duplicates = field(default_factory=no_duplicates)

    @property
    def effective_design(self) -> TrackDesign:
        """The design in use for the detections of the last frame."""
        return self.design.effective(self.detections.log_likelihood_ratio is not None)
