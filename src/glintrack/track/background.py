"""The background of a scene with moving vehicles, and how it is learnt.

The mean follows exponentially, at a rate that depends on what the tracker said of each changed pixel; the
noise scale follows a quantile of the deviations, which a passing vehicle moves by no more than a step.
"""

import math
from dataclasses import dataclass

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.track.design import TrackDesign
from glintrack.track.mixture import Mixture

Array = np.ndarray
UNTRACKED, TRACKED, HOLE, DISPLACED = 1, 2, 3, 4
EARLY_FRAMES = 12  # in which the noise scale settles
SETTLED_FRAMES = 4  # the background is a plain mean of the first few frames
QUANTILE, QUANTILE_SCALES = 0.15, 1.44  # a Gaussian exceeds 1.96 σ in 5 % of the frames


@dataclass(frozen=True)
class Background:
    """What a scene without moving vehicles looks like.

    Parameters
    ----------
    mean
        Expected value of each pixel; NaN where none was ever seen. [unit of the image]
    scale
        Noise scale of each pixel. [unit of the image]
    frames
        How many frames each pixel was learnt from, up to 255.
    offset
        Slow mean of the frames' displacement against the background, rows and columns. [pixel]
    recent
        The last two frames, for the detector ``three-frame``. [unit of the image]
    mixture
        For the detector ``mog2``.
    """

    mean: Float[Array, "y x"]
    scale: Float[Array, "y x"]
    frames: Int[Array, "y x"]
    offset: tuple[float, float]
    recent: tuple[Float[Array, "y x"], ...] = ()
    mixture: Mixture | None = None


def empty_background(shape: tuple[int, int]) -> Background:
    """A background that has seen nothing."""
    return Background(
        np.full(shape, np.nan, np.float32),
        np.zeros(shape, np.float32),
        np.zeros(shape, np.uint8),
        (0.0, 0.0),
    )


def learnt(
    design: TrackDesign,
    background: Background,
    image: Float[Array, "y x"],
    changed: tuple[Int[Array, "pixel"], Int[Array, "pixel"], Int[Array, "pixel"]],
    floor: np.float32,
    offset: tuple[float, float],
    interval_s: float,
) -> Background:
    """The background after one more frame.

    Parameters
    ----------
    design
        Time constants.
    background
        Before the frame.
    image
        The frame, registered to the background, NaN where there is no data. [unit of the image]
    changed
        Row, column and kind (`UNTRACKED`, `TRACKED`, `HOLE`, `DISPLACED`) of each changed pixel.
    floor
        Least noise scale. [unit of the image]
    offset
        New slow mean of the displacement. [pixel]
    interval_s
        Time since the frame before. [s]
    """
    times = (design.background_s, design.untracked_s, design.tracked_s, design.displaced_s)
    rate, *rates = (np.float32(1 - math.exp(-interval_s / t)) for t in times)
    # the scale follows fast at first, since nothing is known of it
    gain = np.maximum(2 * (1 - math.exp(-interval_s / design.scale_s)), 1 / np.arange(1, EARLY_FRAMES + 1))
    up = np.exp(gain * (1 - QUANTILE)).astype(np.float32)
    down = np.exp(-gain * QUANTILE).astype(np.float32)
    mean, scale, frames = _learn(
        background.mean, background.scale, background.frames, image, rate, up, down, floor
    )
    rows, columns, kind = changed
    _relearn(
        mean, scale, background.mean, background.scale, image, rows, columns, kind,
        *rates,
    )  # fmt: skip
    return Background(mean, scale, frames, offset)


def noise_floor(
    design: TrackDesign, background: Background, image: Float[Array, "y x"], product: str
) -> np.float32:
    """Least noise scale of a product of this frame: half its typical change, and the design's floor."""
    sample = slice(None, None, 4)
    values = image[sample, sample]
    with np.errstate(invalid="ignore"):
        change = np.abs(values - background.mean[sample, sample])
    change, values = change[np.isfinite(change)], values[np.isfinite(values)]
    floor = design.noise_floor
    if product == "pan":
        floor *= abs(float(np.median(values))) if values.size else 0.0
    typical = 0.5 * 1.4826 * float(np.median(change)) if change.size else 0.0  # 1.4826: σ per median of |N|
    return np.float32(max(floor, typical, float(np.finfo(np.float32).tiny)))


@nb.njit(cache=True)
def _learn(mean, scale, frames, image, rate, up, down, floor):
    """All pixels learnt as unchanged."""
    height, width = image.shape
    mean_out, scale_out = np.empty_like(mean), np.empty_like(scale)
    frames_out = np.empty_like(frames)
    limit, nothing = np.float32(QUANTILE_SCALES), np.float32(0.0)
    least = np.float32(0.5) * floor
    for y in range(height):
        for x in range(width):
            v, m, s, n = image[y, x], mean[y, x], scale[y, x], frames[y, x]
            difference = v - m
            if difference - difference == nothing:  # both known
                share = rate
                if n < SETTLED_FRAMES:
                    share = max(rate, np.float32(1.0) / np.float32(n + 1))
                early = n - 1 if n < EARLY_FRAMES else EARLY_FRAMES - 1
                s *= up[early] if abs(difference) > limit * s else down[early]
                mean_out[y, x] = m + share * difference
                scale_out[y, x] = s if s > least else least
                frames_out[y, x] = n + 1 if n < 255 else n
            elif v - v == nothing:  # first sight
                mean_out[y, x], scale_out[y, x], frames_out[y, x] = v, floor, 1
            else:
                mean_out[y, x], scale_out[y, x], frames_out[y, x] = m, s, n
    return mean_out, scale_out, frames_out


@nb.njit(cache=True)
def _relearn(mean_out, scale_out, mean, scale, image, rows, columns, kind, untracked, tracked, displaced):
    """Correct in place, in arrays just made, what `_learn` did to changed pixels.

    What is tracked gets a margin of one pixel, for the part of a vehicle below the threshold.
    """
    height, width = image.shape
    for k in range(len(rows)):
        if kind[k] == TRACKED:
            for y in range(max(0, rows[k] - 1), min(height, rows[k] + 2)):
                for x in range(max(0, columns[k] - 1), min(width, columns[k] + 2)):
                    difference = image[y, x] - mean[y, x]
                    if np.isfinite(difference):
                        mean_out[y, x] = mean[y, x] + tracked * difference
                        scale_out[y, x] = scale[y, x]
    for k in range(len(rows)):
        y, x = rows[k], columns[k]
        difference = image[y, x] - mean[y, x]
        if not np.isfinite(difference):
            continue
        if kind[k] == UNTRACKED:
            mean_out[y, x] = mean[y, x] + untracked * difference
        elif kind[k] == DISPLACED:
            mean_out[y, x] = mean[y, x] + displaced * difference
        elif kind[k] == HOLE:
            mean_out[y, x] = image[y, x]
            scale_out[y, x] = scale[y, x]
