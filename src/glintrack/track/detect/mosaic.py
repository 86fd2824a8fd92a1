"""The detector ``mosaic``: change in the raw elements, seen by a footprint, supported by a straight motion.

Per frame: every element is predicted from the past of its own kind (`mosaic_model`), its difference weighed
by what is usual there (`mosaic_noise`), averaged over windows of a vehicle's size on the ground
(`footprint`), and peaks of that are scored by what stood along their best straight motion in the frames
before (`straight_motion`). Weak detections go to the tracker with their log-likelihood ratio
(`mosaic_calibration`).
"""

import math
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from jaxtyping import Bool, Float

from glintrack.camera import Camera, Pose
from glintrack.core.arrays import Array
from glintrack.core.records import Mosaic
from glintrack.track.detect import mosaic_start
from glintrack.track.detect.design import DetectDesign
from glintrack.track.detect.detections import Detections, no_detections
from glintrack.track.detect.detector import Association
from glintrack.track.detect.footprint import footprints, greatest_around, window_means
from glintrack.track.detect.frame import Frame, Grid, grid_of
from glintrack.track.detect.mosaic_calibration import (
    HEIGHT_M,
    LEAST_RATIO,
    SIGMA_HEIGHT_M,
    SIGMA_M,
    log_likelihood_ratio,
    ratio_of_told,
)
from glintrack.track.detect.mosaic_geometry import seen_by
from glintrack.track.detect.mosaic_model import (
    COARSE,
    Ground,
    Prediction,
    bare_ground,
    predict,
    update_ground,
)
from glintrack.track.detect.mosaic_peaks import CAP, FASTEST_M_S, Peaks, find, no_peaks
from glintrack.track.detect.mosaic_statistic import evidence, kinds_of, strength
from glintrack.track.detect.samples import median

CELL_M = 0.75
WINDOW_M = (4.6, 2.6)
LAYERS, SPACING_S = 3, 0.45  # earlier frames that may support a peak, and time between them at least
RESTLESS_S, RESTLESS_MOST = 6.0, 2.0
WARM_UP, WARM_UP_S = 2, 0.75  # frames and time before the first detections
MASK_RATIO, MASK_REACH_M, MASK_S = 1.5, 3.0, 2.0
RIGHT_SHARE, SPEED_SIGMA_M_S = (
    0.7,
    2.0,
)  # of the best motions: how many are a vehicle's, and the error of those


@dataclass(frozen=True)
class Memory:
    """What the detector keeps between frames.

    Parameters
    ----------
    grid, layout
        Of the frames, which must not change.
    ground
        What was learnt.
    restless
        Mean of the windows' strength over the last seconds, each the greatest within a cell. [1]
    layers
        Time of earlier frames and that strength in them.
    masked
        Share of the last seconds for which each coarse cell of the ground was masked. [1]
    frames
        Seen so far.
    first
        The first of them, until the ground is made anew from what they agree on; None from then on.
    """

    grid: Grid
    layout: tuple[tuple[str | float, ...], ...]
    ground: Ground
    restless: Float[Array, "row column"]
    masked: Float[Array, "coarse_row coarse_column"]
    layers: tuple[tuple[float, Float[Array, "row column"]], ...] = ()
    frames: int = 0
    first: tuple[Frame, ...] | None = ()


@dataclass(frozen=True)
class Seen:
    """What one frame showed.

    Parameters
    ----------
    prediction
        What the elements should have read.
    layer
        Strength of the windows.
    peaks
        Of that, likely or not: what the law of their likelihood is fitted to.
    place_m, ratio
        Where each peak is seen on the ground, by the poses that were reported in the last seconds, and its
        log-likelihood ratio. [m, nat]
    """

    prediction: Prediction
    layer: Float[Array, "row column"]
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
    in_place
        Learn in the memory of the state that `update` is given, which is of no use afterwards.
    """

    design: DetectDesign
    in_place: bool = False

    def start(self, frame: Frame) -> Memory:
        """Nothing learnt yet.

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
        ground = bare_ground(grid, kinds_of(mosaic.layout, frame.channel), side)
        restless, masked = (np.zeros(n, np.float32) for n in (_cells(grid)[1], ground.differed_s.shape))
        return Memory(grid, mosaic.layout, ground, restless, masked)

    def detect(self, state: Memory, frame: Frame) -> Detections:
        """Windows of a vehicle's size that differ from what was learnt, along a straight motion.

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
        ground = state.ground
        seen = predict(ground, mosaic, camera, pose, frame.terrain, frame.time_s)
        corner, shape = _cells(state.grid)
        element = seen_by(camera, pose, frame.terrain, corner, CELL_M, shape, seen.moved_m)
        planes, offsets = strength(seen, mosaic, ground.places, frame.channel)
        change = evidence(planes, offsets, ground.side, element)
        means = window_means(change, footprints(*WINDOW_M, CELL_M))
        known = means[means > 0.02]
        usual = median(known)
        layer = np.clip(means - usual, 0.0, CAP)
        above = known[known > usual]
        spread = median(above) - usual if len(above) else 0.0
        if state.frames < WARM_UP or frame.time_s - (ground.first_s or 0.0) < WARM_UP_S:
            nothing = Seen(seen, layer, no_peaks(), np.empty((0, 2)), np.empty(0))
            return replace(no_detections(), log_likelihood_ratio=np.empty(0), detail=nothing)
        times_s, layers = zip(*_spaced(state.layers, frame.time_s), strict=True)
        past = np.stack(layers), frame.time_s - np.array(times_s), state.restless
        found = find(means, usual, spread, past, CELL_M)
        row, column = found.place.T
        on_map_m = np.stack([corner[0] + CELL_M * column, corner[1] - CELL_M * row], axis=-1)
        place_m = on_map_m - np.array(ground.shift_m)
        detail = Seen(seen, layer, found, place_m, log_likelihood_ratio(frame.channel, found.features))
        ground_m = 0.0 if frame.terrain is None else float(frame.terrain["height"].mean())
        east_m, north_m = (mean - now for mean, now in zip(ground.shift_m, seen.moved_m, strict=True))
        return _detections(frame.channel, pose, ground_m, detail, (east_m, north_m))

    def update(self, state: Memory, frame: Frame, detections: Detections, association: Association) -> Memory:
        """The ground after a frame; vehicles are not learnt, unless they have stood for long."""
        seen: Seen = detections.detail
        _, camera, _ = _raw_of(frame)
        mask = _mask(state.ground, seen.place_m[seen.ratio > MASK_RATIO] + np.array(state.ground.shift_m))
        learnt = mask & (state.masked < 1 - math.exp(-1))  # what is masked for long must be learnt after all
        first = None if state.first is None else mosaic_start.kept(state.first, frame)
        if first is not None and len(first) == mosaic_start.FRAMES:
            ground, first = mosaic_start.agreed(state.ground, first, self.in_place), None
        else:
            times_s = frame.time_s, frame.interval_s
            ground = update_ground(
                state.ground, seen.prediction, camera, learnt, *times_s, in_place=self.in_place
            )
        masked = state.masked + np.float32(-math.expm1(-frame.interval_s / MASK_S)) * (mask - state.masked)
        around = greatest_around(seen.layer)
        past = _spaced(state.layers, frame.time_s)
        oldest_s = past[-1][0] if len(past) == LAYERS else -math.inf  # what is older supports nothing
        layers = (*(one for one in state.layers if one[0] >= oldest_s), (frame.time_s, around))
        share = np.float32(-math.expm1(-frame.interval_s / RESTLESS_S)) if state.frames else np.float32(1.0)
        restless = state.restless + share * (np.minimum(around, RESTLESS_MOST) - state.restless)
        return replace(
            state, ground=ground, restless=restless, masked=masked, layers=layers, frames=state.frames + 1,
            first=first,
        )  # fmt: skip


def _spaced(layers: tuple, time_s: float) -> list[tuple[float, Float[Array, "row column"]]]:
    """The newest earlier frames that lie apart, newest first, as many as may support a peak."""
    out: list[tuple[float, Float[Array, "row column"]]] = []
    for then, layer in reversed(layers):
        if (out[-1][0] if out else time_s) - then >= SPACING_S and len(out) < LAYERS:
            out.append((then, layer))
    return out


def _raw_of(frame: Frame) -> tuple[Mosaic, Camera, Pose]:
    """Mosaic, camera and pose of a frame that has them."""
    for name in ("mosaic", "camera", "pose"):
        if getattr(frame, name) is None:
            raise ValueError(
                f"`frame.{name}` must be given for the detector 'mosaic', got none (rectified frames alone "
                "need 'background')"
            )
    return cast(Mosaic, frame.mosaic), cast(Camera, frame.camera), cast(Pose, frame.pose)


def _cells(grid: Grid) -> tuple[tuple[float, float], tuple[int, int]]:
    """First cell's centre and size of the grid of windows."""
    west, north = grid.corner_m[0] - grid.gsd_m / 2, grid.corner_m[1] + grid.gsd_m / 2
    rows, columns = (max(1, math.ceil(n * grid.gsd_m / CELL_M)) for n in grid.shape)
    return (west + CELL_M / 2, north - CELL_M / 2), (rows, columns)


def _mask(ground: Ground, position_m: Float[Array, "n 2"]) -> Bool[Array, "coarse_row coarse_column"]:
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
    channel: str, pose: Pose, ground_m: float, detail: Seen, displacement_m: tuple[float, float]
) -> Detections:
    """The likely peaks, the likeliest first, moved back by a vehicle's height along the line of sight."""
    kept = np.flatnonzero(detail.ratio > LEAST_RATIO)
    kept = kept[np.argsort(-detail.ratio[kept], kind="stable")]
    position, ratio = detail.place_m[kept], detail.ratio[kept]
    to_camera = pose.position[:2] - position
    slope = np.hypot(*to_camera.T) / max(pose.up_m - ground_m, 1.0)
    unit = to_camera / np.maximum(np.hypot(*to_camera.T), 1e-9)[:, None]
    outer = unit[:, :, None] * unit[:, None, :]
    covariance = SIGMA_M**2 * np.eye(2) + (SIGMA_HEIGHT_M * slope[:, None, None]) ** 2 * outer
    n = len(kept)
    return Detections(
        position + (HEIGHT_M * slope)[:, None] * unit,
        covariance.reshape(n, 2, 2),
        np.full(n, math.sqrt(4 / math.pi * WINDOW_M[0] * WINDOW_M[1])),
        np.exp(np.clip(ratio, -20, 20)),
        log_likelihood_ratio=ratio_of_told(channel, ratio),
        displacement_m=displacement_m,
        velocity=detail.peaks.velocity[kept],
        velocity_sigma_m_s=SPEED_SIGMA_M_S,
        velocity_share=RIGHT_SHARE,
        velocity_most_m_s=FASTEST_M_S,
        detail=detail,
    )
