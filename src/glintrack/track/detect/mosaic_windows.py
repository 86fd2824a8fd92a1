"""Evidence of change on a ground grid, and the signed change of all kinds of elements around its peaks.

A vehicle is brighter or darker than the ground as a whole, and the change ends at its edges. Edges of
buildings and crowns that are displaced change along a line, with both signs. Kinds of elements disagree where
polarization or the place within a superpixel matters.
"""

import math

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.track.detect.footprint import footprints
from glintrack.track.detect.mosaic_model import ElementPrediction

_MEANS = ("signed", "evidence", "contrast", "contrast_root", "disagreement", "disagreement_root")
WINDOW_FEATURES = ("across_root", *_MEANS, *(f"ring_{name}" for name in _MEANS))
FREEDOM = 3.0  # of Student's t: one outlier is no vehicle
CAR_M = 4.2, 1.6
RING_M = 4.7  # outer radius of the ring: the next car in a queue is beyond
INNER_M = 1.5  # radius in which no cell is of the ring, whatever the window's direction


def evidence_on_ground(
    planes: tuple[Float[Array, "row column"], ...],
    offsets: Float[Array, "plane 2"],
    side: int,
    element: tuple[Float[Array, "y x"], Float[Array, "y x"]],
) -> Float[Array, "y x"]:
    """Mean over the planes of log(1 + z²/ν) for each cell of a ground grid; 0 where unknown.

    Parameters
    ----------
    planes, offsets
        From `mosaic_peaks.element_change`.
    side
        Elements along a superpixel.
    element
        Row and column of the element of each cell.
    """
    out = np.zeros(element[0].shape, np.float32)
    logs = np.log1p(np.stack(planes) * np.float32(1 / FREEDOM))
    over_rows(_gather, len(out), logs, offsets, side, *element, out)
    return out


@nb.njit(cache=True, nogil=True)
def _gather(start, stop, planes, offsets, side, row, column, out):
    n, rows, columns = planes.shape
    per_side, share = np.float32(1 / side), np.float32(1 / n)
    for k in range(n):
        first_row = np.float32(0.5 - offsets[k, 0] / side)
        first_column = np.float32(0.5 - offsets[k, 1] / side)
        for i in range(start, stop):
            for j in range(out.shape[1]):
                r, c = row[i, j] * per_side + first_row, column[i, j] * per_side + first_column
                if r >= 0 and c >= 0 and r < rows and c < columns:  # False for NaN
                    value = planes[k, int(r), int(c)]
                    if value == value:
                        out[i, j] += share * value


def window_features(
    cells: Int[Array, "peak 2"],
    change: Float[Array, "y x"],
    seen: ElementPrediction,
    ground: tuple[Float[Array, "plane 2"], int, float],
    element: tuple[Float[Array, "y x"], Float[Array, "y x"]],
) -> Float[Array, "peak feature"]:
    """Compute the `WINDOW_FEATURES` of peaks.

    The first is the root of the evidence under the window in its worst direction. The others are means over
    the cells of the window in its best direction, then of the ring: signed evidence, evidence, relative
    change, and its standard deviation between the kinds of elements. Roots follow the last two.

    Parameters
    ----------
    cells
        Row and column of each peak on a ground grid.
    change
        Evidence of the grid (`evidence_on_ground`). [1]
    seen
        Prediction of the elements.
    ground
        Position of each kind in the superpixel, elements along a superpixel, and side of a cell. [m]
    element
        Row and column of the element of each cell.
    """
    places, side, cell_m = ground
    readings, expected = np.stack(seen.readings), np.stack([one[..., 0] for one in seen.fitted])
    relative = 2 * (readings - expected) / np.maximum(readings + expected, np.float32(1.0))
    evidence = np.log1p(np.stack(seen.z2) * np.float32(1 / FREEDOM))
    kinds = np.stack([np.copysign(evidence, relative), np.clip(relative, -2, 2)], axis=-1)
    found = np.zeros((len(cells), 9))
    over_rows(
        _measure, len(cells), cells, change, kinds, 0.5 - places / side, 1 / side, element,
        footprints(*CAR_M, cell_m), (INNER_M / cell_m, RING_M / cell_m), found,
    )  # fmt: skip
    across, inside, ring = found[:, :1], found[:, 1:5], found[:, 5:]
    means = (np.column_stack([m[:, :3], np.sqrt(m[:, 2]), m[:, 3], np.sqrt(m[:, 3])]) for m in (inside, ring))
    return np.column_stack([np.sqrt(across), *means])


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _measure(start, stop, cells, change, kinds, first, per_side, element, windows, radii, out):
    """Evidence across, then four means in the window and four in the ring."""
    rows, columns, weights = windows
    reach = math.ceil(radii[1])
    share, mean, total = np.empty((2 * reach + 1, 2 * reach + 1)), np.empty(4), np.empty((2, 5))
    for p in range(start, stop):
        i, j = cells[p, 0], cells[p, 1]
        best, out[p, 0] = _best_direction(change, i, j, rows, columns, weights)
        share[:] = 0.0
        for q in range(weights.shape[1]):
            share[reach + rows[best, q], reach + columns[best, q]] += weights[best, q]
        total[:] = 0.0
        for y in range(max(i - reach, 0), min(i + reach + 1, change.shape[0])):
            for x in range(max(j - reach, 0), min(j + reach + 1, change.shape[1])):
                weight, far2 = share[reach + y - i, reach + x - j], (y - i) ** 2 + (x - j) ** 2
                if far2 > radii[1] ** 2 or (weight == 0.0 and far2 <= radii[0] ** 2):
                    continue
                row, column = element[0][y, x] * per_side, element[1][y, x] * per_side
                if _average_kinds(kinds, first, row, column, mean):
                    k, weight = (0, weight) if weight > 0.0 else (1, 1.0)
                    total[k, :4] += weight * mean
                    total[k, 4] += weight
        for k in range(2):
            if total[k, 4] > 0.0:
                out[p, 1 + 4 * k : 5 + 4 * k] = total[k, :4] / total[k, 4]


@nb.njit(cache=True, nogil=True)
def _best_direction(change, i, j, rows, columns, weights):
    """Direction of the window with the greatest mean, and the least mean of all directions."""
    best, most, least = 0, -1.0, math.inf
    for d in range(len(weights)):
        mean = 0.0
        for q in range(weights.shape[1]):
            y, x = i + rows[d, q], j + columns[d, q]
            if 0 <= y < change.shape[0] and 0 <= x < change.shape[1]:
                mean += weights[d, q] * change[y, x]
        if mean > most:
            best, most = d, mean
        least = min(least, mean)
    return best, least


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _average_kinds(kinds, first, row, column, out):
    """Write the four means of a cell; False if nothing is known of it."""
    known = 0
    signed = evidence = relative = square = 0.0
    for k in range(len(kinds)):
        r, c = row + first[k, 0], column + first[k, 1]
        if r >= 0 and c >= 0 and r < kinds.shape[1] and c < kinds.shape[2]:  # False for NaN
            one, share = kinds[k, int(r), int(c), 0], float(kinds[k, int(r), int(c), 1])
            if one == one:
                known += 1
                signed += one
                evidence += abs(one)
                relative += share
                square += share * share
    if known == 0:
        return False
    out[0], out[1], out[2] = signed / known, evidence / known, abs(relative) / known
    out[3] = math.sqrt(max(square / known - out[2] ** 2, 0.0)) if known > 1 else 0.0  # no rounding of one
    return True
