"""Demosaicking: readings of a superpixel's polarizers brought to one place.

What an element reads is scaled so that unpolarized light reads its own radiance behind every polarizer.
Stokes vectors follow by the inverse of the analyser matrix (`layouts.invert`): of the measured responses, or
of ideal polarizers, which for 0°, 60° and 120° is Fesenkov's formula.

The method ``"eari"`` interpolates residuals along edges:

1. *Guide.* S0 at each element is the mean over a window of two elements by three, weighed 1 2 1, on each of
   its four sides: every kind weighs the same in it. The four means are weighed by 1/D, where D says how far
   a side's readings are from those of any one Stokes vector: |n · r| with n · A = 0 for the analyser rows A
   of the superpixel's four elements, averaged over three elements by five. For 0°, 45°, 90° and 135° that is
   |r₀ + r₉₀ − r₄₅ − r₁₃₅| (Morimatsu 2020); a mirror is one more row here.
2. *Tentative value.* Each kind is taken as a·guide + b; a and b by least squares over the superpixels about
   it, then averaged over the same ones (the guided filter of He 2013, as Kiku 2013 has it).
3. *Residual.* What the elements read beyond their tentative value is brought to the superpixel's centre
   bilinearly and added to the tentative value there.

References
----------
Morimatsu, Monno, Tanaka and Okutomi, "Monochrome and color polarization demosaicking using edge-aware
residual interpolation", IEEE ICIP, 2571 (2020).
Kiku, Monno, Tanaka and Okutomi, "Residual interpolation for color image demosaicking", IEEE ICIP, 2304
(2013).
He, Sun and Tang, "Guided image filtering", IEEE Trans. PAMI 35, 1397 (2013).

Notes
-----
Morimatsu et al. choose a by the least Laplacian of the residual and interpolate to every element. Least
squares left the smaller error of DoLP (docs/theory/sensor.md).
"""

import numba as nb
import numpy as np
from jaxtyping import Bool, Float

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.sensor.layouts import Superpixel, analyser_matrix, places

PAPER_BOOST = 5.0  # §4.1 and Fig. 13(b)
SIDE = 2  # of a superpixel: four elements and three Stokes components leave one n
WINDOW = 5  # superpixels across, over which a and b are found
_HALF = WINDOW // 2
_REACH = 4  # elements over which the guide looks beyond the edge; even, so that kinds stay in step
_ALIKE = 1e-6  # of the mean reading: D below this is none
_FLAT = 1e-3  # of the local mean: a guide that varies less says nothing of a
_LEAST_ROWS = 24  # of superpixels in a slice: the guide about it is worked out for the next one too
_TINY = float(np.finfo(float).tiny)


def tentative_values(
    measured: Float[Array, "row column"], layout: Superpixel
) -> tuple[Float[Array, "row column"], Float[Array, "y x polarizer"]]:
    """What polarizers read beyond their tentative values, and these at the superpixels' centres.

    Parameters
    ----------
    measured
        What every element reads; NaN where it is not known. [W m⁻² sr⁻¹ µm⁻¹]
    layout
        Superpixel of 2 × 2.

    Returns
    -------
    Residuals, 0 at other kinds of elements and NaN where the reading is; tentative values.
    """
    measured = np.ascontiguousarray(measured, np.float32)
    filled = _filled(measured.astype(np.float64))
    polarizers = np.array(places(layout, "polarizer"))
    rows, columns = (n // SIDE for n in measured.shape)
    residual = np.zeros(measured.shape, np.float32)
    found = np.empty((rows, columns, len(polarizers)), np.float32)
    over_rows(
        _tentative, rows, filled, measured, inconsistency(layout), _least(filled), polarizers, residual,
        found, least=_LEAST_ROWS,
    )  # fmt: skip
    return residual, found


def inconsistency(layout: Superpixel) -> Float[Array, "row column"]:
    """n of the module's first step: 0 on the readings of any Stokes vector, absolute values with mean 1."""
    rows = np.zeros((SIDE, SIDE, 3))
    rows[..., 0] = 1  # mirrors and open elements
    for place, row in zip(places(layout, "polarizer"), analyser_matrix(layout, 1.0), strict=True):
        rows[place] = row
    vector = np.linalg.svd(rows.reshape(SIDE * SIDE, 3).T)[2][-1].reshape(SIDE, SIDE)
    return vector / np.abs(vector).mean()


def _least(readings: Array) -> float:
    """D that counts as none. [W m⁻² sr⁻¹ µm⁻¹]"""
    return _ALIKE * float(np.abs(readings).mean()) + _TINY


@nb.njit(nogil=True, cache=True)
def _tentative(start, stop, filled, measured, vector, least, polarizers, residual, found):
    """Residuals and tentative values of rows ``start`` to ``stop`` of superpixels."""
    rows, columns = found.shape[:2]
    low, high = max(start - 2 * _HALF, 0), min(stop + 2 * _HALF, rows)
    first, last = max(start - _HALF, 0), min(stop + _HALF, rows)
    guide = _guide(SIDE * low, SIDE * high, filled, vector, least)
    slope, offset = np.empty((last - first, columns)), np.empty((last - first, columns))
    slopes, offsets = np.empty(columns), np.empty(columns)
    sums, means = np.empty((4, columns + 2 * _HALF)), np.empty((4, columns))
    for k in range(len(polarizers)):
        i, j = polarizers[k, 0], polarizers[k, 1]
        for y in range(first, last):
            _clear(sums)
            of_g, of_v, of_gg, of_gv = (
                sums[0, _HALF:], sums[1, _HALF:], sums[2, _HALF:], sums[3, _HALF:],
            )  # fmt: skip
            for near in range(y - _HALF, y + _HALF + 1):
                at = min(max(near, 0), rows - 1)
                own, values = guide[SIDE * (at - low) + i, j:], filled[SIDE * at + i, j:]
                for x in range(columns):
                    g, v = own[SIDE * x], values[SIDE * x]
                    of_g[x] += g
                    of_v[x] += v
                    of_gg[x] += g * g
                    of_gv[x] += g * v
            for term in range(4):
                _window_means(sums[term], means[term])
            for x in range(columns):
                g, v = means[0, x], means[1, x]
                varies = means[2, x] - g * g
                slope[y - first, x] = (means[3, x] - g * v) / (varies + (_FLAT * g) ** 2 + _TINY)
                offset[y - first, x] = v - slope[y - first, x] * g
        for y in range(start, stop):
            _clear(sums)
            of_slope, of_offset = sums[0, _HALF:], sums[1, _HALF:]
            for near in range(y - _HALF, y + _HALF + 1):
                at = min(max(near, 0), rows - 1) - first
                for x in range(columns):
                    of_slope[x] += slope[at, x]
                    of_offset[x] += offset[at, x]
            _window_means(sums[0], slopes)
            _window_means(sums[1], offsets)
            upper, lower = guide[SIDE * (y - low)], guide[SIDE * (y - low) + 1]
            for x in range(columns):
                left, row, column = SIDE * x, SIDE * y + i, SIDE * x + j
                centre = 0.25 * (upper[left] + upper[left + 1] + lower[left] + lower[left + 1])
                own = guide[row - SIDE * low, column]
                residual[row, column] = measured[row, column] - (slopes[x] * own + offsets[x])
                found[y, x, k] = slopes[x] * centre + offsets[x]


@nb.njit(cache=True)
def _clear(sums):
    for i in range(sums.shape[0]):
        for x in range(sums.shape[1]):
            sums[i, x] = 0.0


@nb.njit(cache=True)
def _window_means(sums, means):
    """Means over the window from its columns' sums, which have room to repeat `_HALF` at each end."""
    count = len(means)
    for x in range(_HALF):
        sums[x], sums[_HALF + count + x] = sums[_HALF], sums[_HALF + count - 1]
    for x in range(count):
        total = sums[x] + sums[x + 1] + sums[x + 2] + sums[x + 3] + sums[x + 4]
        means[x] = total / (WINDOW * WINDOW)


@nb.njit(nogil=True, cache=True)
def _guide(start, stop, readings, vector, least):
    """The guide in rows ``start`` to ``stop`` of elements, the first of them even."""
    wide = _reflected(start, stop, readings)
    unlike = np.empty_like(wide)
    height, width = wide.shape
    for i in range(height):
        for j in range(width):
            unlike[i, j] = wide[i, j] * vector[i % SIDE, j % SIDE]
    mean, pairs, spread = np.zeros_like(wide), np.zeros_like(wide), np.zeros_like(wide)
    inner = width - 2 * _REACH
    totals, weights = np.zeros((height, inner)), np.zeros((height, inner))
    for along in range(2):
        _pairs(wide, along, mean)
        _pairs(unlike, along, pairs)
        _spread(pairs, along, spread)
        for i in range(_REACH, height - _REACH):
            total, weight = totals[i], weights[i]
            if along == 0:
                sides = (i - 1, 0, i, 0), (i + 2, 0, i + 1, 0)
            else:
                sides = (i, -1, i, 0), (i, 2, i, 1)
            for row, shift, other, across in sides:
                unlike_there = spread[row, _REACH + shift : _REACH + shift + inner]
                mean_there = mean[other, _REACH + across : _REACH + across + inner]
                for j in range(inner):
                    share = 1.0 / (unlike_there[j] + least)
                    total[j] += share * mean_there[j]
                    weight[j] += share
    guide = np.empty((height - 2 * _REACH, inner))
    for i in range(guide.shape[0]):
        for j in range(inner):
            guide[i, j] = totals[_REACH + i, j] / weights[_REACH + i, j]
    return guide


@nb.njit(cache=True)
def _reflected(start, stop, readings):
    """Rows of a frame and what lies about them, beyond its edges as in a mirror."""
    rows, columns = readings.shape
    down, across = 2 * (rows - 1), 2 * (columns - 1)
    wide = np.empty((stop - start + 2 * _REACH, columns + 2 * _REACH))
    from_column = np.empty(wide.shape[1], np.int64)
    for j in range(wide.shape[1]):
        x = (j - _REACH) % across
        from_column[j] = min(x, across - x)
    for i in range(wide.shape[0]):
        y = (start + i - _REACH) % down
        row = readings[min(y, down - y)]
        for j in range(wide.shape[1]):
            wide[i, j] = row[from_column[j]]
    return wide


@nb.njit(cache=True)
def _pairs(values, along, out):
    """Mean of each element and the one before it along an axis, weighed 1 2 1 across it."""
    height, width = values.shape
    for i in range(1, height - 1):
        above, here, below, row = values[i - 1], values[i], values[i + 1], out[i]
        for j in range(1, width - 1):
            if along == 0:
                middle, sides = above[j] + here[j], above[j - 1] + here[j - 1] + above[j + 1] + here[j + 1]
            else:
                middle, sides = here[j - 1] + here[j], above[j - 1] + above[j] + below[j - 1] + below[j]
            row[j] = 0.25 * middle + 0.125 * sides


@nb.njit(cache=True)
def _spread(pairs, along, out):
    """Mean of absolute values over five elements across an axis and three along it."""
    height, width = pairs.shape
    five = np.zeros_like(pairs)
    for i in range(2 if along else 1, height - (2 if along else 1)):
        row, here = five[i], pairs[i]
        if along == 0:
            for j in range(2, width - 2):
                row[j] = (
                    abs(here[j - 2]) + abs(here[j - 1]) + abs(here[j]) + abs(here[j + 1]) + abs(here[j + 2])
                )
            continue
        a, b, c, d = pairs[i - 2], pairs[i - 1], pairs[i + 1], pairs[i + 2]
        for j in range(1, width - 1):
            row[j] = abs(a[j]) + abs(b[j]) + abs(here[j]) + abs(c[j]) + abs(d[j])
    for i in range(2, height - 2):
        above, here, below, row = five[i - 1], five[i], five[i + 1], out[i]
        if along == 0:
            for j in range(2, width - 2):
                row[j] = (above[j] + here[j] + below[j]) / 15
        else:
            for j in range(2, width - 2):
                row[j] = (here[j - 1] + here[j] + here[j + 1]) / 15


def _filled(values: Array) -> Array:
    """Unknown readings as the mean of their superpixel's known ones, or of the frame's."""
    known = np.isfinite(values)
    if known.all():
        return values
    counts = _superpixels(known).sum(axis=(1, 3))
    sums = _superpixels(np.where(known, values, 0.0)).sum(axis=(1, 3))
    frame = sums.sum() / max(int(counts.sum()), 1)
    means = np.where(counts > 0, sums / np.maximum(counts, 1), frame)
    return np.where(known, values, np.repeat(np.repeat(means, SIDE, axis=0), SIDE, axis=1))


def _superpixels(values: Array) -> Array:
    """The same by superpixel: y, row, x, column."""
    rows, columns = values.shape
    return values.reshape(rows // SIDE, SIDE, columns // SIDE, SIDE)


def demosaic(
    measured: Float[Array, "row column"],
    layout: Superpixel,
    method: str,
    dark: Bool[Array, "y x"] | None = None,
) -> Float[Array, "y x polarizer"]:
    """Readings of every polarizer of each superpixel, brought to one place by a named method.

    Parameters
    ----------
    measured
        What every element reads. [W m⁻² sr⁻¹ µm⁻¹]
    layout
        Superpixel, from `layouts.superpixel`.
    method
        ``"superpixel"`` takes the elements as they lie: where the scene changes within a superpixel their
        differences pass for polarization. ``"bilinear"`` brings each kind of element to the superpixel's
        centre, which removes the part of that error that is linear in position. ``"ppid"``
        (pseudo-panchromatic image difference) does so with what is left of each kind after the local mean of
        all kinds is taken off, and adds that mean over the superpixel: unpolarized texture mostly cancels.
        ``"eari"`` follows the mean of all kinds on the side that no edge crosses (module docstring).
    dark
        Superpixels whose mirror was away: it does not count in the mean of all kinds.

    References
    ----------
    Ratliff, LaCasse and Tyo, "Interpolation strategies for reducing IFOV artifacts in microgrid polarimeter
    imagery", Optics Express 17, 9112 (2009).
    Mihoubi, Lapray and Bigué, "Survey of demosaicking methods for polarization filter array images",
    Sensors 18, 3688 (2018): PPID, there on four polarizers; here a mirror is one more kind.
    """
    side = len(layout)
    polarizers = np.array(places(layout, "polarizer"))
    shape = (measured.shape[0] // side, measured.shape[1] // side)
    readings = np.empty((*shape, len(polarizers)), np.float32)
    if method == "superpixel":
        for k, (row, column) in enumerate(polarizers):
            readings[..., k] = measured[row::side, column::side]
        return readings
    source = np.ascontiguousarray(measured, np.float32)
    expected = np.zeros((*shape, 1), np.float32)  # at the centre, of what is taken off before
    if method != "bilinear":
        source = _without_dark_mirrors(source, layout, dark)
    if method == "ppid":
        difference = np.empty_like(source)
        over_rows(_less_local_mean, len(source), source, side, difference)
        expected = (source - difference).reshape(shape[0], side, shape[1], side).mean(axis=(1, 3))[..., None]
        source = difference
    elif method == "eari":
        source, expected = tentative_values(source, layout)
    over_rows(_to_centre, shape[0], source, polarizers, side, readings)
    readings += expected
    return readings


def polarizer_centroid(layout: Superpixel, method: str) -> Float[Array, "2"]:
    """(row, column) of what `demosaic` returns, from the superpixel's centre. [element]"""
    polarizers = places(layout, "polarizer")
    if method != "superpixel" or not polarizers:
        return np.zeros(2)
    return np.mean(polarizers, axis=0) - (len(layout) - 1) / 2


def boost(degree: Float[Array, "..."], factor: float = PAPER_BOOST) -> Float[Array, "..."]:
    """DoLP multiplied for contrast and cut off at 1, as the paper's Fig. 13(b) has it. [1]"""
    if not factor > 0:
        raise ValueError(f"`factor` must be positive, got {factor}")
    return np.minimum(factor * np.asarray(degree), 1.0)


def _without_dark_mirrors(source: Array, layout: Superpixel, dark: Array | None) -> Array:
    """The same readings; where a mirror was away, the mean of its superpixel's polarizers."""
    found = places(layout, "mirror")
    if dark is None or not dark.any() or not found:
        return source
    side = len(layout)
    y, x = np.nonzero(dark)
    out = source.copy()
    around = [source[y * side + r, x * side + c] for r, c in places(layout, "polarizer")]
    out[y * side + found[0][0], x * side + found[0][1]] = np.mean(around, axis=0)
    return out


@nb.njit(nogil=True, cache=True)
def _less_local_mean(start, stop, source, side, out):
    """Subtract the mean over a window in which every kind of element weighs the same; edges mirror."""
    rows, columns = source.shape
    half = side // 2
    odd = side % 2 == 1
    for i in range(start, stop):
        for j in range(columns):
            total = 0.0
            for di in range(-half, half + 1):
                y = i + di
                y = -y if y < 0 else (2 * (rows - 1) - y if y >= rows else y)
                wy = 1.0 if odd or abs(di) < half else 0.5
                for dj in range(-half, half + 1):
                    x = j + dj
                    x = -x if x < 0 else (2 * (columns - 1) - x if x >= columns else x)
                    wx = 1.0 if odd or abs(dj) < half else 0.5
                    total += wy * wx * source[y, x]
            out[i, j] = source[i, j] - total / (side * side)


@nb.njit(nogil=True, cache=True)
def _to_centre(start, stop, source, polarizers, side, out):
    """Each kind of element at the superpixel's centre, bilinear between its own; edges repeat."""
    rows, columns = out.shape[0], out.shape[1]
    middle = 0.5 * (side - 1)
    for k in range(polarizers.shape[0]):
        row, column = polarizers[k, 0], polarizers[k, 1]
        # an element before the centre: the next of its kind lies on the centre's other side
        down = 1 if row < middle else -1
        right = 1 if column < middle else -1
        wy, wx = abs(row - middle) / side, abs(column - middle) / side
        for i in range(start, stop):
            i1 = min(max(i + down, 0), rows - 1)
            for j in range(columns):
                j1 = min(max(j + right, 0), columns - 1)
                near = (1 - wx) * source[i * side + row, j * side + column]
                near += wx * source[i * side + row, j1 * side + column]
                far = (1 - wx) * source[i1 * side + row, j * side + column]
                far += wx * source[i1 * side + row, j1 * side + column]
                out[i, j, k] = (1 - wy) * near + wy * far
