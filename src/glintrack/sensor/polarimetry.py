"""Stokes vectors and degree of polarization from the polarizer elements of a superpixel.

What an element reads is scaled so that unpolarized light reads its own radiance behind every polarizer.
Stokes vectors follow by the inverse of the analyser matrix (`layouts.invert`): of the measured responses, or
of ideal polarizers, which for 0°, 60° and 120° is Fesenkov's formula.
"""

import numba as nb
import numpy as np
from jaxtyping import Bool, Float

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.sensor.edge_aware import tentative_values
from glintrack.sensor.layouts import Superpixel, places
from glintrack.sensor.sensor import Sensor
from glintrack.stokes import aop, dolp

PAPER_BOOST = 5.0  # §4.1 and Fig. 13(b)


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
        ``"eari"`` follows the mean of all kinds on the side that no edge crosses (`edge_aware`).
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


def stokes_noise(sensor: Sensor, stokes: Float[Array, "y x 3"], dark_noise_e: float) -> Float[Array, "y x 3"]:
    """RMS of each Stokes component from shot and dark noise, without demosaicking's smoothing.

    Parameters
    ----------
    sensor
        With polarizers.
    stokes
        A frame's ``stokes_radiance``. [W m⁻² sr⁻¹ µm⁻¹]
    dark_noise_e
        From `focalplane.dark_noise_e`. [e]
    """
    if sensor.stokes_matrix is None:
        raise ValueError(f"`sensor` must have polarizers, got layout {sensor.design.layout!r}")
    polarizers = places(sensor.design.superpixel, "polarizer")
    gain = np.array([sensor.electrons_per_reading[place] for place in polarizers])
    total_e = np.maximum(stokes[..., :1], 0) * gain  # the polarized part cancels in the mean over angles
    variance = (total_e + dark_noise_e**2) / gain**2
    return np.sqrt(variance @ (sensor.stokes_matrix.T**2))


def debiased_dolp(
    stokes: Float[Array, "... 3"], noise: Float[Array, "... 3"], signal_to_noise: float = 3.0
) -> Float[Array, "..."]:
    """DoLP without the bias that noise gives it, masked where S0 is lost in noise. [1]

    Parameters
    ----------
    stokes, noise
        Vectors and the RMS of their components, as `stokes_noise` gives it. [radiance]
    signal_to_noise
        S0 over its noise under which a pixel is masked (NaN).

    References
    ----------
    Plaszczynski, Montier, Levrier and Tristram, "A novel estimator of the polarization amplitude from
    normally distributed Stokes parameters", MNRAS 439, 4048 (2014), Eq. (37): p − b²(1 − e^(−p²/b²))/(2p).
    """
    p = dolp(stokes)
    lit = np.asarray(stokes)[..., 0] > signal_to_noise * np.asarray(noise)[..., 0]
    s1, s2 = np.asarray(stokes, float)[..., 1], np.asarray(stokes, float)[..., 2]
    n1, n2 = np.asarray(noise, float)[..., 1], np.asarray(noise, float)[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        # noise along the direction in which the polarization points, relative to S0
        share = np.where(s1**2 + s2**2 > 0, s1**2 / (s1**2 + s2**2), 0.5)
        b2 = ((1 - share) * n1**2 + share * n2**2) / np.asarray(stokes, float)[..., 0] ** 2
        corrected = p - b2 * (1 - np.exp(-(p**2) / b2)) / (2 * p)
        corrected = np.where(b2 > 0, corrected, p)
    return np.where(lit, np.where(p > 0, corrected, 0.0), np.nan)


def masked_aop(
    stokes: Float[Array, "... 3"], noise: Float[Array, "... 3"], signal_to_noise: float = 3.0
) -> Float[Array, "..."]:
    """Angle of polarization, NaN where the polarized part is under ``signal_to_noise`` of its noise. [rad]"""
    s, n = np.asarray(stokes, float), np.asarray(noise, float)
    polarized = np.hypot(s[..., 1], s[..., 2])
    scale = np.hypot(n[..., 1], n[..., 2]) / np.sqrt(2)
    return np.where(polarized > signal_to_noise * scale, aop(s), np.nan)


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
