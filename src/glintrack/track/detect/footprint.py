"""Windows of a vehicle's footprint in several directions over evidence on the ground, and their peaks."""

import math

import numba as nb
import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows

DIRECTIONS = 6
# row and column offsets and weights of taps, by direction
Windows = tuple[Int[Array, "direction tap"], Int[Array, "direction tap"], Float[Array, "direction tap"]]
SAMPLE_STEP = 3  # pixels between those of a quantile
MIN_SHARE_OF_TILE = 0.25  # that must be known
_FINE = 5  # parts of a cell's side in which a window's share of it is counted


def footprint_shares(
    length_m: float, width_m: float, cell_m: float, direction_rad: float, parts: int = _FINE
) -> Float[Array, "row column"]:
    """Share of each cell that a rectangle covers, centred on the middle cell.

    Parameters
    ----------
    length_m, width_m
        Size of the rectangle. [m]
    cell_m
        Size of a cell. [m]
    direction_rad
        Direction of its length, counter-clockwise from the rows. [rad]
    parts
        Parts of a cell's side in which its share is counted.
    """
    half = int(np.ceil((length_m / 2 + cell_m) / cell_m))
    side = 2 * half + 1
    fine = ((np.arange(side * parts) + 0.5) / parts - half - 0.5) * cell_m
    right, up, c, s = fine[None, :], -fine[:, None], np.cos(direction_rad), np.sin(direction_rad)
    along, across = right * c + up * s, up * c - right * s
    inside = (np.abs(along) <= length_m / 2) & (np.abs(across) <= width_m / 2)
    return inside.reshape(side, parts, side, parts).mean(axis=(1, 3))


def footprints(length_m: float, width_m: float, cell_m: float, directions: int = DIRECTIONS) -> Windows:
    """Row and column offsets and weights of a rectangle in directions over half a circle.

    Parameters
    ----------
    length_m, width_m, cell_m
        See `footprint_shares`.
    directions
        Number of directions; the first is along the rows.

    Returns
    -------
    Weights are the covered shares of cells and sum to 1 in each direction; unused taps have weight 0.
    """
    shares = [
        footprint_shares(length_m, width_m, cell_m, turn)
        for turn in np.pi * np.arange(directions) / directions
    ]
    most, half = max(np.count_nonzero(share) for share in shares), len(shares[0]) // 2
    rows, columns = np.zeros((directions, most), np.int64), np.zeros((directions, most), np.int64)
    weights = np.zeros((directions, most), np.float32)
    for k, share in enumerate(shares):
        i, j = np.nonzero(share)
        rows[k, : len(i)], columns[k, : len(i)] = i - half, j - half
        weights[k, : len(i)] = (share / share.sum())[i, j]
    return rows, columns, weights


def window_means(evidence: Float[Array, "row column"], windows: Windows) -> Float[Array, "row column"]:
    """Greatest mean of the evidence under the window in any direction; 0 where it would leave the grid."""
    out = np.zeros(evidence.shape, np.float32)
    edge = int(max(np.abs(windows[0]).max(), np.abs(windows[1]).max()))
    over_rows(_means, evidence.shape[0], np.ascontiguousarray(evidence, np.float32), *windows, edge, out)
    return out


# a window's mean may be summed in any order, and no evidence is NaN
@nb.njit(cache=True, nogil=True, fastmath=True)
def _means(start, stop, evidence, rows, columns, weights, edge, out):
    height, width = evidence.shape
    directions, taps = weights.shape
    inner = max(width - 2 * edge, 0)
    total = np.empty(inner, np.float32)
    for i in range(max(start, edge), min(stop, height - edge)):
        best = out[i, edge : edge + inner]
        for k in range(directions):
            total[:] = np.float32(0.0)
            for q in range(taps):
                weight, left = weights[k, q], edge + columns[k, q]
                shifted = evidence[i + rows[k, q], left : left + inner]
                for j in range(inner):  # vectorized along the row
                    total[j] += weight * shifted[j]
            for j in range(inner):
                best[j] = max(best[j], total[j])


def local_quantile(
    values: Float[Array, "row column"], known: Bool[Array, "row column"], share: float, side: int
) -> Float[Array, "row column"]:
    """Quantile of the known values in square tiles, linear between their middles.

    Parameters
    ----------
    values, known
        Values, and where they count. A tile with few of them takes the median of the others.
    share
        Of the values below the quantile, 0 to 1. [1]
    side
        Side of a tile. [pixel]
    """
    few, few_known = values[::SAMPLE_STEP, ::SAMPLE_STEP], known[::SAMPLE_STEP, ::SAMPLE_STEP]
    shape = tuple(max(1, round(n / side)) for n in values.shape)
    row, column = (np.arange(n) * tiles // n for n, tiles in zip(few.shape, shape, strict=True))
    tile = (row[:, None] * shape[1] + column)[few_known]
    order = np.lexsort((few[few_known], tile))
    count = np.bincount(tile, minlength=shape[0] * shape[1])
    at = np.cumsum(count) - count + (share * count).astype(int)
    quantile = np.full(len(count), np.nan)
    enough = count >= MIN_SHARE_OF_TILE * few.size / len(count)
    if not enough.any():
        return np.zeros(values.shape)
    quantile[enough] = few[few_known][order][at[enough]]
    quantile[~enough] = np.median(quantile[enough])
    down, across = (_linear_weights(n, tiles) for n, tiles in zip(values.shape, shape, strict=True))
    return down @ quantile.reshape(shape) @ across.T


def _linear_weights(count: int, tiles: int) -> Float[Array, "pixel tile"]:
    """Weights of linear interpolation between the middles of tiles, constant beyond the outer ones."""
    at = np.clip((np.arange(count) + 0.5) * tiles / count - 0.5, 0, tiles - 1)
    return np.maximum(1 - np.abs(at[:, None] - np.arange(tiles)), 0)


def peaks(
    means: Float[Array, "row column"], least: float, apart_m: float, cell_m: float
) -> Int[Array, "peak 2"]:
    """Find the cells, row and column, that exceed a limit and all others nearer than a distance."""
    found = np.zeros(means.shape, np.bool_)
    reach = round(apart_m / cell_m)
    over_rows(_highest, len(means), np.ascontiguousarray(means, np.float32), np.float32(least), reach, found)
    return np.argwhere(found)


@nb.njit(cache=True, nogil=True)
def _highest(start, stop, means, least, reach, found):
    height, width = means.shape
    for i in range(start, stop):
        for j in range(width):
            here = means[i, j]
            if not here > least:
                continue
            first, last = max(i - reach, 0), min(i + reach + 1, height)
            highest = True
            for a in range(first, last):
                across = int(math.sqrt(reach * reach + 0.5 - (a - i) ** 2))
                for b in range(max(j - across, 0), min(j + across + 1, width)):
                    if means[a, b] > here:
                        highest = False
                        break
                if not highest:
                    break
            found[i, j] = highest


def peak_places(
    means: Float[Array, "row column"], peak: Int[Array, "peak 2"], reach: int = 3
) -> Float[Array, "peak 2"]:
    """Row and column of the centroid of the values above half of each peak, within a few cells of it."""
    out = np.empty((len(peak), 2))
    _centroids(np.ascontiguousarray(means, np.float32), peak, reach, out)
    return out


@nb.njit(cache=True, nogil=True)
def _centroids(means, peak, reach, out):
    height, width = means.shape
    for p in range(len(peak)):
        i, j = peak[p, 0], peak[p, 1]
        base = 0.5 * means[i, j]
        total = row = column = 0.0
        for a in range(max(i - reach, 0), min(i + reach + 1, height)):
            for b in range(max(j - reach, 0), min(j + reach + 1, width)):
                w = means[a, b] - base
                if w > 0.0 and (a - i) ** 2 + (b - j) ** 2 <= reach * reach:
                    total += w
                    row += w * a
                    column += w * b
        out[p, 0] = row / total if total > 0.0 else i
        out[p, 1] = column / total if total > 0.0 else j
