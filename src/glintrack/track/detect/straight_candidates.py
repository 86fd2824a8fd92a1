"""Candidates that move straight through a frame and two or three before it: strength, motion, likelihood.

The likelihood of a candidate rises with its strength in the weakest of three frames along its best straight
motion and with that in a fourth frame, and falls with the strength at rest in the two frames before. A dark
candidate next to a bright one that moves alike is its shadow: both become one candidate between them, so that
its position does not jump when the other one is the stronger. Weights of the logistic model are in
``data/calibration/median_motion.toml``.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numba as nb
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from glintrack.core.arrays import Array
from glintrack.track.calibration import read_calibration
from glintrack.track.detect.footprint import peak_places, peaks

APART_M = 3.0  # of detections: cars in a queue stand 6 m apart
MIN_RATIO, MAX_RATIO = -0.5, 9.0  # of candidates
MIN_SPEED_M_S = 1.5
BEFORE = 3  # earlier frames that are searched
SEEN_SHARE = 0.5  # of the present strength: from it on a fourth frame contains the vehicle
MAX_REACH_PX = 2000  # of a motion between frames: more take gigabytes and hours
MAX_FOURTH = 1.5  # limit of a fourth frame, times the present strength


@dataclass(frozen=True)
class StraightCandidates:
    """Peaks of one frame, bright or dark.

    Parameters
    ----------
    place, before
        Row and column now, and in each of the three frames before, the latest first; NaN where it was not
        found. [pixel]
    velocity
        Velocity from these. [pixel s⁻¹]
    weakest, now, still, fourth
        Strength: minimum of three frames, in this one, at rest before, and in a fourth frame; NaN without
        one. [1]
    bright
        True if brighter than the background, False if darker.
    """

    place: Float[Array, "peak 2"]
    before: Float[Array, "peak frame 2"]
    velocity: Float[Array, "peak 2"]
    weakest: Float[Array, "peak"]
    now: Float[Array, "peak"]
    still: Float[Array, "peak"]
    fourth: Float[Array, "peak"]
    bright: Bool[Array, "peak"]

    def __len__(self) -> int:
        """Count of peaks."""
        return len(self.now)

    def take(self, index: Array) -> "StraightCandidates":
        """Select the candidates at an index or mask."""
        return StraightCandidates(**{name: values[index] for name, values in vars(self).items()})

    @property
    def ratio(self) -> Float[Array, "peak"]:
        """Log-likelihood ratio of vehicle against clutter. [nat]"""
        models = read_calibration("median_motion").models
        features = np.stack([self.weakest, self.now, self.still, np.nan_to_num(self.fourth)], axis=-1)
        three, four = (models[name].log_odds(features) for name in ("three_frames", "four_frames"))
        return np.minimum(np.where(np.isnan(self.fourth), three, four), MAX_RATIO)


def find_candidates(
    layers: Sequence[Sequence[Float[Array, "y x"]]],
    ages_s: Sequence[float],
    gsd_m: float,
    max_speed_m_s: float,
) -> StraightCandidates:
    """Find peaks of the latest layers, with their strength in the two or three before.

    Parameters
    ----------
    layers
        Strength of bright and of dark changes under the windows in this frame and those before it, the latest
        first. [1]
    ages_s
        Ages of those before. [s]
    gsd_m
        Side of a pixel. [m]
    max_speed_m_s
        Greatest speed of a vehicle. [m s⁻¹]
    """
    steps = _steps(ages_s[0], gsd_m, max_speed_m_s, layers[0][0].shape)
    bright, dark = (_find_contrast(one, ages_s, gsd_m, steps, k == 0) for k, one in enumerate(layers))
    both = {name: np.concatenate([values, vars(dark)[name]]) for name, values in vars(bright).items()}
    return StraightCandidates(**both)


def _find_contrast(
    layers: Sequence[Float[Array, "y x"]],
    ages_s: Sequence[float],
    gsd_m: float,
    steps: Int[Array, "step 2"],
    bright: bool,
) -> StraightCandidates:
    """Find candidates of one contrast, bright or dark."""
    cell = peaks(layers[0], _min_strength(), APART_M, gsd_m)
    now = layers[0][tuple(cell.T)]
    weakest, best, still = np.zeros(len(cell)), np.zeros((len(cell), 2)), np.zeros(len(cell))
    share = ages_s[1] / ages_s[0]
    reach = max(1, round(0.5 * share))
    _find_motion(layers[1], layers[2], reach, cell, now, steps, share, weakest, best, still)
    fourth = np.full(len(cell), np.nan)
    if len(layers) > 3:
        share = ages_s[2] / ages_s[0]
        there = np.floor(cell - share * best + 0.5).astype(int)
        inside = ((there >= 0) & (there < layers[3].shape)).all(axis=1)
        there = _strongest_cells(layers[3], cell - share * best, round(0.5 * share + 0.5))
        strength = np.minimum(np.maximum(layers[3][tuple(there.T)], 0.0), MAX_FOURTH * now)
        fourth[inside] = strength[inside]
    near = max(1, round(2 / gsd_m))
    place = peak_places(np.maximum(layers[0], 0), cell, near)
    before = np.full((len(cell), BEFORE, 2), np.nan)
    for k, layer in enumerate(layers[1:]):
        share = ages_s[k] / ages_s[0]
        there = _strongest_cells(layer, cell - share * best, round(0.5 * share + 0.25 * k))
        before[:, k] = peak_places(np.maximum(layer, 0), there, near)
    before[~(fourth >= SEEN_SHARE * now), 2] = np.nan
    velocity = (place - before[:, 1]) / ages_s[1]
    return StraightCandidates(
        place=place, before=before, velocity=velocity, weakest=weakest, now=now, still=still, fourth=fourth,
        bright=np.full(len(cell), bright),
    )  # fmt: skip


def _strongest_cells(
    layer: Float[Array, "y x"], place: Float[Array, "peak 2"], reach: int
) -> Int[Array, "peak 2"]:
    """Cell of the greatest strength in a square around each position; the first in reading order."""
    cells = np.clip(np.floor(place + 0.5), 0, np.array(layer.shape) - 1).astype(np.int64)
    _move_to_greatest(layer, cells, reach)
    return cells


def _min_strength() -> float:
    """Minimum strength of a candidate, for any strength in the frames before."""
    models = read_calibration("median_motion").models
    limits = []
    for model in (models["three_frames"], models["four_frames"]):
        weakest, now, _, fourth = model.weights
        limits.append((MIN_RATIO - model.intercept) / (weakest + now + MAX_FOURTH * fourth))
    return float(min(limits))


def _steps(
    interval_s: float, gsd_m: float, max_speed_m_s: float, shape: tuple[int, ...]
) -> Int[Array, "step 2"]:
    """Possible motions of a vehicle since the frame before within an image, in rows and columns."""
    reach = min(math.ceil(max_speed_m_s * interval_s / gsd_m), max(shape))
    if reach > MAX_REACH_PX:
        raise ValueError(
            f"`frames` must be so close in time that a vehicle moves by {MAX_REACH_PX:,} pixels at most; got "
            f"{interval_s:.3g} s and pixels of {gsd_m:.3g} m: is the time in seconds? Else average pixels, "
            "or lower `detect.max_speed_m_s`."
        )
    row, column = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    speed = np.hypot(row, column) * gsd_m / interval_s
    possible = (speed >= MIN_SPEED_M_S) & (speed <= max_speed_m_s)
    step = np.stack([row[possible], column[possible]], axis=-1)
    return step[np.argsort(np.hypot(*step.T), kind="stable")]


@nb.njit(cache=True, nogil=True)
def _greatest(layer, row, column, reach):
    """Greatest of the pixels about one, in a square."""
    height, width = layer.shape
    most = layer[row, column]
    for y in range(max(row - reach, 0), min(row + reach + 1, height)):
        for x in range(max(column - reach, 0), min(column + reach + 1, width)):
            most = max(most, layer[y, x])
    return most


@nb.njit(cache=True, nogil=True)
def _move_to_greatest(layer, cells, reach):
    """Move each cell to the greatest pixel in a square about it."""
    height, width = layer.shape
    for p in range(len(cells)):
        i, j = cells[p, 0], cells[p, 1]
        most = -np.inf
        for y in range(max(i - reach, 0), min(i + reach + 1, height)):
            for x in range(max(j - reach, 0), min(j + reach + 1, width)):
                if layer[y, x] > most:
                    most = layer[y, x]
                    cells[p, 0], cells[p, 1] = y, x


@nb.njit(cache=True, nogil=True)
def _find_motion(last, before, reach, cell, now, steps, share, weakest, best, still):
    """Find the straight motion with the greatest minimum of three strengths, and the mean at rest.

    Among motions with the same minimum the one with the greatest sum is chosen.
    """
    height, width = last.shape
    for p in range(len(cell)):
        i, j = cell[p, 0], cell[p, 1]
        most = -1.0
        for s in range(len(steps)):
            r1, c1 = i - steps[s, 0], j - steps[s, 1]
            r2 = i - int(np.floor(share * steps[s, 0] + 0.5))
            c2 = j - int(np.floor(share * steps[s, 1] + 0.5))
            if r1 < 0 or c1 < 0 or r1 >= height or c1 >= width:
                continue
            if r2 < 0 or c2 < 0 or r2 >= height or c2 >= width:
                continue
            a = last[r1, c1]
            if min(now[p], a) + 0.02 * (min(a, 2 * now[p]) + 2 * now[p]) <= most:
                continue  # for any strength in the frame before
            b = _greatest(before, r2, c2, reach)
            least = min(now[p], min(a, b))
            total = least + 0.02 * (min(a, 2 * now[p]) + min(b, 2 * now[p]))
            if total > most:
                most = total
                weakest[p] = max(least, 0.0)
                best[p, 0], best[p, 1] = steps[s, 0], steps[s, 1]
        stood = 0.5 * (max(last[i, j], 0.0) + max(before[i, j], 0.0))
        still[p] = min(now[p], stood)


def select_candidates(found: StraightCandidates, most: int, gsd_m: float) -> StraightCandidates:
    """Select the most likely candidate of each vehicle, and merge it with its shadow.

    Parameters
    ----------
    found
        All candidates of a frame.
    most
        Maximum number of candidates.
    gsd_m
        Side of a pixel. [m]
    """
    ratio = found.ratio
    order = np.argsort(-ratio, kind="stable")
    found = found.take(order[ratio[order] > MIN_RATIO][:most])
    if not len(found):
        return found
    selected = np.ones(len(found), bool)
    limits = read_calibration("median_motion").constants
    pairs = KDTree(found.place).query_pairs(limits["shadow_m"] / gsd_m, output_type="ndarray")
    near = np.sort(pairs, axis=1)
    apart_m, speed_m_s = (
        gsd_m * np.hypot(*(of[near[:, 0]] - of[near[:, 1]]).T) for of in (found.place, found.velocity)
    )
    other = found.bright[near[:, 0]] != found.bright[near[:, 1]]
    shadow = other & (speed_m_s <= limits["shadow_speed_m_s"])
    place, before, merged = found.place.copy(), found.before.copy(), np.zeros(len(found), bool)
    order = np.lexsort(near.T[::-1])
    for k in order[((apart_m <= APART_M) | other)[order]]:
        first, second = near[k]
        if not selected[first]:
            continue
        if selected[second] and shadow[k] and not merged[first]:
            share = found.now[second] / (found.now[first] + found.now[second])
            place[first] += share * (found.place[second] - found.place[first])
            step = share * (found.before[second] - found.before[first])
            before[first] += np.where(np.isnan(step), place[first] - found.place[first], step)
            merged[first] = True
        selected[second] = False
    return replace(found, place=place, before=before).take(selected)
