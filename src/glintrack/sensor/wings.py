"""The far wings of the point spread: light that edges diffract and surfaces scatter, on a coarse grid.

The kernels of `point_spread` end a few elements away. What the pupil's edges diffract falls with the third
power of distance and carries 1 to 2 % of the light beyond that; without it the modulation transfer is too
high by so much. What surfaces scatter falls more slowly still. Both are smooth there.
"""

import math
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy.fft import irfft2, next_fast_len, rfft2

from glintrack.core.arrays import Array
from glintrack.sensor.design import SensorDesign

WING_CELL = 4  # elements: the grid the wings are worked out on
_DIFFRACTED_REACH = 64  # elements: less than a tenth of the diffracted wings lies beyond
_PARTS = 6  # samples along a cell


def diffracted_share(design: SensorDesign, wavelength_um: float, half_side_um: float) -> float:
    """Light that the pupil's edges diffract out of a square about the image point. [1]

    Parameters
    ----------
    design
        The sensor.
    wavelength_um
        Of the light. [µm]
    half_side_um
        Half the square's side, several λN. [µm]

    Notes
    -----
    The mean of the Airy pattern's rings is λN/(π³r³); an obscuration ε makes the edge longer by 1 + ε and the
    open area smaller by 1 − ε². The square's outside holds 4√2 λN/(π³a) of it, as
    ∫∫ r⁻³ dA = 4 ∫_{−π/4}^{π/4} (cos θ/a) dθ. Aberrations move light inside the square and leave the edges.
    """
    edge = design.f_number * wavelength_um / (1 - design.optics.obscuration)
    return min(4 * math.sqrt(2) * edge / (math.pi**3 * half_side_um), 0.5)


def with_wings(
    light: Float[Array, "row column"], design: SensorDesign, far_share: float, half_side_um: float
) -> Float[Array, "row column"]:
    """Light on the elements with the wings added.

    Parameters
    ----------
    light
        What the kernels carry of it: 1 − ``far_share``. [radiance]
    design
        The sensor.
    far_share, half_side_um
        What they do not carry, and the square beyond which it falls: `diffracted_share`. [1, µm]

    Returns
    -------
    All of it, the frame repeated at its edges. [radiance]

    References
    ----------
    Pfisterer, "Approximated scatter models for stray light analysis", OPN 22(10), 16 (2011): BSDF =
    A/(B + |β − β₀|^g); here normalised to the design's ``scatter_fraction``.
    """
    optics = design.optics
    rows, columns = light.shape
    shape = -(-rows // WING_CELL), -(-columns // WING_CELL)
    margin = (0, shape[0] * WING_CELL - rows), (0, shape[1] * WING_CELL - columns)
    coarse = np.pad(light, margin, mode="edge").reshape(shape[0], WING_CELL, shape[1], WING_CELL)
    coarse = coarse.mean(axis=(1, 3)) / (1 - far_share)
    reach = max(shape) if optics.scatter_fraction else min(_DIFFRACTED_REACH // WING_CELL, max(shape))
    kernel = (1 - optics.scatter_fraction) * _diffracted(reach, half_side_um / design.pitch_um, far_share)
    if optics.scatter_fraction:
        step_mrad = WING_CELL * design.pitch_um / design.focal_length_mm
        kernel = kernel + optics.scatter_fraction * _scattered(
            reach, step_mrad / optics.scatter_shoulder_mrad, optics.scatter_slope
        )
    wide = _spread(np.pad(coarse, reach, mode="edge"), kernel)
    wings = _between(_between(wide.astype(np.float32).T, columns).T, rows)
    return np.float32(1 - optics.scatter_fraction) * light + wings


def _spread(cells: Array, kernel: Array) -> Array:
    """Convolution of cells with a kernel where it lies wholly within them.

    `scipy.signal.fftconvolve` does the same; to load it takes as long as to load the rest of the sensor.
    """
    whole = tuple(a + b - 1 for a, b in zip(cells.shape, kernel.shape, strict=True))
    size = tuple(next_fast_len(n, real=True) for n in whole)
    product = np.asarray(rfft2(cells, size)) * np.asarray(rfft2(kernel, size))
    rows, columns = (slice(n - 1, m) for n, m in zip(kernel.shape, cells.shape, strict=True))
    return np.asarray(irfft2(product, size))[rows, columns]


def _between(cells: Array, elements: int) -> Array:
    """Values of cells at the elements down them, linear between the middles of cells."""
    at = np.clip((np.arange(elements) + 0.5) / WING_CELL - 0.5, 0, len(cells) - 1)
    low = np.minimum(at.astype(int), max(len(cells) - 2, 0))
    part = (at - low).astype(np.float32)[:, None]
    return cells[low] * (1 - part) + cells[np.minimum(low + 1, len(cells) - 1)] * part


@lru_cache(maxsize=16)
def _diffracted(reach: int, half_side: float, share: float) -> Array:
    """Wings ∝ r⁻³ outside a square of so many elements, per cell, summing to their share."""
    place = WING_CELL * np.abs(_places(reach))
    y, x = place[:, None], place[None]
    return share * _per_cell(np.where(np.maximum(y, x) > half_side, np.hypot(y, x), np.inf) ** -3.0, reach)


@lru_cache(maxsize=16)
def _scattered(reach: int, step: float, slope: float) -> Array:
    """ABg wings per cell of so many shoulders, summing to 1."""
    place = _places(reach)
    return _per_cell(1 / (1 + (step * np.hypot(place[:, None], place[None])) ** slope), reach)


def _places(reach: int) -> Array:
    """Samples over the cells to either side of the middle one. [cell]"""
    return (np.arange((2 * reach + 1) * _PARTS) + 0.5) / _PARTS - 0.5 - reach


def _per_cell(wings: Array, reach: int) -> Array:
    cells = 2 * reach + 1
    sums = wings.reshape(cells, _PARTS, cells, _PARTS).sum(axis=(1, 3))
    return sums / sums.sum()
