"""OpenCV's mixture of Gaussians as a detector: Zivkovic, ICPR 2004 (``cv2.createBackgroundSubtractorMOG2``).

It is here for comparison. It learns every pixel alike, so that it cannot be told which change is a vehicle:
what stands is background after about `background_s`.
"""

import math
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from glintrack.arrays import Array

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


def start(image: Float[Array, "y x"]) -> Mixture:
    """A mixture that has seen nothing, scaled to the brightness of its first image.

    Raises
    ------
    ValueError
        If OpenCV is not installed.
    """
    try:
        cv2 = import_module("cv2")
    except ImportError as error:
        raise ValueError(
            "`track.detector` must be background or three-frame without OpenCV, got mog2 "
            "(pip install 'glintrack[opencv]')"
        ) from error
    known = np.abs(image[np.isfinite(image)])
    middle = float(np.median(known)) if known.size else 0.0
    model = cv2.createBackgroundSubtractorMOG2(detectShadows=False)
    return Mixture(
        model, 0, [0], MIDDLE_GREY / middle if middle > 0 else 1.0, np.zeros(image.shape, np.float32)
    )


def step(
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
            f"`state` must be the latest with track.detector = mog2, which cannot go back, "
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
