"""Kernels of change detection: plain arrays in, plain arrays out, NaN where there is no data."""

import numba as nb
import numpy as np

SUPPORT_M = 0.55  # a third of a car's width: change is pooled over less than a car
CHANGED, HOLE, DISPLACED = 0, 1, 2  # what a changed pixel is


@nb.njit(cache=True)
def envelope(low, high, weight):
    """One pass of `change.envelope`."""
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
def excess2(image, low, high, scale, floor, threshold):
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


def side_weight(gsd_m: float) -> np.float32:
    """Weight of each neighbour in a three-point mean whose standard deviation is `SUPPORT_M`."""
    return np.float32(min(0.25, 0.5 * (SUPPORT_M / gsd_m) ** 2))


@nb.njit(cache=True)
def pooled(strength, side):
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
def fill_holes(smoothed, strength, threshold2):
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
def explained(image, mean, scale, floor, changed, rows, columns, reach, near, share):
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
