"""The background of a scene with moving vehicles, and how it is learnt.

The mean follows exponentially, at a rate that depends on what the tracker said of each changed pixel; the
noise scale follows a quantile of the deviations, which a passing vehicle moves by no more than a step.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.track.detect.design import DetectDesign
from glintrack.track.detect.samples import median

UNTRACKED, TRACKED, HOLE, DISPLACED = 1, 2, 3, 4
EARLY_FRAMES = 12  # in which the noise scale settles
_LEAST_PIXELS = 750_000  # fewer are not worth a thread: a kernel takes 0.5 ms for them, a thread 0.2 ms
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
    """

    mean: Float[Array, "y x"]
    scale: Float[Array, "y x"]
    frames: Int[Array, "y x"]
    offset: tuple[float, float]


def rows_worth(image: Float[Array, "y x"]) -> int:
    """Rows of a frame that are worth a thread."""
    return max(1, _LEAST_PIXELS // image.shape[1])


def empty_background(shape: tuple[int, int]) -> Background:
    """A background that has seen nothing."""
    return Background(
        np.full(shape, np.nan, np.float32),
        np.zeros(shape, np.float32),
        np.zeros(shape, np.uint8),
        (0.0, 0.0),
    )


class Moments(NamedTuple):
    """What is known of every pixel: mean, noise scale, and in how many frames it was seen."""

    mean: Array
    scale: Array
    frames: Array


class Rates(NamedTuple):
    """How fast the mean follows, what the scale is multiplied by above and below its quantile, its floor."""

    mean: np.float32
    up: Array
    down: Array
    floor: np.float32


def updated(
    design: DetectDesign,
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
    before = Moments(background.mean, background.scale, background.frames)
    after = Moments(*(np.empty_like(values) for values in before))
    over_rows(
        _update_rows, len(image), image, before, Rates(rate, up, down, floor), after, least=rows_worth(image)
    )
    mean, scale, frames = after
    rows, columns, kind = changed
    _correct(
        mean, scale, background.mean, background.scale, image, rows, columns, kind,
        *rates,
    )  # fmt: skip
    return Background(mean, scale, frames, offset)


def noise_floor(
    design: DetectDesign, mean: Float[Array, "y x"], image: Float[Array, "y x"], plane: str
) -> np.float32:
    """Least noise scale of a plane of this frame: half its typical change, and the design's floor.

    Parameters
    ----------
    design
        Of the tracker.
    mean
        Of the background. [unit of the image]
    image
        The frame. [unit of the image]
    plane
        ``pan`` or ``dolp``.
    """
    values, change = _sampled(image, mean)
    floor = design.noise_floor
    if plane == "pan":
        floor *= abs(median(values))
    typical = 0.5 * 1.4826 * median(change)  # 1.4826: σ per median of |N|
    return np.float32(max(floor, typical, float(np.finfo(np.float32).tiny)))


@nb.njit(cache=True)
def _sampled(image, mean):
    """Values that are known of every fourth pixel and row, and their distances from the mean."""
    size = ((image.shape[0] + 3) // 4) * ((image.shape[1] + 3) // 4)
    values, change = np.empty(size, image.dtype), np.empty(size, image.dtype)
    n = m = 0
    for y in range(0, image.shape[0], 4):
        for x in range(0, image.shape[1], 4):
            values[n] = image[y, x]
            n += np.isfinite(values[n])
            change[m] = abs(image[y, x] - mean[y, x])
            m += np.isfinite(change[m])
    return values[:n], change[:m]


@nb.njit(nogil=True, cache=True)
def _update_rows(start, stop, image, before, rates, after):
    """All pixels learnt as unchanged."""
    mean, scale, frames = before.mean, before.scale, before.frames
    mean_out, scale_out, frames_out = after.mean, after.scale, after.frames
    rate, up, down, floor = rates.mean, rates.up, rates.down, rates.floor
    least, settled = np.float32(0.5) * floor, len(up) - 1
    for y in range(start, stop):
        if _settled(image[y], mean[y], frames[y]):
            _update_mean(image[y], mean[y], rate, mean_out[y])
            _update_scale(image[y], mean[y], scale[y], up[settled], down[settled], floor, least, scale_out[y])
            _count(image[y], mean[y], frames[y], frames_out[y])
            continue
        for x in range(image.shape[1]):
            v, m, s, n = image[y, x], mean[y, x], scale[y, x], frames[y, x]
            difference = v - m
            if np.isfinite(difference):
                share = rate
                if n < SETTLED_FRAMES:
                    share = max(rate, np.float32(1.0) / np.float32(n + 1))
                early = n - 1 if n < EARLY_FRAMES else EARLY_FRAMES - 1
                s *= up[early] if abs(difference) > np.float32(QUANTILE_SCALES) * s else down[early]
                mean_out[y, x] = m + share * difference
                scale_out[y, x] = s if s > least else least
                frames_out[y, x] = n + 1 if n < 255 else n
            elif np.isfinite(v):  # first sight
                mean_out[y, x], scale_out[y, x], frames_out[y, x] = v, floor, 1
            else:
                mean_out[y, x], scale_out[y, x], frames_out[y, x] = m, s, n


@nb.njit(cache=True)
def _settled(image, mean, frames):
    """Whether all pixels of a row that are learnt now are past the early frames, and thus learnt alike."""
    early = 0
    for x in range(len(frames)):  # selections, no branches: these loops run on vectors
        difference = image[x] - mean[x]
        early += (frames[x] < EARLY_FRAMES) & (difference - difference == 0)
    return early == 0


@nb.njit(cache=True)
def _update_mean(image, mean, rate, out):
    for x in range(len(out)):
        v, m = image[x], mean[x]
        difference = v - m
        first = v if v - v == 0 else m
        out[x] = m + rate * difference if difference - difference == 0 else first


@nb.njit(cache=True)
def _update_scale(image, mean, scale, up, down, floor, least, out):
    limit = np.float32(QUANTILE_SCALES)
    for x in range(len(out)):
        v, s = image[x], scale[x]
        difference = v - mean[x]
        after = s * (up if abs(difference) > limit * s else down)
        after = after if after > least else least
        first = floor if v - v == 0 else s
        out[x] = after if difference - difference == 0 else first


@nb.njit(cache=True)
def _count(image, mean, frames, out):
    for x in range(len(out)):
        v, n = image[x], frames[x]
        difference = v - mean[x]
        first = np.uint8(1) if v - v == 0 else n
        out[x] = np.uint8(n + (n < 255)) if difference - difference == 0 else first


@nb.njit(cache=True)
def _correct(mean_out, scale_out, mean, scale, image, rows, columns, kind, untracked, tracked, displaced):
    """Correct in place, in arrays just made, what `_update_rows` did to changed pixels.

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
