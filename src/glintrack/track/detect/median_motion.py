"""The detector ``median-motion``: change against a sliding median, seen in three frames of a straight motion.

For rectified frames, without mosaic or pose. A frame is registered to the background (`registration`). Its
change against the median of a short window is divided by a standard deviation that depends on gradient and
history (`sliding_median`), and averaged over windows of a vehicle's footprint (`footprint`), bright and dark
changes apart. The strength of a candidate is the weakest of three frames along its best straight motion, less
the strength at rest in the two frames before (`straight_candidates`): parallax, flicker and parked vehicles
do not move. The last three frames are compared with the present median, so that the third frame already
detects vehicles that moved in the first. DoLP may be boosted before it is compared, as in the paper.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np
from jaxtyping import Float
from scipy.ndimage import maximum_filter, minimum_filter

from glintrack.core.arrays import Array
from glintrack.io.times import MAX_STEP_S
from glintrack.track.calibration import read_calibration
from glintrack.track.design import MEDIAN_SPACING_S, DetectDesign
from glintrack.track.detect import registration, sliding_median
from glintrack.track.detect.detections import Association, Detections, no_detections
from glintrack.track.detect.footprint import Windows, footprints, local_quantile, window_means
from glintrack.track.detect.frame import Frame, Grid, grid_of, plane
from glintrack.track.detect.straight_candidates import StraightCandidates, find_candidates, select_candidates

FRAMES = 4  # in which a vehicle is searched along its motion; three must contain it
WINDOW = 6  # frames in a median: more include parallax, fewer a queue
FOOTPRINT_M = (4.6, 2.6)
CAP = 6.0  # standard deviations: a glint counts as much as a car
CLUTTER_M, CLUTTER_PX = 40.0, 40  # least side of the tiles in which the strength of clutter is taken
CLUTTER_QUANTILE = 0.75
CLUTTER_MARGIN = 1.1  # of the strength of independent noise, up to which nothing is scaled
KERNEL_PX = 2  # half width of the cubic kernel
AREA_PX = 3  # side of the least area of no data
BLANK_PX = 7  # a square of zeros of this side is no data
SIGMA_PX = 0.3  # standard deviation of a position, added to the design's
DECISION_RATIO = 2.0  # at which a single detection is as often right as wrong, and its contrast 1
MAX_PER_KM2 = 4000.0

Planes = Mapping[str, Float[Array, "y x"]]


@dataclass(frozen=True)
class PlacedFrame:
    """An earlier frame, registered to the background.

    Parameters
    ----------
    times_s
        Time of the frame; several if a recorder wrote it more than once, one of which is right. [s]
    planes
        Planes, shifted and scaled to the background.
    """

    times_s: tuple[float, ...]
    planes: Planes


@dataclass(frozen=True)
class MotionMemory:
    """State of the detector between frames: the grid, the latest frames, and the last one unprocessed."""

    grid: Grid
    past: tuple[PlacedFrame, ...] = ()
    seen: Planes | None = None


@dataclass(frozen=True)
class MedianMotionDetector:
    """Detect vehicles of either contrast that move straight through three rectified frames.

    Parameters
    ----------
    design
        Boost and threshold of DoLP, greatest speed, standard deviation of a position.
    """

    design: DetectDesign

    def start(self, frame: Frame) -> MotionMemory:
        """Return the state before the first frame."""
        return MotionMemory(grid_of(frame, None))

    def detect(self, state: MotionMemory, frame: Frame) -> Detections:
        """Detect vehicles that move straight through this frame and two before it.

        There are none before two frames that are `MEDIAN_SPACING_S` apart are stored, also after a pause, nor
        in a frame that repeats the last one.
        """
        if state.past and frame.time_s - state.past[-1].times_s[-1] > MAX_STEP_S:
            state = MotionMemory(state.grid)
        grid, last = state.grid, state.seen
        seen = {name: _read_plane(self.design, frame, name) for name in frame.planes}
        if last is not None and all(np.array_equal(one, last[n], equal_nan=True) for n, one in seen.items()):
            again = replace(state.past[-1], times_s=(*state.past[-1].times_s, frame.time_s))
            return _nothing(replace(state, past=(*state.past[:-1], again)))
        planes, displacement_m = _register(state, frame, seen)
        now = PlacedFrame((frame.time_s,), planes)
        past, memory = (*state.past, now)[-WINDOW:], state
        if not state.past or frame.time_s - state.past[-1].times_s[0] >= MEDIAN_SPACING_S:
            memory = replace(state, past=past[-WINDOW + 1 :], seen=seen)
        found = _nothing(memory)
        if len(past) < 3:
            return found
        layers = _strength_layers(past, grid.gsd_m)
        ages_s = [_possible_ages(one, frame.time_s) for one in past[-2:-5:-1]]
        speed = self.design.max_speed_m_s
        tried = ((ages, find_candidates(layers, ages, grid.gsd_m, speed)) for ages in product(*ages_s))
        ages, best = max(tried, key=lambda one: np.maximum(one[1].ratio, 0.0).sum())
        max_count = max(1, round(MAX_PER_KM2 * grid.shape[0] * grid.shape[1] * grid.gsd_m**2 * 1e-6))
        best = select_candidates(best, max_count, grid.gsd_m)
        earlier_s = [t for one in past[-2:-5:-1] for t in one.times_s[::-1]][::-1]
        detections = _detections(grid, best, frame.time_s, ages, earlier_s, self.design.sigma_m)
        return replace(detections, displacement_m=displacement_m, detail=found.detail)

    def update(
        self, state: MotionMemory, frame: Frame, detections: Detections, association: Association
    ) -> MotionMemory:
        """Return the state after the frame, which `detect` has made."""
        return detections.detail


def _read_plane(design: DetectDesign, frame: Frame, name: str) -> Float[Array, "y x"]:
    """Read a plane of the frame; DoLP is boosted and clipped between the design's threshold and 1."""
    values = plane(frame, name)
    if name == "dolp":  # NaN stays NaN
        values = np.minimum(values * np.float32(design.dolp_boost), np.float32(1.0))
        values = np.maximum(values, np.float32(design.dolp_threshold))
    return values


def _possible_ages(past: PlacedFrame, time_s: float) -> list[float]:
    """Possible ages of a frame: one, or two if it was written more than once. [s]"""
    first, last = (time_s - t for t in (past.times_s[0], past.times_s[-1]))
    return [first] if last == first or last < MEDIAN_SPACING_S else [last, first]


def _nothing(memory: MotionMemory) -> Detections:
    """Return no detections, with the state after the frame."""
    return replace(no_detections(), log_likelihood_ratio=np.empty(0), detail=memory)


def _register(
    state: MotionMemory, frame: Frame, seen: Planes
) -> tuple[dict[str, Float[Array, "y x"]], tuple[float, float]]:
    """Shift and scale the frame's planes to the background; with its displacement east and north. [m]"""
    planes = {name: _mask_blanks(one) for name, one in seen.items()}
    if not state.past:
        return planes, (0.0, 0.0)
    grid_of(frame, state.grid)
    background = {
        name: sliding_median.median_and_spread(_stack_window(state.past, name))[0] for name in planes
    }
    if "pan" in planes:
        gain, offset = registration.gain_between(planes["pan"], background["pan"])
        planes["pan"] = gain * planes["pan"] + np.float32(offset)
    first, gsd_m = next(iter(planes)), state.grid.gsd_m
    shift = registration.estimate_shifts(planes[first], background[first], gsd_m)
    down, right = shift.reshape(-1, 2).mean(axis=0)
    displacement_m = float(gsd_m * right), float(-gsd_m * down)
    return {name: registration.shift_image(one, shift) for name, one in planes.items()}, displacement_m


def _mask_blanks(values: Float[Array, "y x"]) -> Float[Array, "y x"]:
    """Set squares of zeros, which are missing data, and pixels resampled from areas of no data to NaN.

    Single missing pixels, such as those of a dark mirror, are no area: they spoil no neighbour.
    """
    zero, missing = values == 0, np.isnan(values)
    if zero.any():
        missing |= zero & maximum_filter(maximum_filter(~zero, BLANK_PX) == 0, BLANK_PX)
    if not missing.any():
        return values
    areas = minimum_filter(missing, AREA_PX)
    beside = maximum_filter(areas, AREA_PX + 2 * KERNEL_PX)
    return np.where(missing | beside, np.float32(np.nan), values)


def _stack_window(past: tuple[PlacedFrame, ...], name: str) -> Float[Array, "frame y x"]:
    """Stack one plane of the frames in the median's window."""
    return np.stack([one.planes[name] for one in past[-WINDOW:]]).astype(np.float32, copy=False)


def _strength_layers(past: tuple[PlacedFrame, ...], gsd_m: float) -> list[list[Float[Array, "y x"]]]:
    """Strength of bright and of dark changes under the windows, in this frame and two or three before."""
    windows, names = footprints(*FOOTPRINT_M, gsd_m), list(past[-1].planes)
    count = min(len(past), FRAMES)
    changes = [np.zeros(past[-1].planes[names[0]].shape, np.float32) for _ in range(count)]
    for name in names:
        standardized = standardize_frames(past, name, gsd_m, count)
        scale = _clutter_scale(standardized[0], windows, gsd_m)
        for k, z in enumerate(standardized):
            changes[k] += np.clip(np.nan_to_num(z) / scale, -CAP, CAP) / math.sqrt(len(names))
    return [[window_means(sign * z, windows) for z in changes] for sign in (1, -1)]


def _clutter_scale(change: Float[Array, "y x"], windows: Windows, gsd_m: float) -> Float[Array, "y x"]:
    """Local ratio, at least 1, of the strength under windows to that of independent noise (CFAR). [1]

    Blocks of a compressed image, foliage and parallax change many pixels together, so that a mean over a
    footprint fluctuates more than the noise of a pixel tells. Vehicles cover too little of a tile to count.
    """
    bounded = np.clip(np.nan_to_num(change), -CAP, CAP)
    strength, side = _strength(bounded, windows), max(round(CLUTTER_M / gsd_m), CLUTTER_PX)
    usual = local_quantile(strength, np.isfinite(change), CLUTTER_QUANTILE, side)
    # the models of the evidence expect at most the noise of the coarsest pixels that they were chosen for
    coarsest_m = max(read_calibration("median_motion").valid["gsd_m"])
    expected = min(_noise_strength(gsd_m), _noise_strength(coarsest_m))
    return np.maximum(usual / (CLUTTER_MARGIN * expected), 1.0).astype(np.float32)


def _strength(change: Float[Array, "y x"], windows: Windows) -> Float[Array, "y x"]:
    """Mean change under the best window about each pixel, bright or dark. [σ]"""
    return np.maximum(window_means(change, windows), window_means(-change, windows))


@cache
def _noise_strength(gsd_m: float) -> float:
    """Quantile of the strength under windows in noise of independent pixels, by simulation. [σ]"""
    noise = np.random.default_rng(0).standard_normal((256, 256)).astype(np.float32)
    return float(np.quantile(_strength(noise, footprints(*FOOTPRINT_M, gsd_m)), CLUTTER_QUANTILE))


def standardize_frames(
    past: tuple[PlacedFrame, ...], name: str, gsd_m: float, count: int = 1
) -> list[Float[Array, "y x"]]:
    """Change of the last frames against the median of all, the latest first; NaN without data. [1]

    Parameters
    ----------
    past
        Registered frames, the latest last.
    name
        Plane that is compared.
    gsd_m
        Side of a pixel. [m]
    count
        Number of frames.
    """
    median, spread = sliding_median.median_and_spread(_stack_window(past, name), least=3)
    slope2 = sliding_median.gradient2(median)
    floor = _min_step(past[-1].planes[name])
    planes = [past[-1 - k].planes[name] for k in range(count)]
    return [sliding_median.standardize_change(one, median, spread, slope2, gsd_m, floor) for one in planes]


def _min_step(values: Float[Array, "y x"]) -> float:
    """Minimum standard deviation, of rounding in an image of a few hundred levels. [unit of the image]"""
    known = values[np.isfinite(values)]
    if not len(known):
        return 1e-6
    low, high = np.quantile(known[::7], [0.01, 0.99])
    return float(max(high - low, 1e-6)) / 1000.0


def _detections(
    grid: Grid,
    found: StraightCandidates,
    time_s: float,
    ages_s: Sequence[float],
    earlier_s: list[float],
    sigma_m: float,
) -> Detections:
    """Convert candidates to positions on the ground, now and at earlier times."""
    ratio, velocity = found.ratio, found.velocity * grid.gsd_m
    origin_m, per_pixel_m = np.array(grid.corner_m), grid.gsd_m * np.array([1, -1])
    ages, sigma2 = np.array(ages_s), sigma_m**2 + (SIGMA_PX * grid.gsd_m) ** 2
    way = np.concatenate([found.place[:, None], found.before[:, : len(ages)]], axis=1)
    # positions at other ages are on the straight lines between the known ones and beyond
    known_s, wanted_s = np.r_[0.0, ages], time_s - np.array(earlier_s)
    k = np.clip(np.searchsorted(known_s, wanted_s, side="left"), 1, len(known_s) - 1)
    share = (wanted_s - known_s[k - 1]) / (known_s[k] - known_s[k - 1])
    way = way[:, k - 1] + share[:, None] * (way[:, k] - way[:, k - 1])
    return Detections(
        origin_m + per_pixel_m * found.place[:, ::-1],
        np.repeat(sigma2 * np.eye(2)[None], len(found), axis=0),
        np.full(len(found), math.sqrt(4 / math.pi * FOOTPRINT_M[0] * FOOTPRINT_M[1])),
        np.exp(ratio - DECISION_RATIO), log_likelihood_ratio=ratio,
        velocity=np.stack([velocity[:, 1], -velocity[:, 0]], axis=-1),
        velocity_sigma_m_s=math.hypot(1.5, 0.5 * grid.gsd_m / ages[0]), earlier_s=tuple(earlier_s),
        earlier=origin_m + per_pixel_m * way[..., ::-1],
    )  # fmt: skip
