"""Change detection on rectified frames: clipped exponential background, neighbourhood, local noise scale.

A pixel has changed where it leaves the range that the background spans within the registration tolerance
around it, by more than a number of local noise scales. The background is learnt *after* the tracker has said
which change is a vehicle: what is tracked is not absorbed, what nobody tracks (parallax of buildings,
aliasing of edges) soon is, and raises the noise scale where it comes again.
"""

import math
from dataclasses import dataclass

import numba as nb
import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.track import blobs, register
from glintrack.track.design import TrackDesign

Array = np.ndarray
UNTRACKED, TRACKED, GHOST = 1, 2, 3
SUPPORT_M = 0.55  # a third of a car's width: change is pooled over less than a car
MOST_SHIFT_M = 3.0  # a pose error beyond this is not one frame's jitter
OFFSET_SHARE = 0.1  # the anchor to ground coordinates: the mean shift of about ten frames
SETTLED_FRAMES = 4  # the background is a plain mean of the first few frames
QUANTILE, QUANTILE_SCALES = 0.15, 1.44  # a Gaussian exceeds 1.44 σ in 15 % of the frames


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


@dataclass(frozen=True)
class Change:
    """Changed pixels of one frame, grouped into blobs.

    Parameters
    ----------
    rows, columns, blob
        Of each changed pixel; ghosts have blob −1.
    detections
        Blobs that may be vehicles.
    detection_blob
        Blob number of each detection.
    floor
        Least noise scale of the frame. [unit of the image]
    image
        The frame, registered to the background. [unit of the image]
    offset
        See `Background`. [pixel]
    """

    rows: Int[Array, "pixel"]
    columns: Int[Array, "pixel"]
    blob: Int[Array, "pixel"]
    detections: blobs.Detections
    detection_blob: Int[Array, "detection"]
    floor: np.float32
    image: Float[Array, "y x"]
    offset: tuple[float, float]


def empty_background(shape: tuple[int, int]) -> Background:
    """A background that has seen nothing."""
    return Background(
        np.full(shape, np.nan, np.float32),
        np.zeros(shape, np.float32),
        np.zeros(shape, np.uint8),
        (0.0, 0.0),
    )


def detect(
    design: TrackDesign,
    background: Background,
    image: Float[Array, "y x"],
    gsd_m: float,
    corner_m: tuple[float, float],
    expected_m: Float[Array, "target 2"],
) -> Change:
    """Blobs in which a frame differs from the background.

    Parameters
    ----------
    design
        Threshold, tolerance and size limits.
    background
        From the frames before.
    image
        The frame, NaN where there is no data. [radiance or 1]
    gsd_m
        Grid spacing. [m]
    corner_m
        East and north of the centre of pixel (0, 0). [m]
    expected_m
        East and north where confirmed targets are expected: they cut merged blobs. [m]
    """
    floor = noise_floor(design, background, image)
    shift = register.shift_between(image, background.mean, 3 * floor, MOST_SHIFT_M / gsd_m)
    offset = tuple(o + OFFSET_SHARE * (s - o) for s, o in zip(shift, background.offset, strict=True))
    image = register.displaced(image, shift[0] - offset[0], shift[1] - offset[1])
    floor = noise_floor(design, background, image)
    low, high = envelope(background.mean, design.registration_tolerance_m / gsd_m)
    strength = _strength(image, low, high, background.scale, floor, design.threshold)
    changed = _fill_holes(_smoothed(strength, _side_weight(gsd_m)), strength, np.float32(design.threshold**2))
    reach = max(1, math.floor(design.fragment_gap_m / gsd_m))
    rows, columns = np.nonzero(changed)
    ghost = _ghosts(
        image, background.mean, background.scale, floor, changed, rows, columns, max(3, round(6 / gsd_m))
    )
    changed[rows[ghost], columns[ghost]] = False
    ghost_rows, ghost_columns = rows[ghost], columns[ghost]
    rows, columns, blob = blobs.label(changed, reach)
    if len(expected_m) > 1 and len(rows):
        seeds = np.stack([corner_m[1] - expected_m[:, 1], expected_m[:, 0] - corner_m[0]], axis=-1) / gsd_m
        blob = blobs.split(rows, columns, blob, seeds, 2.0 / gsd_m, 6.0 / gsd_m)
    count = int(blob.max()) + 1 if len(blob) else 0
    weight = np.sqrt(np.maximum(strength[rows, columns], design.threshold**2 / 4)).astype(float)
    moment = blobs.moments(rows, columns, blob, weight, count)
    fits = blobs.vehicle_sized(moment, gsd_m, (design.area_min_m2, design.area_max_m2), design.length_max_m)
    found = blobs.detections_of(moment[fits], gsd_m, corner_m, design.detection_sigma_m, design.threshold)
    sequence = blobs.order(found)
    return Change(
        np.r_[rows, ghost_rows],
        np.r_[columns, ghost_columns],
        np.r_[blob, np.full(len(ghost_rows), -1)],
        blobs.take(found, sequence),
        np.nonzero(fits)[0][sequence],
        floor,
        image,
        (offset[0], offset[1]),
    )


def learn(
    design: TrackDesign,
    background: Background,
    change: Change,
    tracked: Bool[Array, "detection"],
    interval_s: float,
) -> Background:
    """The background after one more frame.

    Parameters
    ----------
    design
        Time constants.
    background
        Before the frame.
    change
        From `detect` on the frame.
    tracked
        Which detections a confirmed track explains.
    interval_s
        Time since the frame before. [s]
    """
    image = change.image
    kind_of_blob = np.full(int(change.blob.max(initial=-1)) + 2, UNTRACKED, np.uint8)
    kind_of_blob[change.detection_blob[tracked]] = TRACKED
    kind_of_blob[-1] = GHOST  # blob −1
    rate, untracked_rate, tracked_rate = (
        np.float32(1 - math.exp(-interval_s / t))
        for t in (design.background_s, design.untracked_s, design.tracked_s)
    )
    gain = 2 * (1 - math.exp(-interval_s / design.scale_s))
    up, down = np.float32(math.exp(gain * (1 - QUANTILE))), np.float32(math.exp(-gain * QUANTILE))
    start = np.float32(max(noise_of(image), float(np.finfo(np.float32).tiny)))
    mean, scale, frames = _learn(
        background.mean, background.scale, background.frames, image, rate, up, down, start, change.floor
    )
    _relearn(
        mean, scale, background.mean, background.scale, image, change.rows, change.columns,
        kind_of_blob[change.blob], untracked_rate, tracked_rate,
    )  # fmt: skip
    return Background(mean, scale, frames, change.offset)


def noise_floor(design: TrackDesign, background: Background, image: Float[Array, "y x"]) -> np.float32:
    """Least noise scale of this frame: half its typical change, and the design's floor."""
    sample = slice(None, None, 4)
    values = image[sample, sample]
    with np.errstate(invalid="ignore"):
        change = np.abs(values - background.mean[sample, sample])
    change, values = change[np.isfinite(change)], values[np.isfinite(values)]
    floor = design.noise_floor
    if design.modality == "pan":
        floor *= abs(float(np.median(values))) if values.size else 0.0
    typical = 0.5 * 1.4826 * float(np.median(change)) if change.size else 0.0  # 1.4826: σ per median of |N|
    return np.float32(max(floor, typical, float(np.finfo(np.float32).tiny)))


def noise_of(image: Float[Array, "y x"]) -> float:
    """Noise scale of a single frame, from neighbours two apart; texture counts as noise."""
    step = image[::4, 2::4] - image[::4, :-2:4]
    step = np.abs(step[np.isfinite(step)])
    return 1.4826 * float(np.median(step)) / math.sqrt(2) if step.size else 0.0


def envelope(
    mean: Float[Array, "y x"], tolerance_px: float
) -> tuple[Float[Array, "y x"], Float[Array, "y x"]]:
    """Least and greatest background that a displacement up to ``tolerance_px`` can bring to each pixel.

    Between whole pixels the background counts as linear. NaN where no background is known.
    """
    low, high = mean, mean
    passes = max(1, math.ceil(tolerance_px))
    for _ in range(passes):
        low, high = _envelope(low, high, np.float32(tolerance_px / passes))
    return low, high


@nb.njit(cache=True)
def _envelope(low, high, weight):
    height, width = low.shape
    low_out, high_out = np.empty_like(low), np.empty_like(high)
    row_low, row_high = np.empty(width, low.dtype), np.empty(width, low.dtype)
    for y in range(height):
        above, below = max(y - 1, 0), min(y + 1, height - 1)
        for x in range(width):  # comparisons with NaN are false: unknown neighbours drop out
            a, b = low[y, x], high[y, x]
            c, d = low[above, x], low[below, x]
            e, f = high[above, x], high[below, x]
            a = c if c < a else a
            a = d if d < a else a
            b = e if e > b else b
            b = f if f > b else b
            row_low[x], row_high[x] = a, b
        for x in range(width):
            left, right = max(x - 1, 0), min(x + 1, width - 1)
            a, b = row_low[x], row_high[x]
            c, d = row_low[left], row_low[right]
            e, f = row_high[left], row_high[right]
            a = c if c < a else a
            a = d if d < a else a
            b = e if e > b else b
            b = f if f > b else b
            low_out[y, x] = low[y, x] + weight * (a - low[y, x])
            high_out[y, x] = high[y, x] + weight * (b - high[y, x])
    return low_out, high_out


@nb.njit(cache=True)
def _strength(image, low, high, scale, floor, threshold):
    """Squared excess over the envelope in noise scales, capped; −1 where there is no data."""
    out = np.empty_like(image)
    cap = np.float32(4 * threshold * threshold)  # one bright pixel must not make its neighbours change
    nothing, none = np.float32(0.0), np.float32(-1.0)
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):  # selections, no branches: this loop runs on vectors
            above, below = image[y, x] - high[y, x], low[y, x] - image[y, x]
            excess = above if above > below else below
            z = (excess if excess > nothing else nothing) / (scale[y, x] if scale[y, x] > floor else floor)
            z *= z
            total = above + below  # not finite if anything is missing
            out[y, x] = (z if z < cap else cap) if total - total == nothing else none
    return out


def _side_weight(gsd_m: float) -> np.float32:
    """Weight of each neighbour in a three-point mean whose standard deviation is `SUPPORT_M`."""
    return np.float32(min(0.25, 0.5 * (SUPPORT_M / gsd_m) ** 2))


@nb.njit(cache=True)
def _smoothed(strength, side):
    """Mean over 3 × 3 pixels; no data counts as no change, the edges repeat."""
    height, width = strength.shape
    centre = np.float32(1.0) - 2 * side
    across = np.empty_like(strength)
    for y in range(height):
        for x in range(width):
            left, right = max(x - 1, 0), min(x + 1, width - 1)
            sides = max(strength[y, left], 0) + max(strength[y, right], 0)
            across[y, x] = side * sides + centre * max(strength[y, x], 0)
    out = np.empty_like(strength)
    for y in range(height):
        above, below = max(y - 1, 0), min(y + 1, height - 1)
        for x in range(width):
            out[y, x] = side * (across[above, x] + across[below, x]) + centre * across[y, x]
    return out


@nb.njit(cache=True)
def _fill_holes(smoothed, strength, threshold2):
    """Changed pixels; a dark mirror's pixel is changed if two of its neighbours are."""
    height, width = smoothed.shape
    changed = np.empty(smoothed.shape, np.bool_)
    for y in range(height):
        for x in range(width):
            changed[y, x] = smoothed[y, x] > threshold2 and strength[y, x] >= 0
    out = changed.copy()
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            if strength[y, x] < 0:
                count = 0
                for j in range(y - 1, y + 2):
                    for i in range(x - 1, x + 2):
                        if changed[j, i]:
                            count += 1
                out[y, x] = count >= 2
    return out


@nb.njit(cache=True)
def _ghosts(image, mean, scale, floor, changed, rows, columns, reach):
    """Changed pixels where the frame looks like the unchanged surroundings and the background does not.

    That is the hole a vehicle leaves which the background had learnt, at the start or at a red light.
    """
    height, width = image.shape
    out = np.zeros(len(rows), np.bool_)
    stride = max(1, reach // 4)
    for k in range(len(rows)):
        y, x = rows[k], columns[k]
        now, before = image[y, x], mean[y, x]
        if not (np.isfinite(now) and np.isfinite(before)):
            continue
        alike = np.float32(2.5) * max(scale[y, x], floor)
        like_now = like_before = 0
        for j in range(max(0, y - reach), min(height, y + reach + 1), stride):
            for i in range(max(0, x - reach), min(width, x + reach + 1), stride):
                if not changed[j, i]:
                    if abs(mean[j, i] - now) < alike:
                        like_now += 1
                    if abs(mean[j, i] - before) < alike:
                        like_before += 1
        out[k] = like_now > 2 * like_before + 4
    return out


@nb.njit(cache=True)
def _learn(mean, scale, frames, image, rate, up, down, start, floor):
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
                s *= up if abs(difference) > limit * s else down
                mean_out[y, x] = m + share * difference
                scale_out[y, x] = s if s > least else least
                frames_out[y, x] = n + 1 if n < 255 else n
            elif v - v == nothing:  # first sight
                mean_out[y, x], scale_out[y, x], frames_out[y, x] = v, start, 1
            else:
                mean_out[y, x], scale_out[y, x], frames_out[y, x] = m, s, n
    return mean_out, scale_out, frames_out


@nb.njit(cache=True)
def _relearn(mean_out, scale_out, mean, scale, image, rows, columns, kind, untracked, tracked):
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
        elif kind[k] == GHOST:
            mean_out[y, x] = image[y, x]
            scale_out[y, x] = scale[y, x]
