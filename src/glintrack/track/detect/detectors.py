"""Every detector, by the name under which a case chooses it."""

from collections.abc import Callable, Mapping
from dataclasses import replace

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


def detector_of(design: DetectDesign, in_place: bool = False) -> Detector:
    """The detector that a design names.

    Parameters
    ----------
    design
        With its name.
    in_place
        No state is stepped from twice, as in a flight: whoever can learn in the memory of the last one does.
    """
    made = DETECTORS[design.detector](design)
    learns = isinstance(made, AutomaticDetector | MosaicDetector)
    return replace(made, in_place=True) if in_place and learns else made
