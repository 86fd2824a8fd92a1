"""Stokes vectors from the polarizer elements of a superpixel."""

import numpy as np
from jaxtyping import Float

from ..stokes import fesenkov
from .design import LAYOUTS

Array = np.ndarray


def superpixel_stokes(
    measured: Float[Array, "row column"], layout: str, demosaic: str = "bilinear"
) -> Float[Array, "y x 3"]:
    """S0, S1, S2 of each superpixel by Fesenkov's formula for ideal polarizers.

    Parameters
    ----------
    measured
        Calibrated radiance behind every element of the array. [W m⁻² sr⁻¹ µm⁻¹]
    layout
        Superpixel layout by name; must hold polarizers at 0°, 60° and 120°.
    demosaic
        ``"superpixel"`` takes the three elements as they lie: where the scene changes within a superpixel
        their differences pass for polarization. ``"bilinear"`` first brings each kind of element to the
        superpixel's centre, which removes the part of that error that is linear in position.

    Returns
    -------
    Detector frame, one vector a superpixel. [W m⁻² sr⁻¹ µm⁻¹]

    References
    ----------
    Ratliff, LaCasse and Tyo, "Interpolation strategies for reducing IFOV artifacts in microgrid polarimeter
    imagery", Optics Express 17, 9112 (2009).
    """
    at = {what: place for place, what in LAYOUTS[layout].items()}
    planes = []
    for angle in (0.0, 60.0, 120.0):
        row, column = at[angle]
        plane = measured[row::2, column::2]
        planes.append(_at_centre(plane, row, column) if demosaic == "bilinear" else plane)
    return fesenkov(*planes)


def _at_centre(plane: Float[Array, "y x"], row: int, column: int) -> Float[Array, "y x"]:
    """Samples that lie a quarter superpixel off the centre, interpolated to it; edges repeat."""
    for axis, place in ((0, row), (1, column)):
        # an element at place 0 lies before the centre: the next one of its kind lies on the other side
        padded = np.concatenate([plane.take([0], axis), plane, plane.take([-1], axis)], axis)
        length = plane.shape[axis]
        start = 2 if place == 0 else 0
        plane = 0.75 * plane + 0.25 * padded.take(range(start, start + length), axis)
    return plane
