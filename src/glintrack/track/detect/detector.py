"""Protocol of a detector, and all detectors by their names in a case."""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from glintrack.track.design import DetectDesign
from glintrack.track.detect.detections import Association, Detections
from glintrack.track.detect.frame import Frame
from glintrack.track.detect.median_motion import MedianMotionDetector
from glintrack.track.detect.mosaic import MosaicDetector


class Detector(Protocol):
    """Find vehicles in frames; see docs/howto/my_detector.md.

    A state is not changed in place, so that a tracker may be stepped twice from the same one.
    """

    def start(self, frame: Frame) -> Any:
        """Return the state before the first frame, which is given for its size and kind."""
        ...

    def detect(self, state: Any, frame: Frame) -> Detections:
        """Detect vehicles in a frame, with the state after the frames before it."""
        ...

    def update(self, state: Any, frame: Frame, detections: Detections, association: Association) -> Any:
        """Return the state after a frame, once its detections are associated.

        ``detections`` are those that `detect` returned, unchanged.
        """
        ...


DETECTORS: Mapping[str, Callable[[DetectDesign], Detector]] = {
    "mosaic": MosaicDetector,
    "median-motion": MedianMotionDetector,
}


def detector_of(design: DetectDesign, frame: Frame) -> Detector:
    """Build the detector of a design; with `auto`, `mosaic` if the first frame has a raw mosaic."""
    name = design.detector
    if name == "auto":
        has_raw = frame.mosaic is not None and frame.camera is not None and frame.pose is not None
        name = "mosaic" if has_raw else "median-motion"
    return DETECTORS[name](design)
