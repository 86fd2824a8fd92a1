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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Float
from scipy.ndimage import maximum_filter

from glintrack.core.arrays import Array
from glintrack.track.detect import local_registration as registration
from glintrack.track.detect import sliding_median
from glintrack.track.detect.design import DetectDesign
from glintrack.track.detect.detections import Detections, no_detections
from glintrack.track.detect.detector import Association
from glintrack.track.detect.footprint import footprints, window_means
from glintrack.track.detect.frame import Frame, Grid, grid_of, plane
from glintrack.track.detect.straight_candidates import Candidates, candidates, likeliest

FRAMES = 4  # in which a vehicle is looked for along its way; three must show it
WINDOW = 6  # frames in a median: more hold parallax, fewer a queue
SPACING_S = 0.35  # between frames that are remembered: at 25 Hz nothing moves from one to the next
FOOTPRINT_M = (4.6, 2.6)
CAP = 6.0  # standard deviations: a glint is no more vehicle than a car
BLANK = 7  # pixels: so large a square of zeros is no data
SIGMA_M, SIGMA_PX = 0.6, 0.3  # of a place
DECISION = 2.0  # ratio at which a detection alone is as often right as wrong, and its contrast 1
MOST_PER_KM2 = 4000.0

Planes = Mapping[str, Float[Array, "y x"]]


@dataclass(frozen=True)
class Past:
    """A frame that is remembered.

    Parameters
    ----------
    times_s
        When; and when again, if a recorder wrote it more than once: it shows one of these times. [s]
    planes
        Moved and scaled onto the background.
    """

    times_s: tuple[float, ...]
    planes: Planes


@dataclass(frozen=True)
class Memory:
    """What the detector keeps between frames: the grid, the latest frames, and the last one as it came."""

    grid: Grid
    past: tuple[Past, ...] = ()
    seen: Planes | None = None


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
        """What moves straight through this frame and two before it; nothing in the first two.

        Nor in a frame that is the last one once more.
        """
        seen = {name: plane(frame, name) for name in frame.planes}
        if _again(state, seen):
            last = state.past[-1]
            again = replace(last, times_s=(*last.times_s, frame.time_s))
            return _nothing(replace(state, past=(*state.past[:-1], again)))
        now = Past((frame.time_s,), _placed(state, frame, seen))
        past = (*state.past, now)[-WINDOW:]
        found = _nothing(_remembered(state, now, seen))
        if len(past) < 3:
            return found
        layers = _layers(past, state.grid.gsd_m)
        ages_s = [_ages(one, frame.time_s) for one in past[-2:-5:-1]]
        tried = ((ages, candidates(layers, ages, state.grid.gsd_m)) for ages in product(*ages_s))
        ages, best = max(tried, key=lambda one: np.maximum(one[1].ratio, 0.0).sum())
        best = likeliest(best, _most(state.grid), state.grid.gsd_m)
        earlier_s = [t for one in past[-2:-5:-1] for t in one.times_s[::-1]][::-1]
        return _detections(state.grid, best, frame.time_s, ages, earlier_s, found)

    def update(self, state: Memory, frame: Frame, detections: Detections, association: Association) -> Memory:
        """The latest frames; one that comes too soon after the last is not remembered."""
        return detections.detail


def _again(state: Memory, seen: Planes) -> bool:
    """Whether a frame is the last one once more, as recorders write that wait for the next."""
    last = state.seen
    return last is not None and all(np.array_equal(one, last[n], equal_nan=True) for n, one in seen.items())


def _ages(past: Past, time_s: float) -> list[float]:
    """How long ago a frame may have been taken: one age, or two if it was written more than once. [s]"""
    first, last = (time_s - t for t in (past.times_s[0], past.times_s[-1]))
    return [first] if last == first or last < SPACING_S else [last, first]


def _nothing(memory: Memory) -> Detections:
    """No detections, and what is remembered after the frame."""
    return replace(no_detections(), log_likelihood_ratio=np.empty(0), detail=memory)


def _remembered(state: Memory, now: Past, seen: Planes) -> Memory:
    """With the frame, unless it comes too soon after the last that is remembered."""
    if state.past and now.times_s[0] - state.past[-1].times_s[0] < SPACING_S:
        return state
    return replace(state, past=(*state.past, now)[-WINDOW + 1 :], seen=seen)


def _placed(state: Memory, frame: Frame, seen: Planes) -> dict[str, Float[Array, "y x"]]:
    """The frame's planes, moved and scaled onto the background; as they are in the first."""
    planes = {name: _with_blanks(one) for name, one in seen.items()}
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
    """Of bright and of dark: strength under the windows in this frame and the two or three before it."""
    windows = footprints(*FOOTPRINT_M, gsd_m)
    names = list(past[-1].planes)
    count = min(len(past), FRAMES)
    changes = [np.zeros(past[-1].planes[names[0]].shape, np.float32) for _ in range(count)]
    for name in names:
        median, spread = sliding_median.median_and_spread(_stack(past, name), least=3)
        slope2 = sliding_median.gradient2(median)
        floor = _least_step(past[-1].planes[name])
        for k in range(count):
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


def _most(grid: Grid) -> int:
    return max(1, round(MOST_PER_KM2 * grid.shape[0] * grid.shape[1] * grid.gsd_m**2 * 1e-6))


def _detections(
    grid: Grid, found: Candidates, time_s: float, ages_s: Sequence[float], earlier_s: list[float],
    none: Detections,
) -> Detections:  # fmt: skip
    """Candidates on the ground: where they are, and where they were at earlier times."""
    ratio, velocity = found.ratio, found.velocity * grid.gsd_m
    ages, sigma2 = np.array(ages_s), SIGMA_M**2 + (SIGMA_PX * grid.gsd_m) ** 2
    way = np.concatenate([found.place[:, None], found.before[:, : len(ages)]], axis=1)
    way = _at(way, np.r_[0.0, ages], time_s - np.array(earlier_s))
    return Detections(
        _on_ground(grid, found.place),
        np.repeat(sigma2 * np.eye(2)[None], len(found), axis=0),
        np.full(len(found), math.sqrt(4 / math.pi * FOOTPRINT_M[0] * FOOTPRINT_M[1])),
        np.exp(ratio - DECISION),
        log_likelihood_ratio=ratio,
        velocity=np.stack([velocity[:, 1], -velocity[:, 0]], axis=-1),
        velocity_sigma_m_s=math.hypot(1.5, 0.5 * grid.gsd_m / ages[0]),
        earlier_s=tuple(earlier_s),
        earlier=_on_ground(grid, way),
        detail=none.detail,
    )


def _on_ground(grid: Grid, place: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
    return np.stack(
        [grid.corner_m[0] + grid.gsd_m * place[..., 1], grid.corner_m[1] - grid.gsd_m * place[..., 0]], -1
    )


def _at(
    way: Float[Array, "peak frame 2"], ages_s: Float[Array, "frame"], wanted_s: Float[Array, "earlier"]
) -> Float[Array, "peak earlier 2"]:
    """Places at other ages, on the straight lines between those known and beyond."""
    k = np.clip(np.searchsorted(ages_s, wanted_s, side="left"), 1, len(ages_s) - 1)
    share = (wanted_s - ages_s[k - 1]) / (ages_s[k] - ages_s[k - 1])
    return way[:, k - 1] + share[:, None] * (way[:, k] - way[:, k - 1])
