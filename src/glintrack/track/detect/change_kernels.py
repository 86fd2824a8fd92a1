"""Kernels of change detection: plain arrays in, plain arrays out, NaN where there is no data."""

from typing import NamedTuple

import numba as nb
import numpy as np

from glintrack.core.arrays import Array

SUPPORT_M = 0.55  # a third of a car's width: change is pooled over less than a car
CHANGED, HOLE, DISPLACED = 0, 1, 2  # what a changed pixel is


class ChangedFrame(NamedTuple):
    """A plane, what is known of it (mean, noise scale and its floor), and its changed pixels."""

    image: Array
    mean: Array
    scale: Array
    floor: np.float32
    changed: Array


@nb.njit(nogil=True, cache=True)
def envelope(start, stop, low, high, weight, low_out, high_out):
    """One pass of `change.envelope`."""
    row = np.empty(low.shape[1], low.dtype)
    for y in range(start, stop):
        above, below = max(y - 1, 0), min(y + 1, len(low) - 1)
        _lowest(low[above], low[y], low[below], row, weight, low_out[y])
        _highest(high[above], high[y], high[below], row, weight, high_out[y])


@nb.njit(cache=True)
def _lowest(above, here, below, row, weight, out):
    """From each pixel ``weight`` of the way to the least of its 3 × 3; ``row`` is scratch.

    Comparisons with NaN are false, so that unknown neighbours drop out and an unknown pixel stays so. The
    loops are over slices, without branches: they run on vectors.
    """
    for x in range(len(row)):
        a, c, d = here[x], above[x], below[x]
        a = c if c < a else a
        row[x] = d if d < a else a
    left, centre, right, mine, inner = row[:-2], row[1:-1], row[2:], here[1:-1], out[1:-1]
    for x in range(len(inner)):
        a, c, d = centre[x], left[x], right[x]
        a = c if c < a else a
        a = d if d < a else a
        inner[x] = mine[x] + weight * (a - mine[x])
    for x, beside in ((0, 1), (len(row) - 1, len(row) - 2)):
        a = row[beside] if row[beside] < row[x] else row[x]
        out[x] = here[x] + weight * (a - here[x])


@nb.njit(cache=True)
def _highest(above, here, below, row, weight, out):
    """As `_lowest`, to the greatest."""
    for x in range(len(row)):
        a, c, d = here[x], above[x], below[x]
        a = c if c > a else a
        row[x] = d if d > a else a
    left, centre, right, mine, inner = row[:-2], row[1:-1], row[2:], here[1:-1], out[1:-1]
    for x in range(len(inner)):
        a, c, d = centre[x], left[x], right[x]
        a = c if c > a else a
        a = d if d > a else a
        inner[x] = mine[x] + weight * (a - mine[x])
    for x, beside in ((0, 1), (len(row) - 1, len(row) - 2)):
        a = row[beside] if row[beside] > row[x] else row[x]
        out[x] = here[x] + weight * (a - here[x])


@nb.njit(nogil=True, cache=True)
def excess2(start, stop, image, low, high, weight, scale, floor, cap, out):
    """Squared excess over the envelope in noise scales, capped; −1 where there is no data.

    The envelope is one pass wider than the arrays given. The cap keeps one bright pixel from making its
    neighbours change.
    """
    width = image.shape[1]
    row, lowest, highest = np.empty(width, low.dtype), np.empty(width, low.dtype), np.empty(width, low.dtype)
    for y in range(start, stop):
        above, below = max(y - 1, 0), min(y + 1, len(low) - 1)
        _lowest(low[above], low[y], low[below], row, weight, lowest)
        _highest(high[above], high[y], high[below], row, weight, highest)
        _excess2(image[y], lowest, highest, scale[y], floor, cap, out[y])


@nb.njit(cache=True, error_model="numpy")  # the divisor is positive; a test of it would bar vectors
def _excess2(image, low, high, scale, floor, cap, out):
    nothing, none = np.float32(0.0), np.float32(-1.0)
    for x in range(len(out)):  # selections, no branches: this loop runs on vectors
        above, below = image[x] - high[x], low[x] - image[x]
        excess = above if above > below else below
        z = (excess if excess > nothing else nothing) / (scale[x] if scale[x] > floor else floor)
        z *= z
        total = above + below  # not finite if anything is missing
        out[x] = (z if z < cap else cap) if total - total == nothing else none


def side_weight(gsd_m: float) -> np.float32:
    """Weight of each neighbour in a three-point mean whose standard deviation is `SUPPORT_M`."""
    return np.float32(min(0.25, 0.5 * (SUPPORT_M / gsd_m) ** 2))


@nb.njit(nogil=True, cache=True)
def changed(start, stop, strength, side, threshold2, out, holes):
    """Pixels whose mean over 3 × 3 exceeds the threshold, and which rows have pixels without data.

    No data counts as no change, the edges repeat.
    """
    height, width = strength.shape
    across = np.empty((3, width), strength.dtype)  # rows y − 1, y and y + 1 by their remainder of 3
    for y in range(max(start - 1, 0), min(start + 1, height)):
        _across(strength[y], side, across[y % 3])
    for y in range(start, stop):
        above, below = max(y - 1, 0), min(y + 1, height - 1)
        if below > y:
            _across(strength[below], side, across[below % 3])
        holes[y] = _exceeds(
            across[above % 3], across[y % 3], across[below % 3], strength[y], side, threshold2, out[y]
        )


@nb.njit(cache=True)
def _across(strength, side, out):
    """Weighted mean of each pixel and the two beside it."""
    nothing, centre = np.float32(0.0), np.float32(1.0) - 2 * side
    left, here, right, inner = strength[:-2], strength[1:-1], strength[2:], out[1:-1]
    for x in range(len(inner)):
        a, b, c = left[x], here[x], right[x]
        sides = (a if a > nothing else nothing) + (c if c > nothing else nothing)
        inner[x] = side * sides + centre * (b if b > nothing else nothing)
    last = len(out) - 1
    for x, beside in ((0, 1), (last, last - 1)):
        mine = max(strength[x], nothing)
        out[x] = side * (mine + max(strength[beside], nothing)) + centre * mine


@nb.njit(cache=True)
def _exceeds(above, here, below, strength, side, threshold2, out):
    """Whether the mean down the columns exceeds the threshold; True is returned if any has no data."""
    centre, nothing, missing = np.float32(1.0) - 2 * side, np.float32(0.0), False
    for x in range(len(out)):
        smoothed = side * (above[x] + below[x]) + centre * here[x]
        out[x] = (smoothed > threshold2) & (strength[x] >= nothing)
        missing |= strength[x] < nothing
    return missing


@nb.njit(cache=True)
def fill_holes(changed, strength, holes):
    """Change in place a dark mirror's pixel if two of its neighbours have changed, themselves no such."""
    height, width = changed.shape
    filled = np.uint8(2)  # for the time being: it does not count
    for y in range(1, height - 1):
        if not holes[y]:
            continue
        for x in range(1, width - 1):
            if strength[y, x] < 0:
                count = 0
                for j in range(y - 1, y + 2):
                    for i in range(x - 1, x + 2):
                        count += changed[j, i] == 1
                if count >= 2:
                    changed[y, x] = filled
    for y in range(1, height - 1):
        if holes[y]:
            for x in range(width):
                changed[y, x] = min(changed[y, x], 1)


@nb.njit(nogil=True, cache=True)
def explained(start, stop, frame, rows, columns, reach, near, share, out):
    """What the unchanged surroundings say of each changed pixel: `CHANGED`, `HOLE` or `DISPLACED`.

    A hole: the frame looks like the surroundings and the background does not, since a vehicle has left which
    the background had learnt, at the start or at a red light. Displaced: the frame looks like some of the
    pixels very near, an edge that the parallax of a roof has moved.
    """
    image, mean, scale, changed = frame.image, frame.mean, frame.scale, frame.changed
    floor = frame.floor
    height, width = image.shape
    stride = max(1, reach // 4)
    for k in range(start, stop):
        out[k] = CHANGED
        y, x = rows[k], columns[k]
        now, before = image[y, x], mean[y, x]
        if not (np.isfinite(now) and np.isfinite(before)):
            continue
        alike = np.float32(2.5) * max(scale[y, x], floor)
        like_now = like_before = 0
        left, right = max(0, x - reach), min(width, x + reach + 1)
        for j in range(max(0, y - reach), min(height, y + reach + 1), stride):
            known, moving = mean[j, left:right:stride], changed[j, left:right:stride]
            for i in range(len(known)):
                still = moving[i] == 0  # counted without branches, which nobody could predict
                like_now += still & (abs(known[i] - now) < alike)
                like_before += still & (abs(known[i] - before) < alike)
        if like_now > 2 * like_before + 4:
            out[k] = HOLE
            continue
        if near == 0:
            continue
        like_near = total = 0
        left, right = max(0, x - near), min(width, x + near + 1)
        for j in range(max(0, y - near), min(height, y + near + 1)):
            known, moving = mean[j, left:right], changed[j, left:right]
            for i in range(len(known)):
                still = moving[i] == 0
                total += still
                like_near += still & (abs(known[i] - now) < alike)
        if like_near > share * total:
            out[k] = DISPLACED
