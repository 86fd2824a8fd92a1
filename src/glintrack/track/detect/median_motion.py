"""The detector ``median-motion``: change against a sliding median, seen thrice along one straight motion.

For rectified frames from near nadir, without mosaic or pose. A frame is put onto the background
(`local_registration`), its change against the median of a short window is counted in standard deviations that
know gradient and history (`sliding_median`), and averaged, bright and dark apart, over windows of a vehicle's
footprint (`footprint`). A place counts for what the weakest of three frames shows along the best straight
motion through it, less what stood there in the two frames before: parallax, flicker and standing vehicles
stand still. The last three frames are compared with today's median, so that the third frame already shows
what moved in the first.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numba as nb
import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import maximum_filter
from scipy.spatial import KDTree

from glintrack.arrays import Array
from glintrack.track.detect import local_registration as registration
from glintrack.track.detect import sliding_median
from glintrack.track.detect.design import DetectDesign
from glintrack.track.detect.detections import Detections, no_detections
from glintrack.track.detect.detector import Association
from glintrack.track.detect.footprint import footprints, peak_places, peaks, window_means
from glintrack.track.detect.frame import Frame, Grid, grid_of, plane

WINDOW = 6  # frames in a median: more hold parallax, fewer a queue
SPACING_S = 0.35  # between frames that are remembered: at 25 Hz nothing moves from one to the next
FOOTPRINT_M = (4.6, 2.6)
APART_M = 3.0  # of detections: cars in a queue stand 6 m apart
CAP = 6.0  # standard deviations: a glint is no more vehicle than a car
LEAST = 0.5  # strength of a peak, mean standard deviations under the window
SLOWEST_M_S, FASTEST_M_S = 1.5, 36.0
BLANK = 7  # pixels: so large a square of zeros is no data
SIGMA_M, SIGMA_PX = 0.6, 0.3  # of a place
LEAST_RATIO = -0.5  # of detections given to the tracker
LARGEST_RATIO = 9.0
DECISION = 2.0  # ratio at which a detection alone is as often right as wrong, and its contrast 1
MOST_PER_KM2 = 4000.0
# of the log-likelihood ratio: intercept, and weights of the weakest of three, of now, and of what stood there
LAW = (-5.0, 2.1, 1.05, -2.7)


@dataclass(frozen=True)
class Past:
    """A frame that is remembered: when, and its planes on the background."""

    time_s: float
    planes: Mapping[str, Float[Array, "y x"]]


@dataclass(frozen=True)
class Memory:
    """What the detector keeps between frames: the grid and the latest frames, the oldest first."""

    grid: Grid
    past: tuple[Past, ...] = ()


@dataclass(frozen=True)
class Candidates:
    """Peaks of one frame: places [pixel], steps that support them [pixel s⁻¹], and strengths. [1]"""

    place: Float[Array, "peak 2"]
    velocity: Float[Array, "peak 2"]
    weakest: Float[Array, "peak"]
    now: Float[Array, "peak"]
    still: Float[Array, "peak"]


@dataclass(frozen=True)
class MedianMotionDetector:
    """Vehicles of either contrast that move straight through three rectified frames.

    Parameters
    ----------
    design
        Its channel says which planes of the image are searched.
    """

    design: DetectDesign

    def start(self, frame: Frame) -> Memory:
        """Nothing seen yet."""
        return Memory(grid_of(frame, None))

    def detect(self, state: Memory, frame: Frame) -> Detections:
        """What moves straight through this frame and two before it; nothing in the first two."""
        placed = _placed(state, frame)
        now = Past(frame.time_s, placed)
        if len(state.past) < 2:
            return replace(no_detections(), log_likelihood_ratio=np.empty(0), detail=now)
        layers = _layers((*state.past[-WINDOW + 1 :], now), state.grid.gsd_m)
        ages = [frame.time_s - one.time_s for one in state.past[-2:][::-1]]
        found = [_candidates(one, ages, state.grid.gsd_m) for one in layers]
        ratio = [_log_likelihood_ratio(one) for one in found]
        together = Candidates(
            *(np.concatenate(part) for part in zip(*(vars(one).values() for one in found), strict=True))
        )
        times = tuple(one.time_s for one in state.past[-2:])
        return _detections(state.grid, together, np.concatenate(ratio), times, now)

    def update(self, state: Memory, frame: Frame, detections: Detections, association: Association) -> Memory:
        """The latest frames; one that comes too soon after the last is not remembered."""
        now: Past = detections.detail
        if state.past and now.time_s - state.past[-1].time_s < SPACING_S:
            return state
        return replace(state, past=(*state.past, now)[-WINDOW + 1 :])


def _placed(state: Memory, frame: Frame) -> dict[str, Float[Array, "y x"]]:
    """The frame's planes, moved and scaled onto the background; as they are in the first."""
    planes = {name: _with_blanks(plane(frame, name)) for name in frame.planes}
    if not state.past:
        return planes
    grid_of(frame, state.grid)
    back = {name: sliding_median.median_and_spread(_stack(state.past, name))[0] for name in planes}
    for name in planes:
        if name == "pan":
            gain, offset = registration.gain_between(planes[name], back[name])
            planes[name] = gain * planes[name] + np.float32(offset)
    first = next(iter(planes))
    shift, tile = registration.displacement(planes[first], back[first], state.grid.gsd_m)
    return {name: registration.shift_locally(one, shift, tile) for name, one in planes.items()}


def _with_blanks(values: Float[Array, "y x"]) -> Float[Array, "y x"]:
    """The same with NaN where a square of zeros says that nothing was seen."""
    zero = values == 0
    if not zero.any():
        return values
    blank = maximum_filter(maximum_filter(~zero, BLANK) == 0, BLANK)
    return np.where(blank & zero, np.float32(np.nan), values)


def _stack(past: tuple[Past, ...], name: str) -> Float[Array, "frame y x"]:
    return np.stack([one.planes[name] for one in past[-WINDOW:]]).astype(np.float32, copy=False)


def _layers(past: tuple[Past, ...], gsd_m: float) -> list[list[Float[Array, "y x"]]]:
    """Of bright and of dark: strength under the windows in this frame and the two before it."""
    windows = footprints(*FOOTPRINT_M, gsd_m)
    names = list(past[-1].planes)
    changes = [np.zeros(past[-1].planes[names[0]].shape, np.float32) for _ in range(3)]
    for name in names:
        median, spread = sliding_median.median_and_spread(_stack(past, name), least=3)
        slope2 = sliding_median.gradient2(median)
        floor = _least_step(past[-1].planes[name])
        for k in range(3):
            z = sliding_median.standardized(past[-1 - k].planes[name], median, spread, slope2, gsd_m, floor)
            changes[k] += np.clip(np.nan_to_num(z), -CAP, CAP) / math.sqrt(len(names))
    return [[window_means(sign * z, windows) for z in changes] for sign in (1, -1)]


def _least_step(values: Float[Array, "y x"]) -> float:
    """Standard deviation of rounding: a level's share of an image with few levels, none of a fine one."""
    known = values[np.isfinite(values)]
    if not len(known):
        return 1e-6
    low, high = np.quantile(known[::7], [0.01, 0.99])
    return float(max(high - low, 1e-6)) / 1000.0


def _candidates(layers: list[Float[Array, "y x"]], ages_s: list[float], gsd_m: float) -> Candidates:
    """Peaks of the first layer, and what the others say of them."""
    cell = peaks(layers[0], LEAST, APART_M, gsd_m)
    now = layers[0][tuple(cell.T)]
    step, wide = _steps(ages_s[0], gsd_m), 2 * max(1, round(0.5 * ages_s[1] / ages_s[0])) + 1
    weakest, best, still = np.zeros(len(cell)), np.zeros((len(cell), 2)), np.zeros(len(cell))
    before = maximum_filter(layers[2], size=wide)
    _follow(layers[1], before, layers[2], cell, now, step, ages_s[1] / ages_s[0], weakest, best, still)
    return Candidates(
        peak_places(np.maximum(layers[0], 0), cell, max(1, round(2 / gsd_m))), best / ages_s[0], weakest,
        now, still )  # fmt: skip


def _steps(interval_s: float, gsd_m: float) -> Int[Array, "step 2"]:
    """Rows and columns that a vehicle may have moved since the frame before."""
    reach = math.ceil(FASTEST_M_S * interval_s / gsd_m)
    row, column = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    speed = np.hypot(row, column) * gsd_m / interval_s
    held = (speed >= SLOWEST_M_S) & (speed <= FASTEST_M_S)
    step = np.stack([row[held], column[held]], axis=-1)
    return step[np.argsort(np.hypot(*step.T), kind="stable")]


@nb.njit(cache=True, nogil=True)
def _follow(last, before, here, cell, now, steps, share, weakest, best, still):
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
            a, b = last[r1, c1], before[r2, c2]
            least = min(now[p], min(a, b))
            total = least + 0.02 * (min(a, 2 * now[p]) + min(b, 2 * now[p]))
            if total > most:
                most = total
                weakest[p] = max(least, 0.0)
                best[p, 0], best[p, 1] = steps[s, 0], steps[s, 1]
        stood = 0.5 * (max(last[i, j], 0.0) + max(here[i, j], 0.0))
        still[p] = min(now[p], stood)


def _log_likelihood_ratio(found: Candidates) -> Float[Array, "peak"]:
    a, b, c, d = LAW
    return np.minimum(a + b * found.weakest + c * found.now + d * found.still, LARGEST_RATIO)


def _detections(grid: Grid, found: Candidates, ratio, times_s: tuple[float, ...], now: Past) -> Detections:
    """The likeliest candidates, one a vehicle, whether bright or dark."""
    most = max(1, round(MOST_PER_KM2 * grid.shape[0] * grid.shape[1] * grid.gsd_m**2 * 1e-6))
    order = np.argsort(-ratio, kind="stable")
    order = order[ratio[order] > LEAST_RATIO][:most]
    place, ratio = found.place[order], ratio[order]
    kept = np.ones(len(order), bool)
    near = (
        KDTree(place).query_pairs(APART_M / grid.gsd_m, output_type="ndarray")
        if len(place)
        else np.empty((0, 2), int)
    )
    near = np.sort(near, axis=1)
    for first, second in near[np.lexsort(near.T[::-1])]:
        kept[second] &= not kept[first]
    place, ratio, velocity = place[kept], ratio[kept], found.velocity[order][kept] * grid.gsd_m
    sigma2 = SIGMA_M**2 + (SIGMA_PX * grid.gsd_m) ** 2
    return Detections(
        np.stack(
            [grid.corner_m[0] + grid.gsd_m * place[:, 1], grid.corner_m[1] - grid.gsd_m * place[:, 0]], -1
        ),
        np.repeat(sigma2 * np.eye(2)[None], len(place), axis=0),
        np.full(len(place), math.sqrt(4 / math.pi * FOOTPRINT_M[0] * FOOTPRINT_M[1])),
        np.exp(ratio - DECISION),
        log_likelihood_ratio=ratio,
        velocity=np.stack([velocity[:, 1], -velocity[:, 0]], axis=-1),
        velocity_sigma_m_s=math.hypot(1.5, 0.5 * grid.gsd_m / max(now.time_s - times_s[-1], 1e-3)),
        earlier_s=times_s,
        detail=now,
    )
