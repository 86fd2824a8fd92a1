"""Connected blobs of changed pixels: labels, centroids, covariances, size limits."""

import numba as nb
import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.track.detect.detections import Detections


@nb.njit(cache=True)
def label(rows, columns, changed, reach):
    """Blobs of changed pixels that lie within ``reach`` pixels (rows and columns) of each other.

    Parameters
    ----------
    rows, columns : (pixel,)
        Of the changed pixels, in raster order.
    changed : (y, x) bool
        The same pixels.
    reach : int
        1 joins the eight neighbours. [pixel]

    Returns
    -------
    Blob number of each pixel, from 0 in the order of first appearance.
    """
    width = changed.shape[1]
    count = len(rows)
    number = np.empty(changed.shape, np.int32)  # of a changed pixel in raster order
    parent = np.empty(count, np.int64)
    for k in range(count):
        y, x = rows[k], columns[k]
        number[y, x] = k
        parent[k] = k
        for j in range(max(0, y - reach), y + 1):
            for i in range(max(0, x - reach), min(width, x + reach + 1)):
                if changed[j, i] and (j < y or i < x):
                    a, b = _root(parent, number[j, i]), _root(parent, k)
                    parent[max(a, b)] = min(a, b)
    blob = np.empty(count, np.int64)
    new = np.empty(count, np.int64)
    new[:] = -1
    blobs = 0
    for k in range(count):
        root = _root(parent, k)
        if new[root] < 0:
            new[root] = blobs
            blobs += 1
        blob[k] = new[root]
    return blob


@nb.njit(cache=True)
def _root(parent, i):
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@nb.njit(cache=True)
def split(rows, columns, blob, seeds, inside, near):
    """Cut blobs that hold several expected targets: each pixel goes to the nearest of them.

    Parameters
    ----------
    rows, columns, blob : (pixel,)
        Labelled pixels.
    seeds : (seed, 2)
        Row and column where targets are expected. [pixel]
    inside : float
        A seed belongs to the blob of the nearest changed pixel if that is within this distance. [pixel]
    near : float
        Pixels farther than this from every seed of a blob with several remain together as its rest. [pixel]

    Returns
    -------
    New blob number of each pixel, from 0 without gaps.
    """
    owner, nearest = np.empty(len(seeds), np.int64), np.empty(len(seeds))
    owner[:] = -1
    nearest[:] = inside * inside
    for k in range(len(rows)):
        for s in range(len(seeds)):
            dy, dx = rows[k] - seeds[s, 0], columns[k] - seeds[s, 1]
            d2 = dy * dy + dx * dx
            if d2 < nearest[s]:
                nearest[s], owner[s] = d2, blob[k]
    blobs = 0
    for k in range(len(rows)):
        blobs = max(blobs, blob[k] + 1)
    held = np.zeros(blobs, np.int64)
    for s in range(len(seeds)):
        if owner[s] >= 0:
            held[owner[s]] += 1
    out = blob.copy()
    for k in range(len(rows)):
        if held[blob[k]] < 2:
            continue
        best = near * near
        for s in range(len(seeds)):
            if owner[s] == blob[k]:
                dy, dx = rows[k] - seeds[s, 0], columns[k] - seeds[s, 1]
                d2 = dy * dy + dx * dx
                if d2 < best:
                    best, out[k] = d2, blobs + s
    new = np.empty(blobs + len(seeds), np.int64)
    new[:] = -1
    count = 0
    for k in range(len(rows)):
        if new[out[k]] < 0:
            new[out[k]] = count
            count += 1
        out[k] = new[out[k]]
    return out


@nb.njit(cache=True)
def moments(rows, columns, blob, weight, count):
    """Weighted moments of each blob.

    Returns
    -------
    (blob, 7): pixels, row, column, row variance, column variance, row-column covariance, peak weight. The
    variances include the pixel's own, 1/12. [pixel]
    """
    out = np.zeros((count, 7))
    total = np.zeros(count)
    for k in range(len(rows)):
        b, w = blob[k], weight[k]
        total[b] += w
        out[b, 0] += 1
        out[b, 1] += w * rows[k]
        out[b, 2] += w * columns[k]
        out[b, 6] = max(out[b, 6], w)
    for b in range(count):
        out[b, 1] /= total[b]
        out[b, 2] /= total[b]
        out[b, 3] = out[b, 4] = 1.0 / 12.0
    for k in range(len(rows)):
        b, w = blob[k], weight[k] / total[blob[k]]
        dy, dx = rows[k] - out[b, 1], columns[k] - out[b, 2]
        out[b, 3] += w * dy * dy
        out[b, 4] += w * dx * dx
        out[b, 5] += w * dy * dx
    return out


def vehicle_sized(
    moment: Float[Array, "blob 7"], gsd_m: float, area_m2: tuple[float, float], length_max_m: float
) -> np.ndarray:
    """True for blobs whose area and length may be a vehicle's."""
    area = moment[:, 0] * gsd_m**2
    half_trace = 0.5 * (moment[:, 3] + moment[:, 4])
    longest = half_trace + np.hypot(0.5 * (moment[:, 3] - moment[:, 4]), moment[:, 5])
    length = np.sqrt(12.0 * longest) * gsd_m  # of a uniform bar of that variance
    return (area >= area_m2[0]) & (area <= area_m2[1]) & (length <= length_max_m)


def detections_of(
    moment: Float[Array, "blob 7"],
    gsd_m: float,
    corner_m: tuple[float, float],
    sigma_m: float,
    threshold: float,
) -> Detections:
    """Detections from the moments of blobs.

    Parameters
    ----------
    moment
        From `moments`.
    gsd_m
        Grid spacing. [m]
    corner_m
        East and north of the centre of pixel (0, 0). [m]
    sigma_m
        Standard deviation of a small blob's centroid. [m]
    threshold
        Weight that corresponds to contrast 1.
    """
    position = np.stack([corner_m[0] + moment[:, 2] * gsd_m, corner_m[1] - moment[:, 1] * gsd_m], axis=-1)
    # a long or ragged blob is located less well: a tenth of its variance is a fragment's bias
    share = 0.1 * gsd_m**2
    covariance = np.empty((len(moment), 2, 2))
    covariance[:, 0, 0] = sigma_m**2 + share * moment[:, 4]
    covariance[:, 1, 1] = sigma_m**2 + share * moment[:, 3]
    covariance[:, 0, 1] = covariance[:, 1, 0] = -share * moment[:, 5]
    extent = np.sqrt(4 / np.pi * moment[:, 0]) * gsd_m
    return Detections(position, covariance, extent, moment[:, 6] / threshold)
