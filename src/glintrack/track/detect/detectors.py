"""Every detector, by the name under which a case chooses it."""

from collections.abc import Callable, Mapping

from glintrack.track.detect.automatic import AutomaticDetector
from glintrack.track.detect.background import BackgroundDetector
from glintrack.track.detect.design import DetectDesign
from glintrack.track.detect.detector import Detector
from glintrack.track.detect.median_motion import MedianMotionDetector
from glintrack.track.detect.mog2 import MixtureDetector
from glintrack.track.detect.mosaic import MosaicDetector
from glintrack.track.detect.three_frame import ThreeFrameDetector

DETECTORS: Mapping[str, Callable[[DetectDesign], Detector]] = {
    "auto": AutomaticDetector,
    "background": BackgroundDetector,
    "three-frame": ThreeFrameDetector,
    "mog2": MixtureDetector,
    "mosaic": MosaicDetector,
    "median-motion": MedianMotionDetector,
}
