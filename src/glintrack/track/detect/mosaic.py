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
from jaxtyping import Bool, Float, Int
from scipy.ndimage import maximum_filter

from glintrack.arrays import Array
from glintrack.camera import Camera, Pose
from glintrack.records import Mosaic
from glintrack.track.detect.design import DetectDesign
from glintrack.track.detect.detections import Detections, no_detections
from glintrack.track.detect.detector import Association
from glintrack.track.detect.footprint import footprints, peak_places, peaks, window_means
from glintrack.track.detect.frame import Frame, Grid, grid_of
from glintrack.track.detect.mosaic_calibration import log_likelihood_ratio
from glintrack.track.detect.mosaic_geometry import seen_by
from glintrack.track.detect.mosaic_model import Ground, Prediction, bare_ground, learn, predict
from glintrack.track.detect.mosaic_statistic import evidence, kinds_of, strength
from glintrack.track.detect.straight_motion import support, velocities

CELL_M = 0.75
WINDOW_M = (4.6, 2.6)
APART_M = 3.0  # of peaks: cars in a queue stand 6 m apart
CAP = 4.0  # of a window's strength: a glint shows no more vehicle than a car
LEAST = 0.25  # strength of a peak
LAYERS, SPACING_S = 3, 0.4  # earlier frames that may support a peak, and time between them at least
SLOWEST_M_S, FASTEST_M_S, STEP_M_S = 2.5, 22.0, 1.2
WARM_UP = 3  # frames before the first detections
MASK_SUPPORT, MASK_REACH, MASK_FRAMES, MASK_MOST = 2.2, 2, 3, 2
HEIGHT_M = 0.67  # of what is seen of a vehicle, in the mean: a passenger car's middle
SIGMA_M, SIGMA_HEIGHT_M = 0.6, 0.77  # across, and of that height: residuals of the calibration flights
LEAST_RATIO = 1.5  # of detections: with fewer, tracks are lost; with more, false ones come
MOST_PER_KM2 = 1000.0


@dataclass(frozen=True)
class Memory:
    """What the detector keeps between frames.

    Parameters
    ----------
    grid, layout
        Of the frames, which must not change.
    ground
        What was learnt.
    layers
        Time of earlier frames and the strength of their windows, each the greatest within a cell.
    masks
        Of the last frames.
    frames
        Seen so far.
    """

    grid: Grid
    layout: tuple[tuple[str | float, ...], ...]
    ground: Ground
    layers: tuple[tuple[float, Float[Array, "row column"]], ...] = ()
    masks: tuple[Bool[Array, "coarse_row coarse_column"], ...] = ()
    frames: int = 0


@dataclass(frozen=True)
class Peaks:
    """Peaks of the windows' strength, likely or not: what a law of their likelihood is fitted to.

    Parameters
    ----------
    place_m
        Where each is seen on the ground, east and north. [m]
    support, strength, still
        As of `mosaic_calibration.log_likelihood_ratio`. [1]
    """

    place_m: Float[Array, "peak 2"]
    support: Float[Array, "peak"]
    strength: Float[Array, "peak"]
    still: Float[Array, "peak"]


NO_PEAKS = Peaks(np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0))


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
        Where it peaks, and what speaks for a vehicle there.
    """

    prediction: Prediction
    layer: Float[Array, "row column"]
    peaks: Peaks


@dataclass(frozen=True)
class MosaicDetector:
    """Vehicles in raw mosaics with reported poses.

    Parameters
    ----------
    design
        Its channel is ``pan``, ``dolp`` or ``all``.
    """

    design: DetectDesign

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
        return Memory(grid, mosaic.layout, bare_ground(grid, kinds_of(mosaic.layout, frame.channel), side))

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
        means = window_means(evidence(planes, offsets, ground.side, element), footprints(*WINDOW_M, CELL_M))
        known = means[means > 0.02]
        usual = float(np.median(known)) if len(known) else 0.0
        layer = np.clip(means - usual, 0.0, CAP)
        if state.frames < WARM_UP:
            nothing = Seen(seen, layer, NO_PEAKS)
            return replace(no_detections(), log_likelihood_ratio=np.empty(0), detail=nothing)
        cells = peaks(means, usual + LEAST, APART_M, CELL_M)
        at = tuple(cells.T)
        best, _, still = _supported(state, frame.time_s, cells, layer[at])
        place = peak_places(layer, cells)
        position = np.stack([corner[0] + CELL_M * place[:, 1], corner[1] - CELL_M * place[:, 0]], axis=-1)
        found = Peaks(position, best, means[at] - usual, still)
        ratio = log_likelihood_ratio(frame.channel, found.support, found.strength, found.still)
        ground_m = 0.0 if frame.terrain is None else float(frame.terrain["height"].mean())
        return _detections(state.grid, pose, ground_m, position, ratio, Seen(seen, layer, found))

    def update(self, state: Memory, frame: Frame, detections: Detections, association: Association) -> Memory:
        """The ground after a frame; vehicles are not learnt, unless they have stood for long."""
        seen: Seen = detections.detail
        _, camera, _ = _raw_of(frame)
        mask = _mask(state.ground, seen.peaks.place_m[seen.peaks.support > MASK_SUPPORT])
        often = sum((one.astype(int) for one in state.masks), np.zeros(mask.shape, int)) >= MASK_MOST
        ground = learn(state.ground, seen.prediction, camera, mask & ~often, frame.time_s, frame.interval_s)
        layers = state.layers
        if not layers or frame.time_s - layers[-1][0] >= SPACING_S:
            layers = (*layers, (frame.time_s, maximum_filter(seen.layer, size=3)))[-LAYERS:]
        masks = (*state.masks, mask)[-MASK_FRAMES:]
        return replace(state, ground=ground, layers=layers, masks=masks, frames=state.frames + 1)


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


def _supported(state: Memory, time_s: float, cells: Int[Array, "peak 2"], now: Float[Array, "peak"]):
    """Mean strength along the best motion, that motion, and the mean at a standstill."""
    layers = np.stack([layer for _, layer in state.layers])
    ages = np.array([time_s - then for then, _ in state.layers])
    return support(layers, ages, cells, now, velocities(SLOWEST_M_S, FASTEST_M_S, STEP_M_S), CELL_M)


def _mask(ground: Ground, position_m: Float[Array, "n 2"]) -> Bool[Array, "coarse_row coarse_column"]:
    rows, columns = ground.runs.shape
    mask = np.zeros((rows, columns), np.bool_)
    cell = ground.coarse_cells(position_m)
    reach = np.arange(-MASK_REACH, MASK_REACH + 1)
    for i in reach:
        for j in reach:
            if i * i + j * j <= MASK_REACH**2 + 1:
                row, column = cell[:, 0] + i, cell[:, 1] + j
                inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
                mask[row[inside], column[inside]] = True
    return mask


def _detections(grid: Grid, pose: Pose, ground_m: float, position, ratio, detail: Seen) -> Detections:
    """The likeliest of the peaks, moved back by a vehicle's height along the line of sight."""
    area_km2 = grid.shape[0] * grid.shape[1] * grid.gsd_m**2 * 1e-6
    most = max(1, round(MOST_PER_KM2 * area_km2))
    kept = np.flatnonzero(ratio > LEAST_RATIO)
    kept = kept[np.argsort(-ratio[kept], kind="stable")][:most]
    position, ratio = position[kept], ratio[kept]
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
        log_likelihood_ratio=ratio,
        displacement_m=(-detail.prediction.moved_m[0], -detail.prediction.moved_m[1]),
        detail=detail,
    )
