"""The detector ``mosaic``: change of raw elements in windows of a vehicle's size, along a straight motion.

Per frame, every element is predicted from the past of its own kind (`mosaic_model`). The squared difference
over its usual size is averaged over windows of a vehicle's size on the ground (`footprint`). Peaks of that
are scored by what was seen along their best straight motion in the frames before (`mosaic_peaks`). Weak
detections go to the tracker with their log-likelihood ratio.
"""

import math
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from jaxtyping import Bool, Float

from glintrack.camera import Camera, Pose
from glintrack.core.arrays import Array
from glintrack.core.records import Mosaic
from glintrack.track.calibration import read_calibration
from glintrack.track.detect import mosaic_start
from glintrack.track.detect.design import DetectDesign
from glintrack.track.detect.detections import Association, Detections, no_detections
from glintrack.track.detect.footprint import footprints, greatest_around, window_means
from glintrack.track.detect.frame import Frame, Grid, grid_of
from glintrack.track.detect.mosaic_model import (
    COARSE,
    ElementPrediction,
    Ground,
    bare_ground,
    predict,
    seen_by,
    update_ground,
)
from glintrack.track.detect.mosaic_peaks import (
    CAP,
    MIN_RATIO,
    PastStrength,
    Peaks,
    element_change,
    evidence_on_ground,
    find_peaks,
    log_likelihood_ratio,
    no_peaks,
    ratio_of_detections,
    searched_elements,
)

CELL_M = 0.75
WINDOW_M = (4.6, 2.6)
LAYERS, SPACING_S = 3, 0.45  # earlier frames that may support a peak, and least time between them
RESTLESS_S, MAX_RESTLESS = 6.0, 2.0
WARM_UP, WARM_UP_S = 2, 0.75  # frames and time before the first detections
MASK_RATIO, MASK_REACH_M, MASK_S = 1.5, 3.0, 2.0
RIGHT_SHARE = 0.7  # of the best motions are a vehicle's own
SPEED_SIGMA_M_S = 2.0  # of those


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
        Of the frames, which must not change.
    ground
        Map of the ground.
    restless
        Mean of the windows' strength over the last seconds, each the greatest within a cell. [1]
    masked
        Share of the last seconds for which each coarse cell of the ground was masked. [1]
    layers
        Strength in earlier frames, the oldest first.
    frames
        Number of frames seen.
    first
        The first of them, until the ground is made anew from what they agree on; None from then on.
    """

    grid: Grid
    layout: tuple[tuple[str | float, ...], ...]
    ground: Ground
    restless: Float[Array, "row column"]
    masked: Float[Array, "coarse_row coarse_column"]
    layers: tuple[StrengthLayer, ...] = ()
    frames: int = 0
    first: tuple[Frame, ...] | None = ()


@dataclass(frozen=True)
class SearchedMosaic:
    """What the detector found in one frame, likely or not.

    Parameters
    ----------
    prediction
        Readings that were expected.
    strength
        Of the windows. [1]
    peaks
        Of that; the likelihood model is fitted to them.
    place_m, ratio
        Where each peak is seen on the ground, by the poses reported in the last seconds, and its
        log-likelihood ratio. [m, nat]
    """

    prediction: ElementPrediction
    strength: Float[Array, "row column"]
    peaks: Peaks
    place_m: Float[Array, "peak 2"]
    ratio: Float[Array, "peak"]


@dataclass(frozen=True)
class MosaicDetector:
    """Vehicles in raw mosaics with reported poses.

    Parameters
    ----------
    design
        Its channel is ``pan``, ``dolp`` or ``all``.
    """

    design: DetectDesign

    def start(self, frame: Frame) -> MosaicMemory:
        """The state before the first frame.

        Raises
        ------
        ValueError
            If the frame lacks mosaic, camera or pose, or its layout lacks the channel's elements.
        """
        mosaic, camera, _ = _raw_of(frame)
        side = len(mosaic.layout)
        if mosaic.electrons.shape != (camera.rows, camera.columns):
            raise ValueError(
                f"`mosaic` must have the camera's {camera.rows} × {camera.columns} elements, "
                f"got {mosaic.electrons.shape[0]} × {mosaic.electrons.shape[1]}"
            )
        grid = grid_of(frame, None)
        ground = bare_ground(grid, searched_elements(mosaic.layout, frame.channel), side)
        restless, masked = (np.zeros(n, np.float32) for n in (_cells(grid)[1], ground.differed_s.shape))
        return MosaicMemory(grid, mosaic.layout, ground, restless, masked)

    def detect(self, state: MosaicMemory, frame: Frame) -> Detections:
        """Windows of a vehicle's size that differ from the ground map, along a straight motion.

        Raises
        ------
        ValueError
            If the frame lacks mosaic, camera or pose, or its mosaic is of another layout than the first.
        """
        mosaic, camera, pose = _raw_of(frame)
        if mosaic.layout != state.layout or mosaic.electrons.shape != (camera.rows, camera.columns):
            raise ValueError(
                f"`mosaic` must keep the first frame's layout {state.layout} and the camera's "
                f"{camera.rows} × {camera.columns} elements, got {mosaic.layout} and "
                f"{mosaic.electrons.shape[0]} × {mosaic.electrons.shape[1]}"
            )
        ground, channel = state.ground, frame.channel
        seen = predict(ground, mosaic, camera, pose, frame.terrain, frame.time_s)
        corner, shape = _cells(state.grid)
        element = seen_by(camera, pose, frame.terrain, corner, CELL_M, shape, seen.moved_m)
        planes, offsets = element_change(seen, mosaic, ground.places, channel)
        change = evidence_on_ground(planes, offsets, ground.side, element)
        means = window_means(change, footprints(*WINDOW_M, CELL_M))
        known = means[means > 0.02]
        usual = _median(known)
        strength = np.clip(means - usual, 0.0, CAP)
        above = known[known > usual]
        spread = _median(above) - usual if len(above) else 0.0
        if state.frames < WARM_UP or frame.time_s - (ground.first_s or 0.0) < WARM_UP_S:
            nothing = SearchedMosaic(seen, strength, no_peaks(), np.empty((0, 2)), np.empty(0))
            return replace(no_detections(), log_likelihood_ratio=np.empty(0), detail=nothing)
        layers = _supporting(state.layers, frame.time_s)
        past = PastStrength(
            np.stack([layer.strength for layer in layers]),
            frame.time_s - np.array([layer.time_s for layer in layers]),
            state.restless,
        )
        found = find_peaks(means, usual, spread, past, CELL_M, self.design.max_speed_m_s)
        row, column = found.place.T
        on_map_m = np.stack([corner[0] + CELL_M * column, corner[1] - CELL_M * row], axis=-1)
        place_m = on_map_m - np.array(ground.shift_m)
        ratio = log_likelihood_ratio(channel, found.features)
        east_m, north_m = (mean - now for mean, now in zip(ground.shift_m, seen.moved_m, strict=True))
        detections = _detections(
            SearchedMosaic(seen, strength, found, place_m, ratio), channel, pose, frame, (east_m, north_m)
        )
        return replace(detections, velocity_most_m_s=self.design.max_speed_m_s)

    def update(
        self, state: MosaicMemory, frame: Frame, detections: Detections, association: Association
    ) -> MosaicMemory:
        """The state after a frame; vehicles are not learnt, unless they have stood for long."""
        seen: SearchedMosaic = detections.detail
        _, camera, _ = _raw_of(frame)
        mask = _mask(state.ground, seen.place_m[seen.ratio > MASK_RATIO] + np.array(state.ground.shift_m))
        learnt = mask & (state.masked < 1 - math.exp(-1))  # what is masked for long must be learnt after all
        first = None if state.first is None else mosaic_start.kept(state.first, frame)
        if first is not None and len(first) == mosaic_start.FRAMES:
            ground, first = mosaic_start.agreed(state.ground, first), None
        else:
            ground = update_ground(
                state.ground, seen.prediction, camera, learnt, frame.time_s, frame.interval_s
            )
        masked = state.masked + np.float32(-math.expm1(-frame.interval_s / MASK_S)) * (mask - state.masked)
        around = greatest_around(seen.strength)
        past = _supporting(state.layers, frame.time_s)
        oldest_s = past[-1].time_s if len(past) == LAYERS else -math.inf  # what is older supports nothing
        layers = (
            *(layer for layer in state.layers if layer.time_s >= oldest_s),
            StrengthLayer(frame.time_s, around),
        )
        share = np.float32(-math.expm1(-frame.interval_s / RESTLESS_S)) if state.frames else np.float32(1.0)
        restless = state.restless + share * (np.minimum(around, MAX_RESTLESS) - state.restless)
        return replace(
            state, ground=ground, restless=restless, masked=masked, layers=layers, frames=state.frames + 1,
            first=first,
        )  # fmt: skip


def _median(values: Float[Array, "n"]) -> float:
    """Median, 0 of no values at all."""
    return float(np.median(values)) if len(values) else 0.0


def _supporting(layers: tuple[StrengthLayer, ...], time_s: float) -> list[StrengthLayer]:
    """The newest earlier frames that are `SPACING_S` apart, newest first, as many as may support a peak."""
    out: list[StrengthLayer] = []
    for layer in reversed(layers):
        if (out[-1].time_s if out else time_s) - layer.time_s >= SPACING_S and len(out) < LAYERS:
            out.append(layer)
    return out


def _raw_of(frame: Frame) -> tuple[Mosaic, Camera, Pose]:
    """Mosaic, camera and pose of a frame that has them."""
    for name in ("mosaic", "camera", "pose"):
        if getattr(frame, name) is None:
            raise ValueError(
                f"`frame.{name}` must be given for the detector 'mosaic', got none (rectified frames alone "
                "need 'median-motion')"
            )
    return cast(Mosaic, frame.mosaic), cast(Camera, frame.camera), cast(Pose, frame.pose)


def _cells(grid: Grid) -> tuple[tuple[float, float], tuple[int, int]]:
    """First cell's centre and size of the grid of windows."""
    west, north = grid.corner_m[0] - grid.gsd_m / 2, grid.corner_m[1] + grid.gsd_m / 2
    rows, columns = (max(1, math.ceil(n * grid.gsd_m / CELL_M)) for n in grid.shape)
    return (west + CELL_M / 2, north - CELL_M / 2), (rows, columns)


def _mask(ground: Ground, position_m: Float[Array, "n 2"]) -> Bool[Array, "coarse_row coarse_column"]:
    """Coarse cells within `MASK_REACH_M` of places."""
    rows, columns = ground.differed_s.shape
    mask = np.zeros((rows, columns), np.bool_)
    cell = ground.coarse_cells(position_m)
    reach = round(MASK_REACH_M / (COARSE * CELL_M))
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            if i * i + j * j <= reach**2 + 1:
                row, column = cell[:, 0] + i, cell[:, 1] + j
                inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
                mask[row[inside], column[inside]] = True
    return mask


def _detections(
    searched: SearchedMosaic, channel: str, pose: Pose, frame: Frame, displacement_m: tuple[float, float]
) -> Detections:
    """The likely peaks, the likeliest first, moved back by a vehicle's height along the line of sight."""
    kept = np.flatnonzero(searched.ratio > MIN_RATIO)
    kept = kept[np.argsort(-searched.ratio[kept], kind="stable")]
    position, ratio = searched.place_m[kept], searched.ratio[kept]
    known = read_calibration("mosaic").constants
    ground_m = 0.0 if frame.terrain is None else float(frame.terrain["height"].mean())
    to_camera = pose.position[:2] - position
    slope = np.hypot(*to_camera.T) / max(pose.up_m - ground_m, 1.0)
    unit = to_camera / np.maximum(np.hypot(*to_camera.T), 1e-9)[:, None]
    outer = unit[:, :, None] * unit[:, None, :]
    covariance = (
        known["sigma_m"] ** 2 * np.eye(2) + (known["height_sigma_m"] * slope[:, None, None]) ** 2 * outer
    )
    n = len(kept)
    return Detections(
        position + (known["height_m"] * slope)[:, None] * unit,
        covariance.reshape(n, 2, 2),
        np.full(n, math.sqrt(4 / math.pi * WINDOW_M[0] * WINDOW_M[1])),
        np.exp(np.clip(ratio, -20, 20)),
        log_likelihood_ratio=ratio_of_detections(channel, ratio),
        displacement_m=displacement_m,
        velocity=searched.peaks.velocity[kept],
        velocity_sigma_m_s=SPEED_SIGMA_M_S,
        velocity_share=RIGHT_SHARE,
        detail=searched,
    )
