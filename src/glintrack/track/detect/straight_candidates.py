"""Candidates that move straight through a frame and two or three before it: strength, motion, likelihood.

A place counts as much as the weakest of three frames shows along the best straight motion through it, plus a
share of what a fourth shows there, less what stood there in the two frames before. A dark place beside a
bright one is its shadow. Weights of the logistic model are in ``data/calibration/median_motion.toml``.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numba as nb
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from glintrack.core.arrays import Array
from glintrack.track.calibration import read_calibration
from glintrack.track.detect.footprint import peak_places, peaks

APART_M = 3.0  # of detections: cars in a queue stand 6 m apart
SHADOW_M = 5.0  # from a vehicle to the middle of its shadow, at most
MIN_RATIO, MAX_RATIO = -0.5, 9.0  # of candidates
MIN_SPEED_M_S = 1.5
BEFORE = 3  # earlier frames that are searched
SEEN_SHARE = 0.5  # of the present strength: so much in a fourth frame is the vehicle
MAX_FOURTH = 1.5  # times the present strength: a fourth frame counts no more


@dataclass(frozen=True)
class StraightCandidates:
    """Peaks of one frame, bright or dark.

    Parameters
    ----------
    place, before
        Row and column, and where the peak was in each of the three frames before, the latest first; NaN where
        it was not seen. [pixel]
    velocity
        Along these. [pixel s⁻¹]
    weakest, now, still, fourth
        Strength: the least of three frames, of this one, of what stood there before, and of a fourth frame;
        NaN where there is none. [1]
    bright
        Brighter than the background, not darker.
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
        """The candidates at an index or mask."""
        return StraightCandidates(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

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
    """Peaks of the latest layers that may be vehicles, with their strength in the two or three before.

    Parameters
    ----------
    layers
        Of bright, and of dark: strength under the windows in this frame and those before it, the latest
        first. [1]
    ages_s
        Of those before. [s]
    gsd_m
        Side of a pixel. [m]
    max_speed_m_s
        Greatest speed of a vehicle. [m s⁻¹]
    """
    steps = _steps(ages_s[0], gsd_m, max_speed_m_s)
    bright, dark = (_of_contrast(one, ages_s, gsd_m, steps, k == 0) for k, one in enumerate(layers))
    names = [field.name for field in fields(StraightCandidates)]
    return StraightCandidates(
        **{name: np.concatenate([getattr(bright, name), getattr(dark, name)]) for name in names}
    )


def _of_contrast(
    layers: Sequence[Float[Array, "y x"]],
    ages_s: Sequence[float],
    gsd_m: float,
    steps: Int[Array, "step 2"],
    bright: bool,
) -> StraightCandidates:
    """Candidates of one contrast, bright or dark."""
    cell = peaks(layers[0], _least_now(), APART_M, gsd_m)
    now = layers[0][tuple(cell.T)]
    weakest, best, still = np.zeros(len(cell)), np.zeros((len(cell), 2)), np.zeros(len(cell))
    share = ages_s[1] / ages_s[0]
    reach = max(1, round(0.5 * share))
    _follow(layers[1], layers[2], reach, cell, now, steps, share, weakest, best, still)
    fourth = np.full(len(cell), np.nan)
    if len(layers) > 3:
        share = ages_s[2] / ages_s[0]
        _look(layers[3], round(0.5 * share + 0.5), cell, now, share * best, fourth)
    near = max(1, round(2 / gsd_m))
    place = peak_places(np.maximum(layers[0], 0), cell, near)
    before = np.full((len(cell), BEFORE, 2), np.nan)
    for k, layer in enumerate(layers[1:]):
        share = ages_s[k] / ages_s[0]
        there = _greatest_near(layer, cell - share * best, round(0.5 * share + 0.25 * k))
        before[:, k] = peak_places(np.maximum(layer, 0), there, near)
    before[~(fourth >= SEEN_SHARE * now), 2] = np.nan
    velocity = (place - before[:, 1]) / ages_s[1]
    return StraightCandidates(
        place=place,
        before=before,
        velocity=velocity,
        weakest=weakest,
        now=now,
        still=still,
        fourth=fourth,
        bright=np.full(len(cell), bright),
    )


def _greatest_near(
    layer: Float[Array, "y x"], place: Float[Array, "peak 2"], reach: int
) -> Int[Array, "peak 2"]:
    """Cell of the greatest strength in a square about each place."""
    last = np.array(layer.shape) - 1
    middle = np.clip(np.floor(place + 0.5).astype(np.int64), 0, last)
    side = np.arange(-reach, reach + 1)
    around = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    cells = np.clip(middle[:, None] + around, 0, last)
    best = layer[cells[..., 0], cells[..., 1]].argmax(axis=1)
    return cells[np.arange(len(cells)), best]


def _least_now() -> float:
    """Strength below which no past makes a candidate of a peak: it is never less than the weakest."""
    models = read_calibration("median_motion").models
    limits = []
    for model in (models["three_frames"], models["four_frames"]):
        weakest, now, _, fourth = model.weights
        limits.append((MIN_RATIO - model.intercept) / (weakest + now + MAX_FOURTH * fourth))
    return float(min(limits))


def _steps(interval_s: float, gsd_m: float, max_speed_m_s: float) -> Int[Array, "step 2"]:
    """Rows and columns that a vehicle may have moved since the frame before."""
    reach = math.ceil(max_speed_m_s * interval_s / gsd_m)
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
def _follow(last, before, reach, cell, now, steps, share, weakest, best, still):
    """The greatest least of three strengths along a straight motion, that motion, and the mean at rest.

    Among motions with the same least the one whose frames show most counts.
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
                continue  # whatever the frame before shows
            b = _greatest(before, r2, c2, reach)
            least = min(now[p], min(a, b))
            total = least + 0.02 * (min(a, 2 * now[p]) + min(b, 2 * now[p]))
            if total > most:
                most = total
                weakest[p] = max(least, 0.0)
                best[p, 0], best[p, 1] = steps[s, 0], steps[s, 1]
        stood = 0.5 * (max(last[i, j], 0.0) + max(before[i, j], 0.0))
        still[p] = min(now[p], stood)


@nb.njit(cache=True, nogil=True)
def _look(layer, reach, cell, now, step, fourth):
    """What a frame shows about the place from which each peak came; nothing where that is off the frame."""
    height, width = layer.shape
    for p in range(len(cell)):
        r = int(np.floor(cell[p, 0] - step[p, 0] + 0.5))
        c = int(np.floor(cell[p, 1] - step[p, 1] + 0.5))
        if r < 0 or c < 0 or r >= height or c >= width:
            continue
        fourth[p] = min(max(_greatest(layer, r, c, reach), 0.0), MAX_FOURTH * now[p])


def select_likeliest(found: StraightCandidates, most: int, gsd_m: float) -> StraightCandidates:
    """The likeliest candidate of each vehicle, in order: no two nearer than a vehicle, and no shadows.

    Parameters
    ----------
    found
        All candidates of a frame.
    most
        How many there are at most.
    gsd_m
        Side of a pixel. [m]
    """
    ratio = found.ratio
    order = np.argsort(-ratio, kind="stable")
    found = found.take(order[ratio[order] > MIN_RATIO][:most])
    if not len(found):
        return found
    kept = np.ones(len(found), bool)
    near = np.sort(KDTree(found.place).query_pairs(SHADOW_M / gsd_m, output_type="ndarray"), axis=1)
    distance = gsd_m * np.hypot(*(found.place[near[:, 0]] - found.place[near[:, 1]]).T)
    other = found.bright[near[:, 0]] != found.bright[near[:, 1]]
    near = near[(distance <= APART_M) | other]
    for first, second in near[np.lexsort(near.T[::-1])]:
        kept[second] &= not kept[first]
    return found.take(kept)
