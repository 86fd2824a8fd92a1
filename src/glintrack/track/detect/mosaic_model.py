"""Predict the reading of every raw element from a recursive map of the ground for each kind of element.

Readings are learnt where they were seen, by the reported poses and one shift per frame. In the next frame
they are predicted at the elements' new places, each kind from its own past. A mosaic therefore needs no
demosaicking, and the polarizers' different places cause no change. Work and memory are linear in elements
and cells.

Places are exact on a lattice of nodes, through the camera with its lens and the reported pose, and linear
between. Heights are the terrain's: what stands on it is seen displaced, and learnt as it is seen.
"""

import math
from dataclasses import dataclass, replace

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
from glintrack.track.detect.frame import Grid

CELL_M = 0.75
COARSE = 2  # cells along a coarse one, which holds about one element of a kind a frame
MARGIN_M = 10.0
REACH = 1.9  # elements of pitch within which a reading tells of a place
MEMORY_S = 3.0
LEAST_WEIGHT = 0.6  # sum of weights with which a cell predicts
RIDGE = 0.025  # pulls slopes to nought. [m²]
SCALE_S, SCALE_QUANTILE, SCALE_START, SCALE_LEAST = 3.0, 0.7, 3.0, 0.3
SCALE_SOON = 0.6  # of the time since the first frame
PARTS = np.array([0.8, 0.1, 0.5])  # of scale, spread and leverage in a residual's variance
SOFT, HEAL_LIMIT, HEAL_S, HEALING = 16.0, 9.0, 1.4, 0.7
SHIFT_SOFT, SHIFT_STEPS, SHIFT_ROWS, SHIFT_DONE_M, ANCHOR_S = 4.0, 2, 4, 0.05, 3.0
_RENEW = 1e4  # weights grow with time by this much before they are scaled back
NODE = 16  # elements or cells between nodes: perspective bends by less than a hundredth of an element between
_HEIGHT_STEPS = 4  # times that a node's height is looked up again where its ray meets the ground


@dataclass(frozen=True)
class Ground:
    """What was learnt of the ground.

    Parameters
    ----------
    places
        Row and column in the superpixel of each kind of element.
    side
        Elements along a superpixel.
    corner_m
        East and north of the first cell's centre. [m]
    maps, scales
        Of each kind: see `mosaic_kernels`.
    differed_s
        For how long each coarse cell has differed in every frame. [s]
    since_s, first_s
        When weights were one, and when the first frame was learnt. [s]
    shift_m
        Mean of the last shifts that registration found, east and north. [m]
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

    def coarse_cells(self, position_m: Float[Array, "n 2"]) -> Int[Array, "n 2"]:
        """Row and column of the coarse cell about each place, held to the map."""
        x = (position_m[:, 0] - self.corner_m[0]) / CELL_M
        y = (self.corner_m[1] - position_m[:, 1]) / CELL_M
        cell = np.floor((np.stack([y, x], axis=-1) + 0.5) / COARSE).astype(int)
        return np.clip(cell, 0, np.array(self.differed_s.shape) - 1)


@dataclass(frozen=True)
class ElementPrediction:
    """A mosaic beside what was expected of it.

    Parameters
    ----------
    readings, expected, var, z2
        Of each kind of element: what it read, was expected to read, the variance of the difference, and its
        square over that; NaN where nothing was known. [e, e, e², 1]
    fitted, noise
        Fit of the expectation (`mosaic_kernels.predict_readings`), and variance of the sensor's noise.
    x, y
        Places of all elements. [cell]
    moved_m
        East and north by which registration moved them. [m]
    """

    readings: tuple[Float[Array, "row column"], ...]
    fitted: tuple[Float[Array, "row column 5"], ...]
    noise: tuple[Float[Array, "row column"], ...]
    var: tuple[Float[Array, "row column"], ...]
    z2: tuple[Float[Array, "row column"], ...]
    x: Float[Array, "row column"]
    y: Float[Array, "row column"]
    moved_m: tuple[float, float]

    @property
    def expected(self) -> tuple[Float[Array, "row column"], ...]:
        """What each element was expected to read. [e]"""
        return tuple(one[..., 0] for one in self.fitted)


def bare_ground(grid: Grid, places: tuple[tuple[int, int], ...], side: int) -> Ground:
    """Nothing learnt about an area and the margin around it."""
    west, north = grid.corner_m[0] - grid.gsd_m / 2 - MARGIN_M, grid.corner_m[1] + grid.gsd_m / 2 + MARGIN_M
    shape = tuple(math.ceil((n * grid.gsd_m + 2 * MARGIN_M) / CELL_M) for n in grid.shape)
    coarse = tuple(math.ceil(n / COARSE) + 1 for n in shape)
    return Ground(
        places,
        side,
        (west + CELL_M / 2, north - CELL_M / 2),
        tuple(np.zeros((*shape, kernels.TERMS), np.float32) for _ in places),
        tuple(np.full(coarse, SCALE_START, np.float32) for _ in places),
        np.zeros(coarse, np.float32),
    )


def predict(
    ground: Ground, mosaic: Mosaic, camera: Camera, pose: Pose, terrain, time_s: float
) -> ElementPrediction:
    """What every element was expected to read, once the frame is registered to what was learnt.

    Parameters
    ----------
    ground
        From the frames before.
    mosaic, camera, pose, time_s
        Of this frame; the pose as reported.
    terrain
        Schema ``terrain``; level at 0 m without.
    """
    x, y = element_places(camera, pose, terrain, ground.corner_m, CELL_M)
    cut = [_own(ground, k) for k in range(len(ground.places))]
    readings = tuple(np.ascontiguousarray(mosaic.electrons[one], np.float32) for one in cut)
    variance = tuple(np.square(np.ascontiguousarray(mosaic.sigma_e[one], np.float32)) for one in cut)
    moved = np.zeros(2)
    gain = _gain(ground, time_s)
    for _ in range(SHIFT_STEPS):
        some, some_variance = (
            tuple(np.ascontiguousarray(a[::SHIFT_ROWS]) for a in of) for of in (readings, variance)
        )
        fitted, var, _ = _expect(ground, some, some_variance, x, y, gain, SHIFT_ROWS)
        step = _shift(some, fitted, var)
        moved += step
        x, y = x + np.float32(step[0]), y + np.float32(step[1])
        if math.hypot(*step) * CELL_M < SHIFT_DONE_M:
            break
    fitted, var, z2 = _expect(ground, readings, variance, x, y, gain)
    moved_m = float(moved[0]) * CELL_M, -float(moved[1]) * CELL_M
    return ElementPrediction(
        readings=readings, fitted=fitted, noise=variance, var=var, z2=z2, x=x, y=y, moved_m=moved_m
    )


def update_ground(
    ground: Ground,
    seen: ElementPrediction,
    camera: Camera,
    masked: Bool[Array, "coarse_row coarse_column"],
    time_s: float,
    interval_s: float,
    weight: tuple[Float[Array, "row column"], ...] | None = None,
) -> Ground:
    """The ground after a frame.

    Parameters
    ----------
    ground, seen
        Before it, and what `predict` made of the frame with that.
    camera
        Of the mosaic.
    masked
        Coarse cells that are not learnt: vehicles.
    time_s, interval_s
        Epoch, and time since the frame before. [s]
    weight
        How much of each reading of each kind is learnt; by default it follows from ``masked`` and the
        residuals. [1]
    """
    changed = np.zeros(ground.differed_s.shape, np.bool_)
    for z2, at in zip(seen.z2, _own_places(ground, seen.x, seen.y), strict=True):
        kernels.flag(z2, *at, 1 / COARSE, HEAL_LIMIT, changed)
    differed_s = np.where(changed, ground.differed_s + np.float32(interval_s), 0)
    gain = _gain(ground, time_s)
    since_s = time_s if ground.since_s is None else ground.since_s
    renew = gain if gain > _RENEW else 1.0
    gain, since_s = (1.0, time_s) if renew > 1 else (gain, since_s)
    mean = _mean_shift(ground, seen, interval_s)
    back = -math.expm1(-interval_s / ANCHOR_S) / CELL_M
    x, y = seen.x - np.float32(back * mean[0]), seen.y + np.float32(back * mean[1])
    metric, reach = _kernel(x, y)
    first_s = time_s if ground.first_s is None else ground.first_s
    scale_s = min(SCALE_S, max(SCALE_SOON * (time_s - first_s), 1e-3))  # at first it follows sooner
    step = 4 * -math.expm1(-max(interval_s, 1e-3) / scale_s)
    rates = math.exp(step * SCALE_QUANTILE), math.exp(step * (SCALE_QUANTILE - 1)), SCALE_LEAST

    def one(k: int):
        own = _own(ground, k)
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
        return map_, scale

    maps, scales = zip(*map_threads(one, range(len(ground.places))), strict=True)
    times = {"differed_s": differed_s, "since_s": since_s, "first_s": first_s}
    return replace(ground, maps=maps, scales=scales, shift_m=mean, **times)


def _gain(ground: Ground, time_s: float) -> float:
    return 1.0 if ground.since_s is None else math.exp((time_s - ground.since_s) / MEMORY_S)


def _own(ground: Ground, kind: int, every: int = 1) -> tuple[slice, slice]:
    """Elements of a kind, in every row of them or in one of some."""
    i, j = ground.places[kind]
    return slice(i, None, every * ground.side), slice(j, None, ground.side)


def _own_places(ground: Ground, x, y, every: int = 1) -> list[tuple[Array, Array]]:
    """x and y of the elements of each kind."""
    cut = [_own(ground, k, every) for k in range(len(ground.places))]
    return [(np.ascontiguousarray(x[one]), np.ascontiguousarray(y[one])) for one in cut]


def _expect(ground: Ground, readings, variance, x, y, gain: float, every: int = 1):
    """Fit, variance and z² of each kind at the places given."""
    out = []
    for k, at in enumerate(_own_places(ground, x, y, every)):
        rows = len(readings[k])
        fitted = np.zeros((*readings[k].shape, 5), np.float32)
        over_rows(
            kernels.predict_readings,
            rows,
            ground.maps[k],
            *at,
            LEAST_WEIGHT * gain,
            RIDGE / CELL_M**2,
            fitted,
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
    """Columns and rows of the map by which all places lie farther, robust least squares. [cell]"""
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


def _mean_shift(ground: Ground, seen: ElementPrediction, interval_s: float) -> tuple[float, float]:
    """East and north by which frames lie beyond their reported places in the mean: the map is drawn back.

    Roofs and crowns are registered too. They go against the flight as the line of sight turns, and take the
    map with them.
    """
    share = -math.expm1(-interval_s / ANCHOR_S)
    east, north = (a + share * (b - a) for a, b in zip(ground.shift_m, seen.moved_m, strict=True))
    return east, north


def _kernel(x, y) -> tuple[Float[Array, "3"], Float[Array, "2"]]:
    """Metric of the kernel on the ground, round on the array, and how far it reaches. [cell⁻², cell]"""
    rows, columns = x.shape
    down = np.array([x[-1].mean() - x[0].mean(), y[-1].mean() - y[0].mean()]) / (rows - 1)
    right = np.array([x[:, -1].mean() - x[:, 0].mean(), y[:, -1].mean() - y[:, 0].mean()]) / (columns - 1)
    to_array = np.linalg.inv(np.stack([down, right], axis=1)) / REACH
    form = to_array.T @ to_array
    reach = np.sqrt(np.diag(np.linalg.inv(form)))
    return np.array([form[0, 0], 2 * form[0, 1], form[1, 1]]), reach


def terrain_height(
    terrain: xr.Dataset | None, east: Float[Array, "*n"], north: Float[Array, "*n"]
) -> Float[Array, "*n"]:
    """Height of the ground, bilinear, held beyond the edges; nought without a terrain. [m]"""
    if terrain is None:
        return np.zeros(np.shape(east))
    return height_at(terrain, east, north)


def element_places(
    camera: Camera, pose: Pose, terrain: xr.Dataset | None, corner_m: tuple[float, float], cell_m: float
) -> tuple[Float[Array, "row column"], Float[Array, "row column"]]:
    """Ground point of every element, in cells of a map: columns east, rows south of its first cell's centre.

    Parameters
    ----------
    camera, pose
        Of the mosaic, in elements; the pose as reported.
    terrain
        Heights of the ground; level at 0 m without.
    corner_m, cell_m
        East and north of the first cell's centre, and the cells' size. [m]

    Returns
    -------
    x and y; NaN for elements that never see the ground. [cell]
    """
    rows, columns = (np.arange(0, n + NODE, NODE, dtype=float) for n in (camera.rows, camera.columns))
    pixels = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1)
    mean = 0.0 if terrain is None else float(np.mean(terrain["height"].values))
    height = np.full(pixels.shape[:2], mean)
    for _ in range(_HEIGHT_STEPS):
        points = ground_points(camera, pose, pixels, height)
        height = terrain_height(terrain, points[..., 0], points[..., 1])
    out = np.empty((2, camera.rows, camera.columns), np.float32)
    between_nodes((points[..., 0] - corner_m[0]) / cell_m, NODE, out[0])
    between_nodes((corner_m[1] - points[..., 1]) / cell_m, NODE, out[1])
    return out[0], out[1]


def seen_by(
    camera: Camera,
    pose: Pose,
    terrain: xr.Dataset | None,
    corner_m: tuple[float, float],
    cell_m: float,
    shape: tuple[int, int],
    moved_m: tuple[float, float] = (0.0, 0.0),
) -> tuple[Float[Array, "row column"], Float[Array, "row column"]]:
    """Element, row and column, that sees each cell of a ground grid.

    Parameters
    ----------
    camera, pose, terrain, corner_m, cell_m
        As in `element_places`, of the grid.
    shape
        Of the grid.
    moved_m
        East and north by which registration found the elements' places to lie farther than the pose says. [m]
    """
    i, j = (np.arange(0, n + NODE, NODE, dtype=float) for n in shape)
    east = corner_m[0] + cell_m * j[None] - moved_m[0] + 0 * i[:, None]
    north = corner_m[1] - cell_m * i[:, None] - moved_m[1] + 0 * j[None]
    points = np.stack([east, north, terrain_height(terrain, east, north)], axis=-1)
    element = project(camera, pose, points)
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
