"""Lens distortion: Brown's polynomials, affinity and skew.

Brown's coefficients have the order and signs of OpenCV and OpenDroneMap, the others those of Metashape.

Coordinates are tangents of the field angle, x to the image's right and y *down*: a pinhole's image over its
focal length.
"""

import math

import numba as nb
import numpy as np
from jaxtyping import Float
from pydantic import Field

from glintrack.core.arrays import Array
from glintrack.core.designs import Design

NO_DISTORTION = np.zeros(0)  # coefficients of a pinhole, for kernels
_STEPS = 30  # Newton's, at most
_CLOSE_SQUARE = 1e-26  # of a step's length; an element is some 1e-4


def _coefficient(description: str) -> float:
    return Field(default=0.0, ge=-1000, le=1000, description=description)


class Distortion(Design):
    """Coefficients of a lens's distortion; all zero is a pinhole.

    With r² = x² + y², the image is at x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²) and
    y (1 + k1 r² + k2 r⁴ + k3 r⁶) + p1 (r² + 2 y²) + 2 p2 x y; of these x', y' it then is at
    x' + b1 x' + b2 y' and y'. The focal length is that of the scale down the image.

    References
    ----------
    Brown, "Decentering distortion of lenses", Photogrammetric Engineering 32, 444 (1966); Agisoft, Metashape
    User Manual, Appendix D, whose B1 and B2 are in pixels: b1 and b2 times its f.
    """

    k1: float = _coefficient("Radial, of r²; negative is a barrel")
    k2: float = _coefficient("Radial, of r⁴")
    k3: float = _coefficient("Radial, of r⁶")
    p1: float = _coefficient("Tangential, of decentering down the image (P2 of Metashape)")
    p2: float = _coefficient("Tangential, of decentering across the image (P1 of Metashape)")
    b1: float = _coefficient("Affinity: scale across the image over that down it, less one")
    b2: float = _coefficient("Skew: shift across the image with the place down it")

    @property
    def coefficients(self) -> Float[Array, "8"]:
        """k1, k2, k3, p1, p2, the largest r² that the radial polynomial images outward, b1 and b2. [1]"""
        slope = [7 * self.k3, 5 * self.k2, 3 * self.k1, 1.0]  # of r (1 + k1 r² + …) by r, in powers of r²
        found = np.roots(slope)
        turns = found.real[(np.abs(found.imag) < 1e-9) & (found.real > 0)]
        reach = float(turns.min()) if turns.size else math.inf
        return np.array([self.k1, self.k2, self.k3, self.p1, self.p2, reach, self.b1, self.b2])


@nb.njit(cache=True)
def distort(x, y, c):
    """Distorted image of a pinhole's image; NaN beyond the largest r². ``c`` is `Distortion.coefficients`."""
    r2 = x * x + y * y
    if r2 > c[5]:
        return np.nan, np.nan
    radial = 1.0 + r2 * (c[0] + r2 * (c[1] + r2 * c[2]))
    across = 2.0 * c[3] * x * y + c[4] * (r2 + 2.0 * x * x)
    down = c[3] * (r2 + 2.0 * y * y) + 2.0 * c[4] * x * y
    xd, yd = x * radial + across, y * radial + down
    return xd + c[6] * xd + c[7] * yd, yd


@nb.njit(cache=True)
def undistort(xd, yd, c):
    """Invert `distort` at (xd, yd) by Newton's iteration; NaN if no image of a pinhole leads there."""
    if not abs(1.0 + c[6]) > 1e-12:
        return np.nan, np.nan
    xd = (xd - c[7] * yd) / (1.0 + c[6])
    x, y = xd, yd
    for _ in range(_STEPS):
        r2 = x * x + y * y
        radial = 1.0 + r2 * (c[0] + r2 * (c[1] + r2 * c[2]))
        growth = 2.0 * (c[0] + r2 * (2.0 * c[1] + 3.0 * r2 * c[2]))  # of the radial factor, by r²/2
        fx = x * radial + 2.0 * c[3] * x * y + c[4] * (r2 + 2.0 * x * x) - xd
        fy = y * radial + c[3] * (r2 + 2.0 * y * y) + 2.0 * c[4] * x * y - yd
        xx = radial + growth * x * x + 2.0 * c[3] * y + 6.0 * c[4] * x
        yy = radial + growth * y * y + 6.0 * c[3] * y + 2.0 * c[4] * x
        xy = growth * x * y + 2.0 * c[3] * x + 2.0 * c[4] * y
        determinant = xx * yy - xy * xy
        if not abs(determinant) > 1e-12:
            return np.nan, np.nan
        dx, dy = (yy * fx - xy * fy) / determinant, (xx * fy - xy * fx) / determinant
        x, y = x - dx, y - dy
        if dx * dx + dy * dy < _CLOSE_SQUARE:
            if x * x + y * y <= c[5]:
                return x, y
            break
    return np.nan, np.nan


@nb.njit(nogil=True, cache=True)
def bend_all(x, y, c, inverse):
    """Flat arrays of places through `distort`, or `undistort`, in place."""
    for i in range(len(x)):
        if inverse:
            x[i], y[i] = undistort(x[i], y[i], c)
        else:
            x[i], y[i] = distort(x[i], y[i], c)
