"""The detector ``median-motion``: change against a sliding median, seen in three frames of a straight motion.

For rectified frames, without mosaic or pose. A frame is registered to the background (`registration`). Its
change against the median of a short window is counted in standard deviations that depend on gradient and
history (`sliding_median`), and averaged, bright and dark apart, over windows of a vehicle's footprint
(`footprint`). A place counts as much as the weakest of three frames shows along the best straight motion
through it, less what stood there in the two frames before (`straight_candidates`): parallax, flicker and
parked vehicles stand still. The last three frames are compared with the present median, so that the third
frame already shows what moved in the first. DoLP may be boosted before it is compared, as in the paper.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Float
from scipy.ndimage import maximum_filter

from glintrack.core.arrays import Array
from glintrack.track.detect import registration, sliding_median
from glintrack.track.detect.design import DetectDesign
from glintrack.track.detect.detections import Association, Detections, no_detections
from glintrack.track.detect.footprint import footprints, window_means
from glintrack.track.detect.frame import Frame, Grid, grid_of, plane
from glintrack.track.detect.straight_candidates import StraightCandidates, find_candidates, select_likeliest

FRAMES = 4  # in which a vehicle is searched along its way; three must show it
WINDOW = 6  # frames in a median: more include parallax, fewer a queue
SPACING_S = 0.35  # between frames that are remembered: at 25 Hz nothing moves from one to the next
FOOTPRINT_M = (4.6, 2.6)
CAP = 6.0  # standard deviations: a glint is no more vehicle than a car
BLANK_PX = 7  # a square of zeros of this side is no data
SIGMA_PX = 0.3  # of a place, beside the design's
DECISION_RATIO = 2.0  # at which a single detection is as often right as wrong, and its contrast 1
MAX_PER_KM2 = 4000.0

Planes = Mapping[str, Float[Array, "y x"]]


@dataclass(frozen=True)
class PlacedFrame:
    """An earlier frame, registered to the background.

    Parameters
    ----------
    times_s
        Time of the frame; several if a recorder wrote it more than once, of which one is right. [s]
    planes
        Moved and scaled onto the background.
    """

    times_s: tuple[float, ...]
    planes: Planes


@dataclass(frozen=True)
class MotionMemory:
    """State of the detector between frames: the grid, the latest frames, and the last one as it came."""

    grid: Grid
    past: tuple[PlacedFrame, ...] = ()
    seen: Planes | None = None


@dataclass(frozen=True)
class MedianMotionDetector:
    """Vehicles of either contrast that move straight through three rectified frames.

    Parameters
    ----------
    design
        Boost and threshold of DoLP, greatest speed, standard deviation of a place.
    """

    design: DetectDesign

    def start(self, frame: Frame) -> MotionMemory:
        """The state before the first frame."""
        return MotionMemory(grid_of(frame, None))

    def detect(self, state: MotionMemory, frame: Frame) -> Detections:
        """Vehicles that move straight through this frame and two before it; none in the first two frames.

        A frame that repeats the last one has none either.
        """
        grid = state.grid
        seen = {name: _plane_of(self.design, frame, name) for name in frame.planes}
        if _repeats_last(state, seen):
            last = state.past[-1]
            again = replace(last, times_s=(*last.times_s, frame.time_s))
            return _nothing(replace(state, past=(*state.past[:-1], again)))
        planes, displacement_m = _register(state, frame, seen)
        now = PlacedFrame((frame.time_s,), planes)
        past = (*state.past, now)[-WINDOW:]
        found = _nothing(_remember(state, now, seen))
        if len(past) < 3:
            return found
        layers = _layers(past, grid.gsd_m)
        ages_s = [_ages(one, frame.time_s) for one in past[-2:-5:-1]]
        speed = self.design.max_speed_m_s
        tried = ((ages, find_candidates(layers, ages, grid.gsd_m, speed)) for ages in product(*ages_s))
        ages, best = max(tried, key=lambda one: np.maximum(one[1].ratio, 0.0).sum())
        best = select_likeliest(best, _max_count(grid), grid.gsd_m)
        earlier_s = [t for one in past[-2:-5:-1] for t in one.times_s[::-1]][::-1]
        detections = _detections(grid, best, frame.time_s, ages, earlier_s, self.design.sigma_m)
        return replace(detections, displacement_m=displacement_m, detail=found.detail)

    def update(
        self, state: MotionMemory, frame: Frame, detections: Detections, association: Association
    ) -> MotionMemory:
        """The state after the frame; one that comes too soon after the last is not remembered."""
        return detections.detail


def _plane_of(design: DetectDesign, frame: Frame, name: str) -> Float[Array, "y x"]:
    """A plane of the frame; DoLP boosted and clipped to between the design's threshold and 1."""
    values = plane(frame, name)
    if name == "dolp":  # NaN stays NaN
        values = np.minimum(values * np.float32(design.dolp_boost), np.float32(1.0))
        values = np.maximum(values, np.float32(design.dolp_threshold))
    return values


def _repeats_last(state: MotionMemory, seen: Planes) -> bool:
    """Whether a frame repeats the last one, as some recorders write while they wait for the next."""
    last = state.seen
    return last is not None and all(np.array_equal(one, last[n], equal_nan=True) for n, one in seen.items())


def _ages(past: PlacedFrame, time_s: float) -> list[float]:
    """How long ago a frame may have been taken: one age, or two if it was written more than once. [s]"""
    first, last = (time_s - t for t in (past.times_s[0], past.times_s[-1]))
    return [first] if last == first or last < SPACING_S else [last, first]


def _nothing(memory: MotionMemory) -> Detections:
    """No detections, and the state after the frame."""
    return replace(no_detections(), log_likelihood_ratio=np.empty(0), detail=memory)


def _remember(state: MotionMemory, now: PlacedFrame, seen: Planes) -> MotionMemory:
    """The state with the frame, unless it comes too soon after the last that is remembered."""
    if state.past and now.times_s[0] - state.past[-1].times_s[0] < SPACING_S:
        return state
    return replace(state, past=(*state.past, now)[-WINDOW + 1 :], seen=seen)


def _register(
    state: MotionMemory, frame: Frame, seen: Planes
) -> tuple[dict[str, Float[Array, "y x"]], tuple[float, float]]:
    """The frame's planes moved and scaled onto the background, and its displacement east and north. [m]"""
    planes = {name: _with_blanks(one) for name, one in seen.items()}
    if not state.past:
        return planes, (0.0, 0.0)
    grid_of(frame, state.grid)
    background = {name: sliding_median.median_and_spread(_stack(state.past, name))[0] for name in planes}
    if "pan" in planes:
        gain, offset = registration.gain_between(planes["pan"], background["pan"])
        planes["pan"] = gain * planes["pan"] + np.float32(offset)
    first, gsd_m = next(iter(planes)), state.grid.gsd_m
    shift = registration.estimate_shifts(planes[first], background[first], gsd_m)
    down, right = shift.reshape(-1, 2).mean(axis=0)
    displacement_m = float(gsd_m * right), float(-gsd_m * down)
    return {name: registration.shift_image(one, shift) for name, one in planes.items()}, displacement_m


def _with_blanks(values: Float[Array, "y x"]) -> Float[Array, "y x"]:
    """The same with NaN where a square of zeros says that nothing was seen."""
    zero = values == 0
    if not zero.any():
        return values
    blank = maximum_filter(maximum_filter(~zero, BLANK_PX) == 0, BLANK_PX)
    return np.where(blank & zero, np.float32(np.nan), values)


def _stack(past: tuple[PlacedFrame, ...], name: str) -> Float[Array, "frame y x"]:
    """One plane of the frames in the median's window."""
    return np.stack([one.planes[name] for one in past[-WINDOW:]]).astype(np.float32, copy=False)


def _layers(past: tuple[PlacedFrame, ...], gsd_m: float) -> list[list[Float[Array, "y x"]]]:
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
    """Least standard deviation: of rounding, in an image of a few hundred levels. [unit of the image]"""
    known = values[np.isfinite(values)]
    if not len(known):
        return 1e-6
    low, high = np.quantile(known[::7], [0.01, 0.99])
    return float(max(high - low, 1e-6)) / 1000.0


def _max_count(grid: Grid) -> int:
    """Greatest number of detections in a frame."""
    return max(1, round(MAX_PER_KM2 * grid.shape[0] * grid.shape[1] * grid.gsd_m**2 * 1e-6))


def _detections(
    grid: Grid,
    found: StraightCandidates,
    time_s: float,
    ages_s: Sequence[float],
    earlier_s: list[float],
    sigma_m: float,
) -> Detections:
    """Candidates on the ground: where they are, and where they were at earlier times."""
    ratio, velocity = found.ratio, found.velocity * grid.gsd_m
    ages, sigma2 = np.array(ages_s), sigma_m**2 + (SIGMA_PX * grid.gsd_m) ** 2
    way = np.concatenate([found.place[:, None], found.before[:, : len(ages)]], axis=1)
    way = _at_ages(way, np.r_[0.0, ages], time_s - np.array(earlier_s))
    return Detections(
        _on_ground(grid, found.place),
        np.repeat(sigma2 * np.eye(2)[None], len(found), axis=0),
        np.full(len(found), math.sqrt(4 / math.pi * FOOTPRINT_M[0] * FOOTPRINT_M[1])),
        np.exp(ratio - DECISION_RATIO),
        log_likelihood_ratio=ratio,
        velocity=np.stack([velocity[:, 1], -velocity[:, 0]], axis=-1),
        velocity_sigma_m_s=math.hypot(1.5, 0.5 * grid.gsd_m / ages[0]),
        earlier_s=tuple(earlier_s),
        earlier=_on_ground(grid, way),
    )


def _on_ground(grid: Grid, place: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
    """East and north of places given by row and column. [m]"""
    return np.stack(
        [grid.corner_m[0] + grid.gsd_m * place[..., 1], grid.corner_m[1] - grid.gsd_m * place[..., 0]], -1
    )


def _at_ages(
    way: Float[Array, "peak frame 2"], ages_s: Float[Array, "frame"], wanted_s: Float[Array, "earlier"]
) -> Float[Array, "peak earlier 2"]:
    """Places at other ages, on the straight lines between those known and beyond."""
    k = np.clip(np.searchsorted(ages_s, wanted_s, side="left"), 1, len(ages_s) - 1)
    share = (wanted_s - ages_s[k - 1]) / (ages_s[k] - ages_s[k - 1])
    return way[:, k - 1] + share[:, None] * (way[:, k] - way[:, k - 1])
