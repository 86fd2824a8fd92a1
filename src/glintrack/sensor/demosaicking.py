"""Demosaicking: interpolation of the readings of a superpixel's polarizers to one place.

Readings are scaled so that unpolarized light reads its own radiance behind every polarizer. Stokes vectors
follow by the inverse of the analyser matrix (`layouts.invert`): of the measured responses, or of ideal
polarizers, which for 0°, 60° and 120° is Fesenkov's formula.

The method ``"eari"`` interpolates residuals along edges:

1. *Guide.* S0 at each element is the mean over a window of two elements by three, weighed 1 2 1, on each of
   its four sides: every kind weighs the same in it. The four means are weighed by 1/D. D is the distance of
   a side's readings from those of any one Stokes vector: |n · r| with n · A = 0 for the analyser rows A
   of the superpixel's four elements, averaged over three elements by five. For 0°, 45°, 90° and 135° that is
   |r₀ + r₉₀ − r₄₅ − r₁₃₅| (Morimatsu 2020); a mirror is one more row here.
2. *Tentative value.* Each kind is modelled as a·guide + b. Least squares over the neighbouring superpixels
   give a and b, which are then averaged over the same ones (the guided filter of He 2013, as in Kiku 2013).
3. *Residual.* The residuals (reading less tentative value) are interpolated bilinearly to the superpixel's
   centre and added to the tentative value there.

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

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import correlate

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.sensor.layouts import Superpixel, analyser_matrix, places

PAPER_BOOST = 5.0  # §4.1 and Fig. 13(b)
SIDE = 2  # of a superpixel: four elements and three Stokes components leave one n
WINDOW = 5  # superpixels across, over which a and b are found
_HALF = WINDOW // 2
_REACH = 4  # elements over which the guide looks beyond the edge; even, so that kinds stay in step
_MIN_DISTANCE = 1e-6  # of the mean reading: D below this counts as none
_FLAT = 1e-3  # of the local mean: a guide that varies less does not determine a
_TINY = float(np.finfo(float).tiny)


def tentative_values(
    measured: Float[Array, "row column"], layout: Superpixel
) -> tuple[Float[Array, "row column"], Float[Array, "y x polarizer"]]:
    """Residuals of the polarizers' readings, and tentative values at the superpixels' centres.

    Parameters
    ----------
    measured
        Reading of every element; NaN where it is not known. [W m⁻² sr⁻¹ µm⁻¹]
    layout
        Superpixel of 2 × 2.

    Returns
    -------
    Residuals, 0 at other kinds of elements and NaN where the reading is; tentative values.
    """
    measured = np.asarray(measured, np.float32)
    filled = _fill_gaps(measured.astype(np.float64))
    guide = _guide(filled, inconsistency(layout))
    centre = 0.25 * (guide[::2, ::2] + guide[::2, 1::2] + guide[1::2, ::2] + guide[1::2, 1::2])
    residual, tentative = np.zeros(measured.shape, np.float32), []
    for i, j in places(layout, "polarizer"):
        own = slice(i, None, SIDE), slice(j, None, SIDE)
        g, v = guide[own], filled[own]
        mean_g, mean_v = _window_means(g), _window_means(v)
        variance = _window_means(g * g) - mean_g * mean_g
        slope = (_window_means(g * v) - mean_g * mean_v) / (variance + (_FLAT * mean_g) ** 2 + _TINY)
        slope, offset = _window_means(slope), _window_means(mean_v - slope * mean_g)
        residual[own] = measured[own] - (slope * g + offset)
        tentative.append((slope * centre + offset).astype(np.float32))
    return residual, np.stack(tentative, axis=-1)


def inconsistency(layout: Superpixel) -> Float[Array, "row column"]:
    """n of the module's first step: 0 on the readings of any Stokes vector, absolute values with mean 1."""
    rows = np.zeros((SIDE, SIDE, 3))
    rows[..., 0] = 1  # mirrors and open elements
    for place, row in zip(places(layout, "polarizer"), analyser_matrix(layout, 1.0), strict=True):
        rows[place] = row
    vector = np.linalg.svd(rows.reshape(SIDE * SIDE, 3).T)[2][-1].reshape(SIDE, SIDE)
    return vector / np.abs(vector).mean()


def _window_means(values: Array) -> Array:
    """Mean over the superpixels about each one; edges repeat."""
    wide = np.pad(values, _HALF, mode="edge")
    columns = _add_up([wide[k : k + len(values)] for k in range(WINDOW)])
    return _add_up([columns[:, k : k + values.shape[1]] for k in range(WINDOW)]) / WINDOW**2


def _guide(readings: Array, vector: Array) -> Array:
    """Guide at every element; the edges mirror."""
    least = _MIN_DISTANCE * float(np.abs(readings).mean()) + _TINY
    wide, guide = np.pad(readings, _REACH, mode="reflect"), np.empty(readings.shape)
    over_rows(_guide_rows, len(readings) // SIDE, wide, vector, least, guide, least=16, most=32)
    return guide


def _guide_rows(start: int, stop: int, wide: Array, vector: Array, least: float, guide: Array) -> None:
    """Write the guide of rows ``start`` to ``stop`` of superpixels."""
    own = guide[SIDE * start : SIDE * stop]
    wide = wide[SIDE * start : SIDE * stop + 2 * _REACH]
    unlike = wide * np.tile(vector, [n // SIDE for n in wide.shape])
    total, weight = np.zeros((2, *own.shape))
    for turn in (np.asarray, np.transpose):  # pairs of rows, pairs of columns
        rows, columns = turn(own).shape
        mean, distance = _pair_means(turn(wide)), np.abs(_pair_means(turn(unlike)))
        across = _add_up([distance[:, k : k + columns + 2] for k in range(5)])
        spread = _add_up([across[k : k + rows + 5] for k in range(3)]) / 15
        for far, near in ((1, 3), (4, 4)):  # before and behind each element
            share = 1.0 / (spread[far : far + rows, 1 : columns + 1] + least)
            total += turn(share * mean[near : near + rows, 3 : columns + 3])
            weight += turn(share)
    np.divide(total, weight, out=own)


def _pair_means(values: Array) -> Array:
    """Mean of each element and the one before it, weighed 1 2 1 across; without the outermost."""
    up, here = values[:-1], values[1:]
    means = 0.125 * _add_up([up[:, :-2], here[:, :-2], up[:, 2:], here[:, 2:]])
    means += 0.25 * (up[:, 1:-1] + here[:, 1:-1])
    return means


def _add_up(parts: list[Array]) -> Array:
    """Sum of arrays, in one new array."""
    total = parts[0] + parts[1]
    for part in parts[2:]:
        total += part
    return total


def _fill_gaps(values: Array) -> Array:
    """Replace unknown readings by the mean of their superpixel's known ones, or of the frame's."""
    known = np.isfinite(values)
    if known.all():
        return values
    rows, columns = values.shape
    blocks = np.where(known, values, np.nan).reshape(rows // SIDE, SIDE, columns // SIDE, SIDE)
    counts = np.isfinite(blocks).sum(axis=(1, 3))
    sums = np.nansum(blocks, axis=(1, 3))
    frame = sums.sum() / max(int(counts.sum()), 1)
    means = np.where(counts > 0, sums / np.maximum(counts, 1), frame)
    return np.where(known, values, np.kron(means, np.ones((SIDE, SIDE))))


def demosaic(
    measured: Float[Array, "row column"],
    layout: Superpixel,
    method: str,
    dark: Bool[Array, "y x"] | None = None,
) -> Float[Array, "y x polarizer"]:
    """Interpolate the readings of every polarizer of each superpixel to one place by a named method.

    Parameters
    ----------
    measured
        Reading of every element. [W m⁻² sr⁻¹ µm⁻¹]
    layout
        Superpixel, from `layouts.superpixel`.
    method
        ``"superpixel"`` takes the elements where they are: where the scene changes within a superpixel their
        differences appear as polarization. ``"bilinear"`` interpolates each kind of element to the
        superpixel's centre, which removes the part of that error that is linear in position. ``"ppid"``
        (pseudo-panchromatic image difference) interpolates the difference of each kind from the local mean
        of all kinds, and adds that mean over the superpixel: unpolarized texture mostly cancels.
        ``"eari"`` follows the mean of all kinds on the side that no edge crosses (module docstring).
    dark
        Superpixels with a mirror at the spectrometer, which does not count in the mean of all kinds.

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
    source = np.asarray(measured, np.float32)
    expected = np.zeros((*shape, 1), np.float32)  # at the centre, of what is taken off before
    mirrors = places(layout, "mirror")
    if method != "bilinear" and mirrors and dark is not None and dark.any():
        y, x = np.nonzero(dark)
        around = [source[y * side + r, x * side + c] for r, c in polarizers]
        source = source.copy()  # the mean of the superpixel's polarizers at mirrors that are away
        source[y * side + mirrors[0][0], x * side + mirrors[0][1]] = np.mean(around, axis=0)
    if method == "ppid":  # less the mean over a window in which every kind of element weighs the same
        window = np.ones(side + 1 - side % 2)
        window[[0, -1]] = 1.0 if side % 2 else 0.5
        local = correlate(source.astype(float), np.outer(window, window) / side**2, mode="mirror")
        difference = (source - local).astype(np.float32)
        expected = (source - difference).reshape(shape[0], side, shape[1], side).mean(axis=(1, 3))[..., None]
        source = difference
    elif method == "eari":
        source, expected = tentative_values(source, layout)
    for k, place in enumerate(polarizers):
        readings[..., k] = _to_centre(source, place, side)
    readings += expected
    return readings


def _to_centre(source: Array, place: Array, side: int) -> Array:
    """One kind of element at the superpixel's centre, bilinear between its own; edges repeat."""
    values = source[place[0] :: side, place[1] :: side].astype(float)
    away = (side - 1) / 2 - place
    for axis in (1, 0):
        count, share = values.shape[axis], abs(away[axis]) / side
        # an element before the centre: the next of its kind lies on the centre's other side
        other = np.clip(np.arange(count) + (1 if away[axis] > 0 else -1), 0, count - 1)
        values = (1 - share) * values + share * values.take(other, axis)
    return values


def polarizer_centroid(layout: Superpixel, method: str) -> Float[Array, "2"]:
    """(row, column) of the samples of `demosaic`, from the superpixel's centre. [element]"""
    polarizers = places(layout, "polarizer")
    if method != "superpixel" or not polarizers:
        return np.zeros(2)
    return np.mean(polarizers, axis=0) - (len(layout) - 1) / 2


def boost(degree: Float[Array, "..."], factor: float = PAPER_BOOST) -> Float[Array, "..."]:
    """DoLP multiplied for contrast and cut off at 1, as in the paper's Fig. 13(b). [1]"""
    if not factor > 0:
        raise ValueError(f"`factor` must be positive; got {factor}.")
    return np.minimum(factor * np.asarray(degree), 1.0)
