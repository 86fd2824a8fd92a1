"""Predict the reading of every raw element from a recursive map of the ground for each kind of element.

Readings are added to the map at their ground points, from the reported poses and one shift per frame. In the
next frame they are predicted at the elements' new ground points, each kind from its own past. A mosaic
therefore needs no demosaicking, and the different positions of the polarizers cause no change. Work and
memory are linear in elements and cells.

Ground points are exact on a lattice of nodes, through the camera with its lens and the reported pose, and
linear between. Heights are the terrain's: objects on it appear displaced, and are mapped as they appear.
"""

import math
from dataclasses import dataclass, replace
from typing import cast

import numba as nb
import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int

from glintrack.camera import Camera, Pose, ground_points, project
from glintrack.core.arrays import Array
from glintrack.core.interpolation import height_at
from glintrack.core.parallel import map_threads, over_rows
from glintrack.core.records import Mosaic
from glintrack.track.detect import mosaic_kernels as kernels
from glintrack.track.detect.frame import Frame, Grid

CELL_M = 0.75
COARSE = 2  # cells along a coarse cell, which has about one element of a kind in a frame
MARGIN_M = 10.0
REACH = 1.9  # radius of the kernel of a reading, in element pitches
MEMORY_S = 3.0
MIN_WEIGHT = 0.6  # sum of weights of a cell that predicts
RIDGE = 0.025  # regularization of the slopes. [m²]
SCALE_S, SCALE_QUANTILE, SCALE_START, MIN_SCALE = 3.0, 0.7, 3.0, 0.3
SCALE_SHARE = 0.6  # time constant at first, as a share of the time since the first frame
MAX_PER_CELL = 4.5  # elements of a kind in a coarse cell that count one by one: as in the calibration
PARTS = np.array([0.8, 0.1, 0.5])  # of scale, spread and leverage in a residual's variance
SOFT, HEAL_LIMIT, HEAL_S, HEALING = 16.0, 9.0, 1.4, 0.7
SHIFT_SOFT, SHIFT_STEPS, SHIFT_ROWS, SHIFT_DONE_M, ANCHOR_S = 4.0, 2, 4, 0.05, 3.0
_RENEW = 1e4  # weights grow with time by this much before they are scaled back
NODE = 16  # elements or cells between nodes: perspective bends by less than a hundredth of an element between
_HEIGHT_STEPS = 4  # iterations of a node's height at the ground point of its ray


@dataclass(frozen=True)
class Ground:
    """Map of the ground for each kind of element.

    Parameters
    ----------
    places
        Row and column in the superpixel of each kind of element.
    side
        Elements along a superpixel.
    corner_m
        East and north of the first cell's centre. [m]
    maps, scales
        Map and scale of residuals of each kind; see `mosaic_kernels`.
    differed_s
        Time for which each coarse cell has differed in every frame. [s]
    since_s, first_s
        Time at which weights were one, and time of the first frame. [s]
    shift_m
        Mean of the last shifts from registration, east and north. [m]
    """

    places: tuple[tuple[int, int], ...]
    side: int
    corner_m: tuple[float, float]
    maps: tuple[Float[Array, "row column 11"], ...]
    scales: tuple[Float[Array, "coarse_row coarse_column"], ...]
    differed_s: Float[Array, "coarse_row coarse_column"]
    since_s: float | None = None
    first_s: float | None = None
    shift_m: tuple[float, float] = (0.0, 0.0)

    def cells_of(self, position_m: Float[Array, "n 2"]) -> Int[Array, "n 2"]:
        """Row and column of the coarse cell of each point, limited to the map."""
        x = (position_m[:, 0] - self.corner_m[0]) / CELL_M
        y = (self.corner_m[1] - position_m[:, 1]) / CELL_M
        cell = np.floor((np.stack([y, x], axis=-1) + 0.5) / COARSE).astype(int)
        return np.clip(cell, 0, np.array(self.differed_s.shape) - 1)


@dataclass(frozen=True)
class ElementPrediction:
    """Readings of a mosaic and their prediction.

    Parameters
    ----------
    readings, var, z2
        Readings of each kind of element, variance of their difference from the prediction, and its square
        over that; NaN without a prediction. [e, e², 1]
    fitted, noise
        Fit of the prediction (`mosaic_kernels.predict_readings`), and variance of the sensor's noise.
    x, y
        Map coordinates of all elements. [cell]
    moved_m
        East and north shift from registration. [m]
    """

    readings: tuple[Float[Array, "row column"], ...]
    fitted: tuple[Float[Array, "row column 5"], ...]
    noise: tuple[Float[Array, "row column"], ...]
    var: tuple[Float[Array, "row column"], ...]
    z2: tuple[Float[Array, "row column"], ...]
    x: Float[Array, "row column"]
    y: Float[Array, "row column"]
    moved_m: tuple[float, float]


def empty_ground(grid: Grid, places: tuple[tuple[int, int], ...], side: int) -> Ground:
    """Build an empty map of an area and the margin around it."""
    west, north = grid.corner_m[0] - grid.gsd_m / 2 - MARGIN_M, grid.corner_m[1] + grid.gsd_m / 2 + MARGIN_M
    shape = tuple(math.ceil((n * grid.gsd_m + 2 * MARGIN_M) / CELL_M) for n in grid.shape)
    coarse = tuple(math.ceil(n / COARSE) + 1 for n in shape)
    return Ground(
        places=places, side=side, corner_m=(west + CELL_M / 2, north - CELL_M / 2),
        maps=tuple(np.zeros((*shape, kernels.TERMS), np.float32) for _ in places),
        scales=tuple(np.full(coarse, SCALE_START, np.float32) for _ in places),
        differed_s=np.zeros(coarse, np.float32),
    )  # fmt: skip


def raw_of(frame: Frame) -> tuple[Mosaic, Camera, Pose]:
    """Return mosaic, camera and pose of a frame, or raise a ValueError if one is missing."""
    for name in ("mosaic", "camera", "pose"):
        if getattr(frame, name) is None:
            raise ValueError(
                f"`frame.{name}` must be given for the detector 'mosaic'; got none. Rectified frames alone "
                "need 'median-motion'."
            )
    return cast(Mosaic, frame.mosaic), cast(Camera, frame.camera), cast(Pose, frame.pose)


def predict(ground: Ground, frame: Frame) -> ElementPrediction:
    """Register a frame to the map and predict the reading of every element."""
    mosaic, time_s = raw_of(frame)[0], frame.time_s
    x, y = element_places(frame, ground.corner_m, CELL_M)
    cut = [_elements_of_kind(ground, k) for k in range(len(ground.places))]
    readings = tuple(np.ascontiguousarray(mosaic.electrons[one], np.float32) for one in cut)
    variance = tuple(np.square(np.ascontiguousarray(mosaic.sigma_e[one], np.float32)) for one in cut)
    moved = np.zeros(2)
    gain = 1.0 if ground.since_s is None else math.exp((time_s - ground.since_s) / MEMORY_S)
    for _ in range(SHIFT_STEPS):
        some, some_variance = (
            tuple(np.ascontiguousarray(a[::SHIFT_ROWS]) for a in of) for of in (readings, variance)
        )
        fitted, var, _ = _predict_kinds(ground, some, some_variance, x, y, gain, SHIFT_ROWS)
        step = _shift(some, fitted, var)
        moved += step
        x, y = x + np.float32(step[0]), y + np.float32(step[1])
        if math.hypot(*step) * CELL_M < SHIFT_DONE_M:
            break
    fitted, var, z2 = _predict_kinds(ground, readings, variance, x, y, gain)
    moved_m = float(moved[0]) * CELL_M, -float(moved[1]) * CELL_M
    return ElementPrediction(
        readings=readings, fitted=fitted, noise=variance, var=var, z2=z2, x=x, y=y, moved_m=moved_m
    )


def update_ground(
    ground: Ground,
    seen: ElementPrediction,
    masked: Bool[Array, "coarse_row coarse_column"],
    time_s: float,
    interval_s: float,
    weight: tuple[Float[Array, "row column"], ...] | None = None,
    held: Bool[Array, "coarse_row coarse_column"] | None = None,
) -> Ground:
    """Update the map with a frame.

    Parameters
    ----------
    ground, seen
        Map before the frame, and the frame's prediction from it.
    masked
        Coarse cells that are not updated: vehicles.
    time_s, interval_s
        Epoch, and time since the frame before. [s]
    weight
        Weight of each reading of each kind; by default it follows from ``masked`` and the residuals. [1]
    held
        Coarse cells whose weights do not fall with time; by default none.
    """
    changed = np.zeros(ground.differed_s.shape, np.bool_)
    for z2, at in zip(seen.z2, _places_by_kind(ground, seen.x, seen.y), strict=True):
        kernels.flag(z2, *at, 1 / COARSE, HEAL_LIMIT, changed)
    differed_s = np.where(changed, ground.differed_s + np.float32(interval_s), 0)
    since_s = time_s if ground.since_s is None else ground.since_s
    gain = math.exp((time_s - since_s) / MEMORY_S)
    renew = gain if gain > _RENEW else 1.0
    gain, since_s = (1.0, time_s) if renew > 1 else (gain, since_s)
    # roofs and crowns are registered too: they move against the flight and would take the map with them, so
    # the mean shift is drawn back
    part = -math.expm1(-interval_s / ANCHOR_S)
    east, north = (a + part * (b - a) for a, b in zip(ground.shift_m, seen.moved_m, strict=True))
    back = part / CELL_M
    x, y = seen.x - np.float32(back * east), seen.y + np.float32(back * north)
    metric, reach = _kernel(x, y)
    first_s = time_s if ground.first_s is None else ground.first_s
    scale_s = min(SCALE_S, max(SCALE_SHARE * (time_s - first_s), 1e-3))  # shorter at first
    step = 4 * -math.expm1(-max(interval_s, 1e-3) / scale_s) / _scale_divisor(metric, ground.side)
    rates = math.exp(step * SCALE_QUANTILE), math.exp(step * (SCALE_QUANTILE - 1)), MIN_SCALE

    def one(k: int):
        own = _elements_of_kind(ground, k)
        at = np.ascontiguousarray(x[own]), np.ascontiguousarray(y[own])
        if weight is None:
            share = np.empty(seen.readings[k].shape, np.float32)
            kernels.update_weight(
                seen.z2[k], *at, 1 / COARSE, differed_s, masked, SOFT, HEAL_S, HEALING, share
            )
        else:
            share = weight[k].copy()
        share[~np.isfinite(seen.readings[k])] = 0
        scale, map_ = ground.scales[k].copy(), ground.maps[k].copy()
        kernels.follow_scale(
            seen.fitted[k], seen.readings[k], seen.noise[k], share, scale, *at, 1 / COARSE, *rates
        )
        if renew > 1:
            map_[..., : kernels.TERMS - 1] /= np.float32(renew)
        kernels.update_map(map_, seen.readings[k], share, *at, metric, reach, gain)
        if held is not None:
            fine = held.repeat(COARSE, axis=0).repeat(COARSE, axis=1)[: map_.shape[0], : map_.shape[1]]
            map_[fine, : kernels.TERMS - 1] *= np.float32(math.exp(interval_s / MEMORY_S))
        return map_, scale

    maps, scales = zip(*map_threads(one, range(len(ground.places))), strict=True)
    times = {"differed_s": differed_s, "since_s": since_s, "first_s": first_s}
    return replace(ground, maps=maps, scales=scales, shift_m=(east, north), **times)


def _elements_of_kind(ground: Ground, kind: int, every: int = 1) -> tuple[slice, slice]:
    """Slices of the elements of a kind, in every row or in one of several."""
    i, j = ground.places[kind]
    return slice(i, None, every * ground.side), slice(j, None, ground.side)


def _places_by_kind(ground: Ground, x, y, every: int = 1) -> list[tuple[Array, Array]]:
    """Map coordinates x and y of the elements of each kind."""
    cut = [_elements_of_kind(ground, k, every) for k in range(len(ground.places))]
    return [(np.ascontiguousarray(x[one]), np.ascontiguousarray(y[one])) for one in cut]


def _predict_kinds(ground: Ground, readings, variance, x, y, gain: float, every: int = 1):
    """Fit, variance and z² of each kind at map coordinates."""
    out = []
    for k, at in enumerate(_places_by_kind(ground, x, y, every)):
        rows = len(readings[k])
        fitted = np.zeros((*readings[k].shape, 5), np.float32)
        over_rows(
            kernels.predict_readings, rows, ground.maps[k], *at, MIN_WEIGHT * gain, RIDGE / CELL_M**2, fitted
        )
        fitted[..., 4] /= gain
        var, z2 = np.empty_like(readings[k]), np.empty_like(readings[k])
        over_rows(
            kernels.residuals, rows, fitted, readings[k], variance[k], ground.scales[k], at, 1 / COARSE,
            PARTS, var, z2,
        )  # fmt: skip
        out.append((fitted, var, z2))
    return tuple(zip(*out, strict=True))


def _shift(readings, fitted, var) -> Float[Array, "2"]:
    """Estimate the shift of all elements, in columns and rows of the map, by robust least squares. [cell]"""
    shift = np.zeros(2)
    for _ in range(3):
        terms = np.zeros(5)
        for k in range(len(readings)):
            kernels.shift_terms(fitted[k], readings[k], var[k], shift, SHIFT_SOFT, terms)
        normal = np.array([[terms[0], terms[1]], [terms[1], terms[2]]])
        if not np.linalg.det(normal) > 1e-6 * normal[0, 0] * normal[1, 1] > 0:
            return np.zeros(2)
        shift = np.linalg.solve(normal, terms[3:])
    return shift


def _kernel(x, y) -> tuple[Float[Array, "3"], Float[Array, "2"]]:
    """Metric of the kernel on the ground, which is round on the array, and its extent. [cell⁻², cell]"""
    rows, columns = x.shape
    down = np.array([x[-1].mean() - x[0].mean(), y[-1].mean() - y[0].mean()]) / (rows - 1)
    right = np.array([x[:, -1].mean() - x[:, 0].mean(), y[:, -1].mean() - y[:, 0].mean()]) / (columns - 1)
    to_array = np.linalg.inv(np.stack([down, right], axis=1)) / REACH
    form = to_array.T @ to_array
    reach = np.sqrt(np.diag(np.linalg.inv(form)))
    return np.array([form[0, 0], 2 * form[0, 1], form[1, 1]]), reach


def _scale_divisor(metric: Float[Array, "3"], side: int) -> float:
    """Elements of a kind in a coarse cell, which count as one; 1 if no more than in the calibration."""
    element = 1 / (REACH**2 * math.sqrt(metric[0] * metric[2] - metric[1] ** 2 / 4))  # on the ground. [cell²]
    count = COARSE**2 / (side**2 * element)
    return count if count > MAX_PER_CELL else 1.0


def _terrain_height(
    terrain: xr.Dataset | None, east: Float[Array, "*n"], north: Float[Array, "*n"]
) -> Float[Array, "*n"]:
    """Height of the ground, bilinear, constant beyond the edges; 0 without a terrain. [m]"""
    return np.zeros(np.shape(east)) if terrain is None else height_at(terrain, east, north)


def element_places(
    frame: Frame, corner_m: tuple[float, float], cell_m: float
) -> tuple[Float[Array, "row column"], Float[Array, "row column"]]:
    """Ground point of every element, in cells of a map: columns east, rows south of its first cell's centre.

    Parameters
    ----------
    frame
        Frame with camera and reported pose; the ground is level at 0 m without a terrain.
    corner_m, cell_m
        East and north of the first cell's centre, and the cells' size. [m]

    Returns
    -------
    x and y; NaN for elements that never see the ground. [cell]
    """
    (_, camera, pose), terrain = raw_of(frame), frame.terrain
    rows, columns = (np.arange(0, n + NODE, NODE, dtype=float) for n in (camera.rows, camera.columns))
    pixels = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1)
    height = np.full(pixels.shape[:2], frame.mean_height_m)
    for _ in range(_HEIGHT_STEPS):
        points = ground_points(camera, pose, pixels, height)
        height = _terrain_height(terrain, points[..., 0], points[..., 1])
    out = np.empty((2, camera.rows, camera.columns), np.float32)
    between_nodes((points[..., 0] - corner_m[0]) / cell_m, NODE, out[0])
    between_nodes((corner_m[1] - points[..., 1]) / cell_m, NODE, out[1])
    return out[0], out[1]


def elements_of_cells(
    frame: Frame,
    corner_m: tuple[float, float],
    cell_m: float,
    shape: tuple[int, int],
    moved_m: tuple[float, float],
) -> tuple[Float[Array, "row column"], Float[Array, "row column"]]:
    """Element, row and column, of each cell of a ground grid.

    Parameters
    ----------
    frame, corner_m, cell_m
        See `element_places`, for the grid.
    shape
        Rows and columns of the grid.
    moved_m
        East and north shift from registration. [m]
    """
    i, j = (np.arange(0, n + NODE, NODE, dtype=float) for n in shape)
    east = corner_m[0] + cell_m * j[None] - moved_m[0] + 0 * i[:, None]
    north = corner_m[1] - cell_m * i[:, None] - moved_m[1] + 0 * j[None]
    points = np.stack([east, north, _terrain_height(frame.terrain, east, north)], axis=-1)
    element = project(*raw_of(frame)[1:], points)
    out = np.empty((2, *shape), np.float32)
    for k in range(2):
        between_nodes(np.ascontiguousarray(element[..., k]), NODE, out[k])
    return out[0], out[1]


@nb.njit(cache=True, nogil=True)
def between_nodes(nodes, step, out):
    """Fill a raster from its nodes, every ``step`` pixels from the first, linear between."""
    upper = np.empty(nodes.shape[1])
    for i in range(out.shape[0]):
        a = i // step
        f = (i - a * step) / step
        for b in range(nodes.shape[1]):
            upper[b] = (1 - f) * nodes[a, b] + f * nodes[a + 1, b]
        for b in range(nodes.shape[1] - 1):
            rise = (upper[b + 1] - upper[b]) / step
            for g in range(min(step, out.shape[1] - b * step)):
                out[i, b * step + g] = upper[b] + g * rise
