"""Kernels of how targets are confirmed, kept and dropped."""

import math

import numba as nb
import numpy as np

DOUBLE_SPEED_M_S = 3.0  # two tracks on one vehicle differ less
_ROUNDING = 1e-9


@nb.njit(cache=True)
def bits_of(history):
    """Count the ones among 32 bits."""
    pairs = history - ((history >> 1) & 0x55555555)  # the count of each two bits, then of four, of eight
    fours = (pairs & 0x33333333) + ((pairs >> 2) & 0x33333333)
    return ((((fours + (fours >> 4)) & 0x0F0F0F0F) * 0x01010101) & 0xFFFFFFFF) >> 24


@nb.njit(cache=True)
def all_bits_of(histories):
    """`bits_of` of each."""
    out = np.empty(len(histories), np.int64)
    for k in range(len(out)):
        out[k] = bits_of(histories[k])
    return out


@nb.njit(cache=True)
def confirm(confirmed, assigned, history, mean, born, score, age, hits, window, limits):
    """History with this epoch in it, and whether each target is confirmed now.

    Limits are those of age [s], score [nat], way [m] and speed [m s⁻¹].
    """
    age_s, score_nat, travel_m, speed_m_s = limits
    seen, sure = np.empty(len(mean), np.int64), np.empty(len(mean), np.bool_)
    for k in range(len(mean)):
        hit = assigned[k] >= 0
        seen[k] = ((history[k] << 1) | hit) & ((1 << window) - 1)
        sure[k] = confirmed[k] or (
            hit
            and bits_of(seen[k]) >= hits
            and age[k] >= age_s - _ROUNDING
            and score[k] >= score_nat
            and math.hypot(mean[k, 0] - born[k, 0], mean[k, 1] - born[k, 1]) >= travel_m
            and math.hypot(mean[k, 2], mean[k, 3]) >= speed_m_s
        )
    return seen, sure


@nb.njit(cache=True)
def track_quality(before, confirmed, assigned, stands, filled, drains):
    """As `targets.trusted`: what one epoch fills, and drains [1] of who drives and of who stands."""
    out = np.empty(len(before))
    for k in range(len(out)):
        if assigned[k] >= 0:
            out[k] = min(before[k] + filled, 1.0)
        else:
            out[k] = before[k] - (stands[k] * drains[1] + (1.0 - stands[k]) * drains[0])
        if not confirmed[k]:
            out[k] = max(out[k], 0.0)
    return out


@nb.njit(cache=True)
def alive(confirmed, quality, misses, unseen, mean, most_misses, most_s, shape, corner, gsd):
    """Whether each target is neither lost nor off the grid."""
    out = np.empty(len(mean), np.bool_)
    for k in range(len(mean)):
        if confirmed[k]:
            out[k] = quality[k] > -_ROUNDING
        else:
            out[k] = misses[k] <= most_misses or unseen[k] <= most_s + _ROUNDING
        row, column = np.rint((corner[1] - mean[k, 1]) / gsd), np.rint((mean[k, 0] - corner[0]) / gsd)
        out[k] &= row >= 0 and row < shape[0] and column >= 0 and column < shape[1]
    return out


@nb.njit(cache=True)
def doubles(alive, confirmed, misses, mean, by_east, distance):
    """Pairs of targets that are near and move alike, the better one first; and their rank, the best lowest.

    Better is confirmed, then measured, then older; a target's index rises as its age falls.
    """
    pairs = _alike(alive, mean, by_east, distance, np.empty((0, 2), np.int64))
    close = np.empty((pairs, 2), np.int64)
    _alike(alive, mean, by_east, distance, close)
    rank = np.empty(pairs, np.int64)
    for q in range(pairs):
        a, b = close[q]
        worse_a = 2 * (not confirmed[a]) + (misses[a] > 0)
        worse_b = 2 * (not confirmed[b]) + (misses[b] > 0)
        if worse_b < worse_a or (worse_b == worse_a and b < a):
            a, b, worse_a = b, a, worse_b
        close[q, 0], close[q, 1], rank[q] = a, b, worse_a * len(mean) + a
    return close, rank


@nb.njit(cache=True)
def without_doubles(alive, close, best_first):
    """Which targets live on; what is a double takes nobody with it."""
    out = alive.copy()
    for q in best_first:
        if out[close[q, 0]]:
            out[close[q, 1]] = False
    return out


@nb.njit(cache=True)
def _alike(alive, mean, by_east, distance, close):
    """Count the pairs of targets that are near and move alike, and write as many as there is room for."""
    n = 0
    sorted_mean = np.empty((len(by_east), 4))
    who = np.empty(len(by_east), np.int64)
    for k in by_east:
        if alive[k]:
            for c in range(4):
                sorted_mean[n, c] = mean[k, c]
            who[n] = k
            n += 1
    count = 0
    for p in range(n):
        for q in range(p + 1, n):
            if sorted_mean[q, 0] - sorted_mean[p, 0] > distance:
                break
            if abs(sorted_mean[q, 1] - sorted_mean[p, 1]) > distance:
                continue
            a, b = sorted_mean[p], sorted_mean[q]
            if math.hypot(a[0] - b[0], a[1] - b[1]) > distance:
                continue
            if math.hypot(a[2] - b[2], a[3] - b[3]) <= DOUBLE_SPEED_M_S:
                if count < len(close):
                    close[count, 0], close[count, 1] = who[p], who[q]
                count += 1
    return count


@nb.njit(cache=True)
def unclaimed(position, assigned, mean, misses, by_east, distance):
    """Index of the detections that no target took, and that are near none which took another."""
    free = np.ones(len(position), np.bool_)
    for k in range(len(assigned)):
        if assigned[k] >= 0:
            free[assigned[k]] = False
    for d in range(len(position)):
        if not free[d]:
            continue
        east, north = position[d, 0], position[d, 1]
        low, high = 0, len(by_east)
        while low < high:
            middle = (low + high) // 2
            if mean[by_east[middle], 0] < east - distance:
                low = middle + 1
            else:
                high = middle
        for q in range(low, len(by_east)):
            k = by_east[q]
            if mean[k, 0] > east + distance:
                break
            if misses[k] == 0 and math.hypot(mean[k, 0] - east, mean[k, 1] - north) <= distance:
                free[d] = False
                break
    return np.flatnonzero(free)
