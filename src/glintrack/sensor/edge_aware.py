"""Residual interpolation along edges: what `polarimetry.demosaic` does by the name ``"eari"``.

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
squares left the smaller error of DoLP (docs/polarimetry.md, "Demosaicking on real light").
"""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import convolve1d, uniform_filter, uniform_filter1d

from glintrack.arrays import Array
from glintrack.sensor.layouts import Superpixel, analyser_matrix, places

SIDE = 2  # of a superpixel: four elements and three Stokes components leave one n
WINDOW = 5  # superpixels across, over which a and b are found
_REACH = 4  # elements over which the guide looks beyond the edge; even, so that kinds stay in step
_ALIKE = 1e-6  # of the mean reading: D below this is none
_FLAT = 1e-3  # of the local mean: a guide that varies less says nothing of a


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
    filled = _filled(np.asarray(measured, np.float64))
    guide = edge_aware_guide(filled, layout)
    at_centre = _superpixels(guide).mean(axis=(1, 3))
    residual, found = np.zeros(measured.shape, np.float32), []
    for row, column in places(layout, "polarizer"):
        mine = np.s_[row::SIDE, column::SIDE]
        slope, offset = _line(guide[mine], filled[mine])
        residual[mine] = measured[mine] - (slope * guide[mine] + offset)
        found.append(slope * at_centre + offset)
    return residual, np.stack(found, axis=-1).astype(np.float32)


def edge_aware_guide(readings: Float[Array, "row column"], layout: Superpixel) -> Float[Array, "row column"]:
    """S0 at every element, from the side of it that no edge crosses. [W m⁻² sr⁻¹ µm⁻¹]"""
    wide = np.pad(readings, _REACH, mode="reflect")
    unlike = wide * np.tile(inconsistency(layout), tuple(n // SIDE for n in wide.shape))
    least = _ALIKE * float(np.abs(readings).mean()) + np.finfo(float).tiny
    total, weights = np.zeros_like(wide), np.zeros_like(wide)
    for along in (0, 1):
        across = 1 - along
        mean = _pairs(wide, along)
        spread = uniform_filter1d(np.abs(_pairs(unlike, along)), 5, axis=across)
        spread = uniform_filter1d(spread, 3, axis=along)
        for pair, middle in ((0, -1), (1, 2)):  # before and after: which pair, and the middle of three
            weight = 1 / (np.roll(spread, -middle, axis=along) + least)
            total += weight * np.roll(mean, -pair, axis=along)
            weights += weight
    return (total / weights)[_REACH:-_REACH, _REACH:-_REACH]


def inconsistency(layout: Superpixel) -> Float[Array, "row column"]:
    """n of the module's first step: 0 on the readings of any Stokes vector, absolute values with mean 1."""
    rows = np.zeros((SIDE, SIDE, 3))
    rows[..., 0] = 1  # mirrors and open elements
    for place, row in zip(places(layout, "polarizer"), analyser_matrix(layout, 1.0), strict=True):
        rows[place] = row
    vector = np.linalg.svd(rows.reshape(SIDE * SIDE, 3).T)[2][-1].reshape(SIDE, SIDE)
    return vector / np.abs(vector).mean()


def _pairs(values: Array, along: int) -> Array:
    """Mean of each element and the one before it along an axis, weighed 1 2 1 across it."""
    smooth = convolve1d(values, [0.25, 0.5, 0.25], axis=1 - along)
    return 0.5 * (smooth + np.roll(smooth, 1, axis=along))


def _line(guide: Array, values: Array) -> tuple[Array, Array]:
    """Slope and offset of values over the guide by local least squares, averaged over the window."""

    def mean(of: Array) -> Array:
        return uniform_filter(of, WINDOW, mode="nearest")

    low, level = mean(guide), mean(values)
    varies = mean(guide * guide) - low * low
    slope = (mean(guide * values) - low * level) / (varies + (_FLAT * low) ** 2 + np.finfo(float).tiny)
    return mean(slope), mean(level - slope * low)


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
