"""The detector ``mog2``: OpenCV's mixture of Gaussians, Zivkovic, ICPR 2004.

It is here for comparison. ``cv2.createBackgroundSubtractorMOG2`` learns every pixel alike, so that it cannot
be told which change is a vehicle: what stands is background after about `background_s`. Noise scale and the
tests on holes and parallax are those of ``background``.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from glintrack.core.arrays import Array
from glintrack.core.extras import require_extra
from glintrack.track.detect import change
from glintrack.track.detect.background_model import Background
from glintrack.track.detect.design import DetectDesign
from glintrack.track.detect.detections import Detections
from glintrack.track.detect.detector import Association
from glintrack.track.detect.frame import Frame

MIDDLE_GREY = 64.0  # its noise limits are in grey levels of 0 to 255
GROWTH_FRAMES = 10  # it learns as a plain mean at first


@dataclass(frozen=True)
class Mixture:
    """A mixture after some frames.

    Parameters
    ----------
    model
        OpenCV's object, shared by all frames: it cannot be copied, and so only the latest can go on.
    frames
        How many it has seen at this point.
    seen
        One number: how many it has seen at all.
    scale
        Grey levels per unit of the image.
    last
        Last value seen of each pixel, which stands in where there is no data. [grey level]
    """

    model: Any
    frames: int
    seen: list[int]
    scale: float
    last: Float[Array, "y x"]


@dataclass(frozen=True)
class Mixtures:
    """Backgrounds for the tests on holes and parallax, and the mixtures, by plane of the image."""

    backgrounds: Mapping[str, Background]
    mixtures: Mapping[str, Mixture | None]


@dataclass(frozen=True)
class MixtureDetector:
    """A pixel has changed where it belongs to none of its mixture's Gaussians.

    Parameters
    ----------
    design
        Threshold, time constants, size limits.
    """

    design: DetectDesign

    def start(self, frame: Frame) -> Mixtures:
        """No mixtures yet: they are scaled by the first frame."""
        return Mixtures(change.empty_backgrounds(frame), dict.fromkeys(frame.planes))

    def detect(self, state: Mixtures, frame: Frame) -> Detections:
        """Blobs of foreground; none in the first frame."""
        design = self.design
        placed = change.register(design, state.backgrounds, frame)
        strength, after = {}, {}
        for name, layer in placed.layers.items():
            mixture = state.mixtures[name] or start_mixture(layer.image)
            after[name], foreground = step_mixture(
                mixture, layer.image, design.threshold, frame.interval_s, design.background_s
            )
            change2 = np.where(foreground, np.float32(2 * design.threshold**2), np.float32(0.0))
            strength[name] = np.where(np.isfinite(layer.image), change2, np.float32(-1.0))
        found = change.blobs_of(design, state.backgrounds, placed, strength, frame.expected_m)
        return replace(found, detail=(found.detail, after))

    def update(
        self, state: Mixtures, frame: Frame, detections: Detections, association: Association
    ) -> Mixtures:
        """The mixtures, which have learnt the frame already, and the noise scale after it."""
        detail, after = detections.detail
        found = replace(detections, detail=detail)
        backgrounds = change.update(
            self.design, state.backgrounds, found, association.explained, frame.interval_s
        )
        return Mixtures(backgrounds, after)


def start_mixture(image: Float[Array, "y x"]) -> Mixture:
    """A mixture that has seen nothing, scaled to the brightness of its first image.

    Raises
    ------
    ValueError
        If OpenCV is not installed.
    """
    cv2 = require_extra("cv2", "opencv", "detect with mog2")
    known = np.abs(image[np.isfinite(image)])
    middle = float(np.median(known)) if known.size else 0.0
    model = cv2.createBackgroundSubtractorMOG2(detectShadows=False)
    return Mixture(
        model, 0, [0], MIDDLE_GREY / middle if middle > 0 else 1.0, np.zeros(image.shape, np.float32)
    )


def step_mixture(
    mixture: Mixture, image: Float[Array, "y x"], threshold: float, interval_s: float, background_s: float
) -> tuple[Mixture, Bool[Array, "y x"]]:
    """The mixture after one more frame, and where that frame is foreground.

    Parameters
    ----------
    mixture
        The latest one.
    image
        NaN where there is no data. [unit of the image]
    threshold
        Standard deviations from every Gaussian of the background. [1]
    interval_s, background_s
        Time since the frame before, and time in which the background follows. [s]

    Raises
    ------
    ValueError
        If the mixture is not the latest.
    """
    if mixture.frames != mixture.seen[0]:
        raise ValueError(
            f"`state` must be the latest with track.detect.detector = mog2, which cannot go back, "
            f"got frame {mixture.frames} of {mixture.seen[0]}"
        )
    known = np.isfinite(image)
    grey = np.where(known, np.clip(image * np.float32(mixture.scale), 0, 255), mixture.last)
    grey = grey.astype(np.float32)
    rate = 1 - math.exp(-interval_s / background_s) if interval_s > 0 else 1.0
    mixture.model.setVarThreshold(threshold**2)
    settling = 1.0 / (mixture.frames + 1) if mixture.frames < GROWTH_FRAMES else 0.0
    foreground = mixture.model.apply(grey, learningRate=max(rate, settling)) > 0
    mixture.seen[0] += 1
    first = mixture.frames == 0
    after = Mixture(mixture.model, mixture.frames + 1, mixture.seen, mixture.scale, grey)
    return after, foreground & known & (not first)
