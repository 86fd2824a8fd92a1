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

from glintrack.track import background as backgrounds
from glintrack.track import blobs, register
from glintrack.track.background import Background
from glintrack.track.design import TrackDesign

Array = np.ndarray
CHANGED, HOLE, DISPLACED = 0, 1, 2  # what a changed pixel is
SUPPORT_M = 0.55  # a third of a car's width: change is pooled over less than a car
MOST_SHIFT_M = 3.0  # a pose error beyond this is not one frame's jitter
OFFSET_SHARE = 0.1  # the anchor to ground coordinates: the mean shift of about ten frames


@dataclass(frozen=True)
class Change:
    """Changed pixels of one frame, grouped into blobs.

    Parameters
    ----------
    rows, columns, blob
        Of each changed pixel; holes have blob −1, displaced pixels −2.
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
    floor = backgrounds.noise_floor(design, background, image)
    shift = register.shift_between(image, background.mean, 3 * float(floor), MOST_SHIFT_M / gsd_m)
    offset = tuple(o + OFFSET_SHARE * (s - o) for s, o in zip(shift, background.offset, strict=True))
    image = register.displaced(image, shift[0] - offset[0], shift[1] - offset[1])
    floor = backgrounds.noise_floor(design, background, image)
    low, high = envelope(background.mean, design.registration_tolerance_m / gsd_m)
    strength = _strength(image, low, high, background.scale, floor, design.threshold)
    changed = _fill_holes(_smoothed(strength, _side_weight(gsd_m)), strength, np.float32(design.threshold**2))
    reach = max(1, math.floor(design.fragment_gap_m / gsd_m))
    rows, columns = np.nonzero(changed)
    explained = _explained(
        image,
        background.mean,
        background.scale,
        floor,
        changed,
        rows,
        columns,
        max(3, round(6 / gsd_m)),
        round(design.parallax_m / gsd_m),
        design.parallax_share,
    )
    no_vehicle = explained != CHANGED
    explained, others = explained[no_vehicle], (rows[no_vehicle], columns[no_vehicle])
    changed[others] = False
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
        np.r_[rows, others[0]],
        np.r_[columns, others[1]],
        np.r_[blob, -explained.astype(np.int64)],
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
    kind_of_blob = np.full(int(change.blob.max(initial=-1)) + 3, backgrounds.UNTRACKED, np.uint8)
    kind_of_blob[change.detection_blob[tracked]] = backgrounds.TRACKED
    kind_of_blob[-HOLE], kind_of_blob[-DISPLACED] = backgrounds.HOLE, backgrounds.DISPLACED
    kind = kind_of_blob[change.blob]
    return backgrounds.learnt(
        design, background, change.image, (change.rows, change.columns, kind), change.floor, change.offset,
        interval_s,
    )  # fmt: skip


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
def _explained(image, mean, scale, floor, changed, rows, columns, reach, near, share):
    """What the unchanged surroundings say of each changed pixel: `CHANGED`, `HOLE` or `DISPLACED`.

    A hole: the frame looks like the surroundings and the background does not, since a vehicle has left which
    the background had learnt, at the start or at a red light. Displaced: the frame looks like some of the
    pixels very near, an edge that the parallax of a roof has moved.
    """
    height, width = image.shape
    out = np.zeros(len(rows), np.uint8)
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
        if like_now > 2 * like_before + 4:
            out[k] = HOLE
            continue
        if near == 0:
            continue
        like_near = total = 0
        for j in range(max(0, y - near), min(height, y + near + 1)):
            for i in range(max(0, x - near), min(width, x + near + 1)):
                if not changed[j, i]:
                    total += 1
                    if abs(mean[j, i] - now) < alike:
                        like_near += 1
        if like_near > share * total:
            out[k] = DISPLACED
    return out
