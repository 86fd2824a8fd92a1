"""Protocol of a detector: three functions over a state that only it understands."""

from dataclasses import dataclass
from typing import Any, Protocol

from jaxtyping import Bool, Float

from glintrack.core.arrays import Array
from glintrack.track.detect.detections import Detections
from glintrack.track.detect.frame import Frame


@dataclass(frozen=True)
class Association:
    """What the tracker says of a frame's detections: what is tracked should not be learnt as background.

    Parameters
    ----------
    explained
        Which detections a confirmed track explains, in the order in which the detector gave them.
    measured_m
        Where confirmed tracks were measured in this frame. [m]
    """

    explained: Bool[Array, "detection"]
    measured_m: Float[Array, "track 2"]


class Detector(Protocol):
    """Finds vehicles in frames; see docs/howto/my_detector.md.

    A state is not changed in place, so that a tracker may be stepped twice from the same one; a detector may
    be asked to otherwise (`detectors.detector_of`).
    """

    def start(self, frame: Frame) -> Any:
        """The state before the first frame, which is given for its size and kind."""
        ...

    def detect(self, state: Any, frame: Frame) -> Detections:
        """Detections in a frame, by what was learnt from those before it."""
        ...

    def update(self, state: Any, frame: Frame, detections: Detections, association: Association) -> Any:
        """The state after a frame, once it is known whose its detections are.

        ``detections`` are those that `detect` gave, untouched.
        """
        ...
