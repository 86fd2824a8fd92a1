"""Displacement between two images, to a fraction of a pixel, by phase correlation.

Both spectra are whitened, so that texture of every scale has the same weight and brightness none. The peak of
their correlation is found to a hundredth of a pixel by a matrix Fourier transform around it, after
Guizar-Sicairos, Thurman and Fienup, Optics Letters 33, 156 (2008). The borders of the two images agree where
their contents do not, which biases the peak toward 0: the image is shifted back and compared again.
"""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt, shift

from glintrack.core.arrays import Array

_STEP_PX = 0.01
_REACH_PX = 1.0  # searched finely around the whole-pixel peak
_MIN_CLEARNESS = 2.0  # a peak over the next one elsewhere; chance reaches 1.5
_MIN_SIDE = 8
_ITERATIONS = 5
_CONTENT = 0.1  # of the mean strength: weaker frequencies count less


def displacement_between(
    image: Float[Array, "y x"], reference: Float[Array, "y x"], max_px: float = 16.0
) -> tuple[float, float, float]:
    """Displacement (rows, columns) of an image's content against a reference, and its clearness.

    Parameters
    ----------
    image, reference
        Two images of one size; pixels that are NaN in either are ignored in both.
    max_px
        Largest displacement of the search. [pixel]

    Returns
    -------
    rows, columns
        Content at (y, x) of the reference is at (y + rows, x + columns) of the image; NaN where no peak
        is significant. [pixel]
    clearness
        Peak over the highest value more than three pixels away from it, within the search. [1]

    Raises
    ------
    ValueError
        If the sizes differ or are under eight pixels.
    """
    image, reference = np.asarray(image, float), np.asarray(reference, float)
    if image.shape != reference.shape or min(image.shape, default=0) < _MIN_SIDE:
        raise ValueError(
            f"`image` and `reference` must be of one size, {_MIN_SIDE} pixels a side at least; "
            f"got {image.shape} and {reference.shape}."
        )
    total = np.zeros(2)
    clearness = 0.0
    for k in range(_ITERATIONS):
        moved = image
        if k:  # shifted back, cubic over its data; NaN where data are missing
            known = np.isfinite(image)
            filled = np.where(known, image, image[known].mean())
            there = shift(known.astype(float), -total, order=1, mode="constant", cval=0.0)
            moved = np.where(there > 0.99, shift(filled, -total, order=3, mode="nearest"), np.nan)
        step, clear = _correlate(moved, reference, max_px if k == 0 else 2.0)
        if k == 0:
            clearness = clear
            if not clear >= _MIN_CLEARNESS:
                return float("nan"), float("nan"), clear
        if not np.isfinite(step).all():
            break
        total = total + step
        if np.hypot(*step) < _STEP_PX:
            break
    rows, columns = np.round(total, 4).tolist()  # finer than the search, coarser than its arithmetic
    return rows, columns, clearness


def _correlate(image: Array, reference: Array, max_px: float) -> tuple[Array, float]:
    """Displacement by one correlation, biased toward 0 by borders and holes, and its clearness."""
    both = np.isfinite(image) & np.isfinite(reference)
    if both.mean() < 0.25:
        return np.full(2, np.nan), 0.0
    first, second = (np.fft.fft2(_fade_borders(picture, both)) for picture in (image, reference))
    cross = first * second.conj()
    strength = np.abs(cross)
    # frequencies without content would only add the window's own pattern
    cross = cross / (strength + max(_CONTENT * float(strength.mean()), 1e-300))
    # the highest frequencies hold noise and aliases only
    fy, fx = np.fft.fftfreq(image.shape[0]), np.fft.fftfreq(image.shape[1])
    cross = cross * np.exp(-((fy[:, None] ** 2 + fx[None] ** 2) / 0.25**2))
    rows, columns, clearness = _find_peak(np.fft.ifft2(cross).real, max_px)
    fine = np.arange(-_REACH_PX, _REACH_PX + _STEP_PX / 2, _STEP_PX)
    down = np.exp(2j * np.pi * np.outer(rows + fine, fy))
    across = np.exp(2j * np.pi * np.outer(fx, columns + fine))
    near = np.real(down @ cross @ across)
    i, j = np.unravel_index(near.argmax(), near.shape)
    return np.array([rows + fine[i], columns + fine[j]]), clearness


def _fade_borders(picture: Array, both: Array) -> Array:
    """Subtract the mean of an image, and fade it out toward its border and missing pixels."""
    values = np.where(both, picture, 0.0)
    values = np.where(both, values - values[both].mean(), 0.0)
    width = float(np.clip(min(both.shape) / 8, 4, 24))
    depth = np.asarray(distance_transform_edt(np.pad(both, 1)))[1:-1, 1:-1]
    return values * (0.5 - 0.5 * np.cos(np.pi * np.minimum(depth / width, 1.0)))


def _find_peak(surface: Array, max_px: float) -> tuple[int, int, float]:
    """Whole-pixel peak within reach, and its height over the highest value away from it."""
    rows, columns = (np.fft.fftfreq(n, 1 / n).round().astype(int) for n in surface.shape)
    reach = np.hypot(rows[:, None], columns[None]) <= max(max_px, 1.0)
    within = np.where(reach, surface, -np.inf)
    i, j = np.unravel_index(within.argmax(), surface.shape)
    away = reach & (np.hypot(rows[:, None] - rows[i], columns[None] - columns[j]) > 3)
    # among few displacements chance leaves no high value: the spread of the whole surface counts as well
    other = max(float(surface[away].max(initial=0.0)), float(surface.std()))
    return int(rows[i]), int(columns[j]), float(surface[i, j]) / max(other, 1e-300)
