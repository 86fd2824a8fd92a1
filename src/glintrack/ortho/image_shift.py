"""Displacement of one picture against another, to a fraction of a pixel, by phase correlation.

Both spectra are whitened, so that texture of every scale counts alike and brightness not at all; the peak of
their correlation is found to a hundredth of a pixel by a matrix Fourier transform around it, after
Guizar-Sicairos, Thurman and Fienup, Optics Letters 33, 156 (2008). The borders of the two pictures agree
where their contents do not, which draws the peak toward nought: the picture is moved back and compared again.
"""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt, shift

from glintrack.core.arrays import Array

_STEP_PX = 0.01
_REACH_PX = 1.0  # searched finely around the whole-pixel peak
_CLEAR = 2.0  # a peak under this many times the next one elsewhere is none; chance reaches 1.5
_LEAST_SIDE = 8
_TURNS = 5
_CONTENT = 0.1  # of the mean strength: weaker frequencies count less


def displacement_between(
    image: Float[Array, "y x"], reference: Float[Array, "y x"], most_px: float = 16.0
) -> tuple[float, float, float]:
    """Displacement (rows, columns) of the picture's content against the reference, and how clear it is.

    Parameters
    ----------
    image, reference
        Two pictures of one size; NaN where there is no data, which neither then has a say in.
    most_px
        Larger displacements are not looked for. [pixel]

    Returns
    -------
    rows, columns
        Content at (y, x) of the reference is at (y + rows, x + columns) of the image; NaN where no peak
        stands out. [pixel]
    clearness
        Peak over the highest value more than three pixels away from it, among displacements looked for. [1]

    Raises
    ------
    ValueError
        If the sizes differ or are under eight pixels.
    """
    image, reference = np.asarray(image, float), np.asarray(reference, float)
    if image.shape != reference.shape or min(image.shape, default=0) < _LEAST_SIDE:
        raise ValueError(
            f"`image` and `reference` must be of one size, {_LEAST_SIDE} pixels a side at least, "
            f"got {image.shape} and {reference.shape}"
        )
    total = np.zeros(2)
    clearness = 0.0
    for turn in range(_TURNS):
        moved = image if turn == 0 else _moved_back(image, total)
        step, clear = _one_step(moved, reference, most_px if turn == 0 else 2.0)
        if turn == 0:
            clearness = clear
            if not clear >= _CLEAR:
                return float("nan"), float("nan"), clear
        if not np.isfinite(step).all():
            break
        total = total + step
        if np.hypot(*step) < _STEP_PX:
            break
    rows, columns = np.round(total, 4).tolist()  # finer than the search, coarser than its arithmetic
    return rows, columns, clearness


def _one_step(image: Array, reference: Array, most_px: float) -> tuple[Array, float]:
    """Displacement as one correlation shows it, drawn toward nought by what stays: borders and holes."""
    both = np.isfinite(image) & np.isfinite(reference)
    if both.mean() < 0.25:
        return np.full(2, np.nan), 0.0
    first, second = (np.fft.fft2(_windowed(picture, both)) for picture in (image, reference))
    cross = first * second.conj()
    strength = np.abs(cross)
    # frequencies without content would only add the window's own pattern
    cross = cross / (strength + max(_CONTENT * float(strength.mean()), 1e-300))
    # the highest frequencies hold noise and aliases only
    fy, fx = np.fft.fftfreq(image.shape[0]), np.fft.fftfreq(image.shape[1])
    cross = cross * np.exp(-((fy[:, None] ** 2 + fx[None] ** 2) / 0.25**2))
    rows, columns, clearness = _whole_peak(np.fft.ifft2(cross).real, most_px)
    return np.array(_refined(cross, fy, fx, rows, columns)), clearness


def _moved_back(image: Array, by: Array) -> Array:
    """The image displaced by −``by``, cubic over its data, missing where its data are."""
    known = np.isfinite(image)
    filled = np.where(known, image, image[known].mean())
    moved = shift(filled, -by, order=3, mode="nearest")
    there = shift(known.astype(float), -by, order=1, mode="constant", cval=0.0)
    return np.where(there > 0.99, moved, np.nan)


def _windowed(picture: Array, both: Array) -> Array:
    """The picture less its mean, faded out toward its border and toward what is missing."""
    values = np.where(both, picture, 0.0)
    values = np.where(both, values - values[both].mean(), 0.0)
    width = float(np.clip(min(both.shape) / 8, 4, 24))
    depth = np.asarray(distance_transform_edt(np.pad(both, 1)))[1:-1, 1:-1]
    return values * (0.5 - 0.5 * np.cos(np.pi * np.minimum(depth / width, 1.0)))


def _whole_peak(surface: Array, most_px: float) -> tuple[int, int, float]:
    """Whole-pixel peak within reach, and its height over the highest value away from it."""
    rows, columns = (np.fft.fftfreq(n, 1 / n).round().astype(int) for n in surface.shape)
    reach = np.hypot(rows[:, None], columns[None]) <= max(most_px, 1.0)
    within = np.where(reach, surface, -np.inf)
    i, j = np.unravel_index(within.argmax(), surface.shape)
    away = reach & (np.hypot(rows[:, None] - rows[i], columns[None] - columns[j]) > 3)
    # among few displacements chance leaves no high value: the spread of the whole surface counts as well
    other = max(float(surface[away].max(initial=0.0)), float(surface.std()))
    return int(rows[i]), int(columns[j]), float(surface[i, j]) / max(other, 1e-300)


def _refined(cross: Array, fy: Array, fx: Array, rows: int, columns: int) -> tuple[float, float]:
    fine = np.arange(-_REACH_PX, _REACH_PX + _STEP_PX / 2, _STEP_PX)
    down = np.exp(2j * np.pi * np.outer(rows + fine, fy))
    across = np.exp(2j * np.pi * np.outer(fx, columns + fine))
    near = np.real(down @ cross @ across)
    i, j = np.unravel_index(near.argmax(), near.shape)
    return float(rows + fine[i]), float(columns + fine[j])
