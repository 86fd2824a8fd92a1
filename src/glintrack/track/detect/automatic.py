"""The detector ``auto``: ``mosaic`` where frames bring their raw mosaic, ``background`` where they do not."""

from dataclasses import dataclass
from typing import Any

from glintrack.track.detect.background import BackgroundDetector
from glintrack.track.detect.design import DetectDesign
from glintrack.track.detect.detections import Detections
from glintrack.track.detect.detector import Association, Detector
from glintrack.track.detect.frame import Frame
from glintrack.track.detect.mosaic import MosaicDetector


@dataclass(frozen=True)
class Chosen:
    """Which detector the first frame asked for, and its state."""

    detector: Detector
    memory: Any


@dataclass(frozen=True)
class AutomaticDetector:
    """The better detector of those that a flight's frames allow; its first frame decides.

    Parameters
    ----------
    design
        Of either.
    in_place
        As of `MosaicDetector`.
    """

    design: DetectDesign
    in_place: bool = False

    def start(self, frame: Frame) -> Chosen:
        """The state of the detector that is chosen."""
        raw = frame.mosaic is not None and frame.camera is not None and frame.pose is not None
        detector = MosaicDetector(self.design, self.in_place) if raw else BackgroundDetector(self.design)
        return Chosen(detector, detector.start(frame))

    def detect(self, state: Chosen, frame: Frame) -> Detections:
        """What it finds."""
        return state.detector.detect(state.memory, frame)

    def update(self, state: Chosen, frame: Frame, detections: Detections, association: Association) -> Chosen:
        """Its state after the frame."""
        return Chosen(state.detector, state.detector.update(state.memory, frame, detections, association))
