"""The detector ``mosaic``: change of raw elements in windows of a vehicle's size, along a straight motion.

Elements that are too fine are averaged (`binning`). In every frame each element is predicted from the past of
its own kind (`mosaic_model`). The squared difference over its variance is averaged over windows on the ground
(`footprint`). Its peaks are scored by the evidence along their best straight motion (`mosaic_peaks`), in
``all`` also by the signs around them (`mosaic_windows`). Weak detections go on with their likelihood ratio.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation, maximum_filter

from glintrack.core.arrays import Array
from glintrack.track.calibration import read_calibration
from glintrack.track.design import WARM_UP, WARM_UP_S, DetectDesign
from glintrack.track.detect.binning import bin_frame, frame_binning
from glintrack.track.detect.detections import Association, Detections, no_detections
from glintrack.track.detect.footprint import footprints, window_means
from glintrack.track.detect.frame import Frame, Grid, grid_of
from glintrack.track.detect.mosaic_model import (
    COARSE,
    SCALE_START,
    SOFT,
    ElementPrediction,
    Ground,
    elements_of_cells,
    empty_ground,
    predict,
    raw_of,
    update_ground,
)
from glintrack.track.detect.mosaic_peaks import (
    CAP,
    SEARCHES,
    PastStrength,
    Peaks,
    detection_ratio,
    element_change,
    find_peaks,
    log_likelihood_ratio,
    no_peaks,
    select_elements,
    select_peaks,
)
from glintrack.track.detect.mosaic_windows import evidence_on_ground, window_features
from glintrack.track.detect.standing import hold_s, is_occupied, select_standing, standing_ratio

CELL_M = 0.75
EXTENT_M = 3.9  # diameter of a detection
SPACING_S = 0.45  # minimum time between earlier frames that count: a car has then left its place
LAYERS = 3  # earlier frames that may support a peak
FIRST_FRAMES = 4  # from which the ground map is rebuilt
RESTLESS_S, MAX_RESTLESS = 6.0, 2.0
MIN_SHARE = 1e-6  # of confirmation: without it all readings have equal weights
MASK_RATIO, MASK_REACH_M, MASK_S = 1.5, 3.0, 2.0
FULL_SHARE = 1 - math.exp(-1)  # that a mask has after its time
RIGHT_SHARE = 0.7  # share of the best motions that are a vehicle's own
SPEED_SIGMA_M_S = 2.0  # standard deviation of those
CORRELATION_S = 0.5  # in which a vehicle shows the same side and covers the same ground, and errors last


@dataclass(frozen=True)
class StrengthLayer:
    """Strength of the windows in an earlier frame, each the greatest within a cell. [1]"""

    time_s: float
    strength: Float[Array, "row column"]


@dataclass(frozen=True)
class MosaicMemory:
    """State of the detector between frames.

    Parameters
    ----------
    grid, layout
        Grid and superpixel of the frames, which must not change.
    ground
        Map of the ground.
    restless
        Mean strength of the windows over the last seconds, each the greatest within a cell. [1]
    masked
        Share of the last seconds for which each coarse cell of the ground was masked. [1]
    held
        The same for cells below a vehicle that is slow or stands. [1]
    layers
        Strength in earlier frames, the oldest first.
    factor
        Elements along a binned one.
    frames
        Number of frames processed.
    first
        The first of them, until the ground is rebuilt from them; None from then on.
    """

    grid: Grid
    layout: tuple[tuple[str | float, ...], ...]
    ground: Ground
    restless: Float[Array, "row column"]
    masked: Float[Array, "coarse_row coarse_column"]
    held: Float[Array, "coarse_row coarse_column"]
    factor: int
    layers: tuple[StrengthLayer, ...] = ()
    frames: int = 0
    first: tuple[Frame, ...] | None = ()


@dataclass(frozen=True)
class SearchedMosaic:
    """Search of one frame, with all peaks.

    Parameters
    ----------
    prediction
        Predicted readings.
    strength
        Strength of the windows. [1]
    peaks
        Its peaks, to which the likelihood model is fitted.
    place_m, ratio
        Position of each peak on the ground, by the poses reported in the last seconds, and its log-likelihood
        ratio. [m, nat]
    moving_ratio
        The same by motion alone. [nat]
    occupied_m
        Places of slow tracks at which there is a vehicle. [m]
    """

    prediction: ElementPrediction
    strength: Float[Array, "row column"]
    peaks: Peaks
    place_m: Float[Array, "peak 2"]
    ratio: Float[Array, "peak"]
    moving_ratio: Float[Array, "peak"]
    occupied_m: Float[Array, "slow 2"]


@dataclass(frozen=True)
class MosaicDetector:
    """Detect vehicles in raw mosaics with reported poses.

    Parameters
    ----------
    design
        Channel ``pan``, ``dolp`` or ``all``, and greatest speed.
    """

    design: DetectDesign

    def start(self, frame: Frame) -> MosaicMemory:
        """Return the state before the first frame.

        Raises
        ------
        ValueError
            If the frame lacks mosaic, camera or pose, or its layout lacks the channel's elements.
        """
        mosaic, camera, _ = raw_of(frame)
        side = len(mosaic.layout)
        if mosaic.electrons.shape != (camera.rows, camera.columns):
            raise ValueError(
                f"`mosaic` must have the camera's {camera.rows} × {camera.columns} elements; "
                f"got {mosaic.electrons.shape[0]} × {mosaic.electrons.shape[1]}."
            )
        grid = grid_of(frame, None)
        ground = empty_ground(grid, select_elements(mosaic.layout, frame.channel), side)
        restless, masked = (np.zeros(n, np.float32) for n in (_window_grid(grid)[1], ground.differed_s.shape))
        factor = frame_binning(frame)
        return MosaicMemory(
            grid, mosaic.layout, ground, restless=restless, masked=masked, held=masked, factor=factor
        )

    def detect(self, state: MosaicMemory, frame: Frame) -> Detections:
        """Detect windows of a vehicle's size that differ from the ground map, along a straight motion.

        Raises
        ------
        ValueError
            If the frame lacks mosaic, camera or pose, or its mosaic is of another layout than the first.
        """
        mosaic, camera, _ = raw_of(frame)
        if mosaic.layout != state.layout or mosaic.electrons.shape != (camera.rows, camera.columns):
            raise ValueError(
                f"`mosaic` must keep the first frame's layout {state.layout} and the camera's "
                f"{camera.rows} × {camera.columns} elements; got {mosaic.layout} and "
                f"{mosaic.electrons.shape[0]} × {mosaic.electrons.shape[1]}."
            )
        ground = state.ground
        channel = frame.channel if len(ground.places) > 1 else "pan"  # one kind has no joint statistic
        frame = replace(bin_frame(frame, state.factor), channel=channel)
        mosaic, seen = raw_of(frame)[0], predict(ground, frame)
        corner, shape = _window_grid(state.grid)
        element = elements_of_cells(frame, corner, CELL_M, shape, seen.moved_m)
        planes, offsets = element_change(seen, mosaic, ground.places, channel)
        change = evidence_on_ground(planes, offsets, ground.side, element)
        means = window_means(change, footprints(*SEARCHES[channel].window_m, CELL_M))
        known = means[means > 0.02]
        usual = float(np.median(known)) if len(known) else 0.0
        strength = np.clip(means - usual, 0.0, CAP)
        above = known[known > usual]
        spread = float(np.median(above)) - usual if len(above) else 0.0
        if state.frames < WARM_UP or frame.time_s - (ground.first_s or 0.0) < WARM_UP_S:
            nowhere, never = np.empty((0, 2)), np.empty(0)
            nothing = SearchedMosaic(
                seen, strength, no_peaks(channel), place_m=nowhere, ratio=never, moving_ratio=never,
                occupied_m=nowhere,
            )  # fmt: skip
            return replace(no_detections(), log_likelihood_ratio=np.empty(0), detail=nothing)
        layers = _supporting_layers(state.layers, frame.time_s)
        strengths, times_s = zip(*((layer.strength, layer.time_s) for layer in layers), strict=True)
        past = PastStrength(np.stack(strengths), frame.time_s - np.array(times_s), state.restless)
        speed_m_s = self.design.max_speed_m_s
        found = find_peaks(means, usual, spread, past, SEARCHES[channel], CELL_M, speed_m_s)
        if channel == "all":
            signed = window_features(found.cells, change, seen, (offsets, ground.side, CELL_M), element)
            found = replace(found, features=np.hstack([found.features, signed]))
        place_m = np.array(corner) + CELL_M * found.place[:, ::-1] * (1, -1) - np.array(ground.shift_m)
        moving_ratio = log_likelihood_ratio(channel, found.features)
        slow_m = frame.slow_m - _toward_camera(frame, frame.slow_m)
        kinds = ground.places, ground.side, seen.readings
        occupied = is_occupied(slow_m + np.array(ground.shift_m), corner, CELL_M, element, kinds)
        ratio, moving_ratio = standing_ratio(moving_ratio, found.features[:, 1], place_m, slow_m, occupied)
        east_m, north_m = (mean - now for mean, now in zip(ground.shift_m, seen.moved_m, strict=True))
        searched = SearchedMosaic(
            seen, strength, found, place_m=place_m, ratio=ratio, moving_ratio=moving_ratio,
            occupied_m=slow_m[occupied],
        )  # fmt: skip
        detections = _detections(searched, frame, (east_m, north_m))
        return replace(detections, velocity_most_m_s=speed_m_s)

    def update(
        self, state: MosaicMemory, frame: Frame, detections: Detections, association: Association
    ) -> MosaicMemory:
        """Update the state with a frame; vehicles are masked for a short time, slow ones for longer."""
        seen: SearchedMosaic = detections.detail
        mask = _mask(state.ground, seen.place_m[seen.ratio > MASK_RATIO] + np.array(state.ground.shift_m))
        hidden = mask & (state.masked < FULL_SHARE)
        slow = _mask(state.ground, seen.occupied_m + np.array(state.ground.shift_m))
        held = _follow(state.held, slow, frame.interval_s, hold_s())
        keep = slow & (held < FULL_SHARE)
        first = state.first
        if first is not None and not (first and frame.time_s - first[-1].time_s < SPACING_S):
            binned = bin_frame(frame, state.factor)
            first = (*first, replace(binned, image=None, surface=None))  # without the large parts
        if first is not None and len(first) == FIRST_FRAMES:
            ground, first = _ground_of_first_frames(state.ground, first), None
        else:
            times_s = frame.time_s, frame.interval_s
            ground = update_ground(state.ground, seen.prediction, hidden | keep, *times_s, held=keep)
        masked = _follow(state.masked, mask, frame.interval_s, MASK_S)
        around = maximum_filter(seen.strength, 3)
        past = _supporting_layers(state.layers, frame.time_s)
        oldest_s = past[-1].time_s if len(past) == LAYERS else -math.inf  # older layers support nothing
        layers = (
            *(layer for layer in state.layers if layer.time_s >= oldest_s),
            StrengthLayer(frame.time_s, around),
        )
        interval_s = frame.interval_s if state.frames else math.inf
        restless = _follow(state.restless, np.minimum(around, MAX_RESTLESS), interval_s, RESTLESS_S)
        return replace(
            state, ground=ground, restless=restless, masked=masked, held=held, layers=layers,
            frames=state.frames + 1, first=first,
        )  # fmt: skip


def _follow(mean: Array, now: Array, interval_s: float, time_s: float) -> Array:
    """Exponential mean over a time, after an interval."""
    return mean + np.float32(-math.expm1(-interval_s / time_s)) * (now - mean)


def _supporting_layers(layers: tuple[StrengthLayer, ...], time_s: float) -> list[StrengthLayer]:
    """Select the newest earlier frames that are `SPACING_S` apart, newest first, at most `LAYERS`."""
    out: list[StrengthLayer] = []
    for layer in reversed(layers):
        if (out[-1].time_s if out else time_s) - layer.time_s >= SPACING_S and len(out) < LAYERS:
            out.append(layer)
    return out


def _window_grid(grid: Grid) -> tuple[tuple[float, float], tuple[int, int]]:
    """Centre of the first cell, and shape, of the grid of windows."""
    west, north = grid.corner_m[0] - grid.gsd_m / 2, grid.corner_m[1] + grid.gsd_m / 2
    rows, columns = (max(1, math.ceil(n * grid.gsd_m / CELL_M)) for n in grid.shape)
    return (west + CELL_M / 2, north - CELL_M / 2), (rows, columns)


def _mask(ground: Ground, position_m: Float[Array, "n 2"]) -> Bool[Array, "coarse_row coarse_column"]:
    """Coarse cells within `MASK_REACH_M` of positions."""
    mask, reach = np.zeros(ground.differed_s.shape, np.bool_), round(MASK_REACH_M / (COARSE * CELL_M))
    mask[tuple(ground.cells_of(position_m).T)] = True
    i, j = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return binary_dilation(mask, i * i + j * j <= reach**2 + 1)


def _ground_of_first_frames(ground: Ground, frames: tuple[Frame, ...]) -> Ground:
    """Rebuild the map from the first frames of a flight, for the area and kinds of elements of a ground.

    The map takes all of the first frame, with its vehicles, and little of later differences. In dense
    traffic, where other vehicles follow before a place is free, it would contain vehicles for half a minute.
    So each of the first frames is predicted from every other alone, and the map is rebuilt from them: each
    reading has the weight of the share of the others that confirm it, over the greatest such share in its
    coarse cell.
    """
    votes: list[list[tuple[Float[Array, "row column"], ...]]] = [[] for _ in frames]
    cells = []
    empty = replace(
        ground, maps=tuple(np.zeros_like(one) for one in ground.maps),
        scales=tuple(np.full_like(one, SCALE_START) for one in ground.scales),
        differed_s=np.zeros_like(ground.differed_s), since_s=None, first_s=None, shift_m=(0.0, 0.0),
    )  # fmt: skip
    for j, other in enumerate(frames):
        seen = predict(empty, other)
        cells.append(_cells_of_elements(ground, seen))
        alone = _add_frame(empty, other, seen, 0.0)
        for i, frame in enumerate(frames):
            if i != j:
                votes[i].append(predict(alone, frame).z2)
    shares: list[list[Float[Array, "row column"]]] = [[] for _ in frames]
    for of_frame, share in zip(votes, shares, strict=True):
        for z2 in map(np.stack, zip(*of_frame, strict=True)):
            known = np.isfinite(z2)
            agrees = np.where(known, 1 / (1 + np.where(known, z2, 0) / SOFT) ** 2, 0)
            mean = agrees.sum(axis=0) / np.maximum(known.sum(axis=0), 1)
            share.append(np.where(known.any(axis=0), mean, 1).astype(np.float32))
    best = [np.zeros(ground.differed_s.shape, np.float32) for _ in ground.places]
    for share, cell in zip(shares, cells, strict=True):
        for k, most in enumerate(best):
            np.maximum.at(most.reshape(-1), cell[k], share[k])
    out, before_s = empty, frames[0].time_s
    for frame, share, cell in zip(frames, shares, cells, strict=True):
        weight = tuple(
            np.square(one / np.maximum(most.reshape(-1)[at], MIN_SHARE))
            for one, most, at in zip(share, best, cell, strict=True)
        )
        out = _add_frame(out, frame, predict(out, frame), frame.time_s - before_s, weight)
        before_s = frame.time_s
    return out


def _cells_of_elements(ground: Ground, seen: ElementPrediction) -> list[Int[Array, "row column"]]:
    """Index of the coarse cell of each element of each kind, limited to the map."""
    rows, columns = ground.differed_s.shape
    out = []
    for i, j in ground.places:
        own = slice(i, None, ground.side), slice(j, None, ground.side)
        y, x = (np.floor((np.nan_to_num(at[own]) + 0.5) / COARSE) for at in (seen.y, seen.x))
        row, column = np.clip(y, 0, rows - 1).astype(np.int32), np.clip(x, 0, columns - 1).astype(np.int32)
        out.append(row * np.int32(columns) + column)
    return out


def _add_frame(
    ground: Ground, frame: Frame, seen: ElementPrediction, interval_s: float, weight=None
) -> Ground:
    """Add a frame to the ground."""
    masked = np.zeros(ground.differed_s.shape, np.bool_)
    return update_ground(ground, seen, masked, frame.time_s, interval_s, weight)


def _detections(searched: SearchedMosaic, frame: Frame, displacement_m: tuple[float, float]) -> Detections:
    """Likely peaks by falling ratio, moved back by a vehicle's height along the line of sight."""
    by_motion = select_peaks(searched.place_m, searched.peaks.velocity, searched.moving_ratio, frame.channel)
    standing = select_standing(searched.ratio, searched.place_m, searched.occupied_m, by_motion)
    likely = np.concatenate([by_motion, standing])
    position, ratio = searched.place_m[likely], searched.ratio[likely]
    known = read_calibration("mosaic").constants["place"][frame.channel]
    slope = _slope(frame, position)
    outer = slope[:, :, None] * slope[:, None, :]
    covariance = known["sigma_m"] ** 2 * np.eye(2) + known["height_sigma_m"] ** 2 * outer
    n = len(likely)
    return Detections(
        position + _toward_camera(frame, position), covariance.reshape(n, 2, 2),
        np.full(n, EXTENT_M), np.exp(np.clip(ratio, -20, 20)),
        log_likelihood_ratio=detection_ratio(frame.channel, ratio), displacement_m=displacement_m,
        velocity=searched.peaks.velocity[likely], velocity_sigma_m_s=SPEED_SIGMA_M_S,
        velocity_share=RIGHT_SHARE, correlation_s=CORRELATION_S, detail=searched,
    )  # fmt: skip


def _slope(frame: Frame, place_m: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
    """East and north toward the camera, over the height in which they are covered. [1]"""
    pose = raw_of(frame)[2]
    return (pose.position[:2] - place_m) / max(pose.up_m - frame.mean_height_m, 1.0)


def _toward_camera(frame: Frame, place_m: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
    """From a place on the ground to the vehicle whose centre appears there, east and north. [m]"""
    return read_calibration("mosaic").constants["place"][frame.channel]["height_m"] * _slope(frame, place_m)
