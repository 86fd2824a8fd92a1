"""The detector ``background``: change against a clipped exponential mean with a local noise scale."""

from collections.abc import Mapping
from dataclasses import dataclass

from glintrack.track.detect import change
from glintrack.track.detect.background_model import Background
from glintrack.track.detect.design import DetectDesign
from glintrack.track.detect.detections import Detections
from glintrack.track.detect.detector import Association
from glintrack.track.detect.frame import Frame


@dataclass(frozen=True)
class BackgroundDetector:
    """A pixel has changed where it leaves the range that the background spans around it.

    Parameters
    ----------
    design
        Threshold, tolerance, time constants, size limits.
    """

    design: DetectDesign

    def start(self, frame: Frame) -> Mapping[str, Background]:
        """Backgrounds that have seen nothing, by plane of the image."""
        return change.empty_backgrounds(frame)

    def detect(self, state: Mapping[str, Background], frame: Frame) -> Detections:
        """Blobs in which the frame differs from the background."""
        placed = change.register(self.design, state, frame)
        strength = {
            name: change.excess(self.design, state[name].mean, state[name], layer, placed.grid.gsd_m)
            for name, layer in placed.layers.items()
        }
        return change.blobs_of(self.design, state, placed, strength, frame.expected_m)

    def update(
        self, state: Mapping[str, Background], frame: Frame, detections: Detections, association: Association
    ) -> Mapping[str, Background]:
        """The backgrounds after the frame."""
        return change.update(self.design, state, detections, association.explained, frame.interval_s)
