"""The detector ``three-frame``: change against both of the two frames before.

It leaves no ghosts, but a vehicle that moves less than its length between frames shows only its ends, and one
that stops vanishes at once. It shares noise scale and the tests on holes and parallax with ``background``.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.track.detect import change
from glintrack.track.detect.background_model import Background
from glintrack.track.detect.design import DetectDesign
from glintrack.track.detect.detections import Detections
from glintrack.track.detect.detector import Association
from glintrack.track.detect.frame import Frame


@dataclass(frozen=True)
class Recent:
    """Backgrounds for the noise scale, and the last two frames, by plane of the image."""

    backgrounds: Mapping[str, Background]
    frames: Mapping[str, tuple[Float[Array, "y x"], ...]]


@dataclass(frozen=True)
class ThreeFrameDetector:
    """A pixel has changed where it differs from both frames before, within the registration tolerance.

    Parameters
    ----------
    design
        Threshold, tolerance, time constants, size limits.
    """

    design: DetectDesign

    def start(self, frame: Frame) -> Recent:
        """No frames yet."""
        return Recent(change.empty_backgrounds(frame), {name: () for name in frame.planes})

    def detect(self, state: Recent, frame: Frame) -> Detections:
        """Blobs in which the frame differs from both before; none in the first two."""
        placed = change.register(self.design, state.backgrounds, frame)
        strength = {}
        for name, layer in placed.layers.items():
            between, known = _range_of(state.frames[name], layer.image), state.backgrounds[name]
            strength[name] = change.excess(self.design, between, known, layer, placed.grid.gsd_m)
        return change.blobs_of(self.design, state.backgrounds, placed, strength, frame.expected_m)

    def update(self, state: Recent, frame: Frame, detections: Detections, association: Association) -> Recent:
        """The last two frames and the noise scale after this one."""
        after = change.update(
            self.design, state.backgrounds, detections, association.explained, frame.interval_s
        )
        layers = detections.detail.layers
        return Recent(after, {name: (*state.frames[name][-1:], layers[name].image) for name in layers})


def _range_of(recent: tuple[Array, ...], image: Array) -> tuple[Array, Array]:
    """Least and greatest of the two frames before: what differs from both moves, and is here now."""
    if len(recent) < 2:
        nothing = np.full(image.shape, np.nan, np.float32)
        return nothing, nothing
    return np.minimum(*recent), np.maximum(*recent)
