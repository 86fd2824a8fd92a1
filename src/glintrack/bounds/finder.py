"""Fixed finder of vehicles, the same for every design: a joint fit of vehicle templates.

The evidence of change of each element, f = ln(1 + z²/3), is sampled on a ground grid at half a car's height.
A cell of the grid has the mean of samples as far apart as the elements, so that fine elements all count.
A template is the footprint of a car or a lorry in one of eight directions; its score is
Σ (min(f, 2.5) − 0.8). Templates are taken in falling order of score; each explains the cells under it and its
shadow.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.camera import Camera, Pose, project
from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.track.detect.footprint import footprint_shares

CELL_M = 0.75
HEIGHT_M = 0.7  # of a vehicle's middle
SHADOW_M = 1.5  # height that casts it
PENALTY = 0.8  # of a cell, against ln(1 + z²/3) of noise, 0.26 in the mean
MAX_GAIN = 2.5  # of a cell, so that a template must be full
FOOTPRINTS_M = ((4.6, 2.0), (11.0, 2.6))
DIRECTIONS = 8
MAX_TEMPLATES = 400  # of a frame
_MIN_SCORE = 2.0  # of a template
_MARGIN_M = 1.0  # about what is explained: roof and sides seen aslant


class Found(NamedTuple):
    """Middles and scores of the templates fitted to a frame, by falling score. [m, 1]"""

    position: Float[Array, "template 2"]
    score: Float[Array, "template"]


class Templates(NamedTuple):
    """Cells of every template, by their distances from its middle in a flat grid with a border.

    Parameters
    ----------
    border
        Empty cells about the grid.
    offset, weight
        Distance of each cell of each template, and the part of the cell inside the footprint.
    start
        Index of each template's first cell, and the end of the last one.
    """

    border: int
    offset: Int[Array, "tap"]
    weight: Float[Array, "tap"]
    start: Int[Array, "template_and_end"]


class Plane(NamedTuple):
    """Evidence of one kind of element: values, place of element (0, 0) of that kind, and spacing."""

    evidence: Float[Array, "y x"]
    row: float
    column: float
    step: int


def _cells_in_view(plane: Plane, place: Array) -> tuple[Int[Array, "cell"], Int[Array, "cell"]]:
    """Cells that the elements of a plane see, and the element of each, in flat arrays."""
    rows, columns = plane.evidence.shape
    i = np.round((place[..., 0] - plane.row) / plane.step)
    j = np.round((place[..., 1] - plane.column) / plane.step)
    with np.errstate(invalid="ignore"):
        seen = np.flatnonzero((i >= 0) & (j >= 0) & (i < rows) & (j < columns))
    return seen, (i.ravel()[seen] * columns + j.ravel()[seen]).astype(np.int64)


def evidence(z2: Float[Array, "..."]) -> Float[Array, "..."]:
    """ln(1 + z²/3), robust against single residuals; 0 where z is not known."""
    return np.log1p(np.nan_to_num(z2, nan=0.0, posinf=1e6) / 3).astype(np.float32)


def find_vehicles(
    planes: list[Plane],
    place: Float[Array, "y x sample 2"],
    area_m: tuple[float, float, float, float],
    sun_direction: Float[Array, "3"],
) -> Found:
    """Fit templates to a frame's evidence.

    Parameters
    ----------
    planes
        Evidence of each kind of element; the mean is used.
    place
        Row and column of the elements that see samples of the ground cells, from `cell_places`.
    area_m
        West, south, east, north. [m]
    sun_direction
        Unit vector toward the sun. [1]
    """
    x, y = ground_cells(area_m)
    shape = place.shape[:2]
    gain = np.zeros(place.shape[:3], np.float32)
    for plane in planes:
        seen, element = _cells_in_view(plane, place)
        gain.reshape(-1)[seen] += plane.evidence.reshape(-1)[element] / len(planes)
    taps, start = _taps()
    border = int(np.abs(taps[:, :2]).max())  # no template reaches beyond it
    gain = np.pad(np.minimum(gain, MAX_GAIN).mean(axis=2) - PENALTY, border)
    templates = Templates(border, (taps[:, 0] * gain.shape[1] + taps[:, 1]).astype(int), taps[:, 2], start)
    best, which = np.full(shape, -np.inf, np.float32), np.zeros(shape, np.int16)
    over_rows(_score_rows, len(best), gain, templates, best, which)
    reach = math.ceil((max(length for length, _ in FOOTPRINTS_M) / 2 + 2 * _MARGIN_M) / CELL_M) + 1
    slant = sun_direction[:2] / max(float(sun_direction[2]), 0.05) * SHADOW_M
    shadow = np.array([slant[1], -slant[0]]) / CELL_M  # rows fall with north; away from the sun
    middles, scores = _fit(gain, templates, best, which, _boxes(), shadow, reach)
    return Found(np.stack([x[middles[:, 1]], y[middles[:, 0]]], axis=1), scores)


def cell_places(
    camera: Camera,
    pose: Pose,
    ground_m: Float[Array, "y x"],
    area_m: tuple[float, float, float, float],
    spacing_m: float = CELL_M,
) -> Float[Array, "y x sample 2"]:
    """(row, column) of the elements that see vehicles' middles over the ground cells.

    Parameters
    ----------
    camera, pose
        Camera and pose of the frame, true or reported.
    ground_m
        Heights of the ground at `ground_cells`. [m]
    area_m
        West, south, east, north. [m]
    spacing_m
        Ground sample distance of the elements; the samples of a cell are about as far apart. [m]
    """
    x, y = ground_cells(area_m)
    side = max(round(CELL_M / spacing_m), 1)
    aside = ((np.arange(side) + 0.5) / side - 0.5) * CELL_M
    middles = np.stack([*np.meshgrid(x, y), ground_m + HEIGHT_M], axis=-1)
    samples = np.stack([*np.meshgrid(aside, aside), np.zeros((side, side))], axis=-1).reshape(-1, 3)
    return project(camera, pose, middles[:, :, None] + samples)


def ground_cells(area_m: tuple[float, float, float, float]) -> tuple[Float[Array, "x"], Float[Array, "y"]]:
    """East and north of the middles of the cells. [m]"""
    west, south, east, north = area_m
    return np.arange(west + CELL_M / 2, east, CELL_M), np.arange(north - CELL_M / 2, south, -CELL_M)


@lru_cache(maxsize=1)
def _taps() -> tuple[Float[Array, "tap 3"], Array]:
    """(row, column, weight) of the cells of all templates, and the index of each template's first cell."""
    taps, start = [], [0]
    for length, width in FOOTPRINTS_M:
        for k in range(DIRECTIONS):
            share = footprint_shares(length, width, CELL_M, math.pi * k / DIRECTIONS, 8)
            i, j = np.nonzero(share)
            taps.append(np.stack([i - len(share) // 2, j - len(share) // 2, share[i, j]], axis=1))
            start.append(start[-1] + len(taps[-1]))
    return np.concatenate(taps), np.array(start)


def _boxes() -> Float[Array, "template 3"]:
    """Half length, half width and direction of the box that each template explains. [cell, cell, rad]"""
    return np.array(
        [
            ((length / 2 + _MARGIN_M) / CELL_M, (width / 2 + _MARGIN_M) / CELL_M, math.pi * k / DIRECTIONS)
            for length, width in FOOTPRINTS_M
            for k in range(DIRECTIONS)
        ]
    )


@nb.njit(cache=True, forceinline=True, error_model="numpy")
def _score_at(gain, middle, templates):
    """Score and number of the best template about a place of the flat gain."""
    best, which = -np.inf, 0
    for k in range(len(templates.start) - 1):
        total = 0.0
        for t in range(templates.start[k], templates.start[k + 1]):
            total += templates.weight[t] * gain[middle + templates.offset[t]]
        if total > best:
            best, which = total, k
    return best, which


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _score_rows(first, last, gain, templates, best, which):
    flat, border = gain.reshape(-1), templates.border
    for i in range(first, last):
        for j in range(best.shape[1]):
            middle = (i + border) * gain.shape[1] + j + border
            if flat[middle] > 0:  # a template's middle has changed
                best[i, j], which[i, j] = _score_at(flat, middle, templates)


@nb.njit(cache=True, error_model="numpy")
def _explain(gain, i, j, box, shadow):
    """Remove the gain under a template and its shadow."""
    rows, columns = gain.shape
    c, s = math.cos(box[2]), math.sin(box[2])
    steps = max(math.ceil(math.hypot(shadow[0], shadow[1])), 1)
    reach = math.ceil(math.hypot(box[0], box[1]))
    for step in range(steps + 1):
        middle_r, middle_c = i + shadow[0] * step / steps, j + shadow[1] * step / steps
        for r in range(max(int(middle_r) - reach, 0), min(int(middle_r) + reach + 2, rows)):
            for q in range(max(int(middle_c) - reach, 0), min(int(middle_c) + reach + 2, columns)):
                down, right = r - middle_r, q - middle_c
                along, across = right * c - down * s, right * s + down * c
                if abs(along) <= box[0] and abs(across) <= box[1]:
                    gain[r, q] = -PENALTY


@nb.njit(cache=True)
def _highest(values):
    """Return the index of the first maximum."""
    at = 0
    for k in range(1, len(values)):
        if values[k] > values[at]:
            at = k
    return at


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _fit(gain, templates, best, which, boxes, shadow, reach):
    rows, columns = best.shape
    flat, border = gain.reshape(-1), templates.border
    inside = gain[border : border + rows, border : border + columns]
    cells, scores = np.empty((MAX_TEMPLATES, 2), np.int64), np.empty(MAX_TEMPLATES)
    spread = reach + math.ceil(max(abs(shadow[0]), abs(shadow[1]))) + reach
    count = 0
    if best.size == 0:
        return cells[:count], scores[:count]
    row_best = np.empty(rows)
    for i in range(rows):
        row_best[i] = best[i, _highest(best[i])]
    while count < MAX_TEMPLATES:
        i = _highest(row_best)
        j = _highest(best[i])
        if not best[i, j] >= _MIN_SCORE:
            break
        cells[count, 0], cells[count, 1], scores[count] = i, j, best[i, j]
        count += 1
        _explain(inside, i, j, boxes[which[i, j]], shadow)
        for r in range(max(i - spread, 0), min(i + spread + 1, rows)):
            for q in range(max(j - spread, 0), min(j + spread + 1, columns)):
                if best[r, q] >= _MIN_SCORE:  # scores only fall
                    middle = (r + border) * gain.shape[1] + q + border
                    if flat[middle] > 0:
                        best[r, q], which[r, q] = _score_at(flat, middle, templates)
                    else:
                        best[r, q] = -np.inf
            row_best[r] = best[r, _highest(best[r])]
    return cells[:count], scores[:count]
