"""Rays of each element: an even grid of a few, and a second one where those differ too much.

What the first rays met is lit roughly: ρ (E_sun |cos θ| · visible + E_sky · part of the hemisphere), without
interfaces, air or mottle, in one wide band whatever the sensor's. The spread of that light over an element
and those beside it says how far the mean of n rays would be off; the smallest second grid is taken that
brings it under the error asked for. Nothing in it depends on filters or aerosol: cases can share hits.
"""

from dataclasses import dataclass

import numba as nb
import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.render.samples import Samples

FIRST_SIDE = 2  # of the first grid
FURTHER_SIDES = (3, 5, 7, 11)  # of the second: odd ones share no place with the first
BAND_UM = (0.4, 1.0)  # of the light that is estimated
SUN, SKY = 1100.0, 150.0  # irradiance of a clear day over that band, sun overhead and sky [W m⁻² µm⁻¹]
_BESIDE = 0.5  # weight of the four elements beside, in the spread
_LESS_BESIDE = 0.3  # what a spread that only they show counts against one of the element's own rays
# RMS error of the mean of n rays behind the lens is about SCALE √spread / n^FALL, fitted to crops of the
# embedded city at commit 13fd76e: of a wide spread less is left, since much of it lies in fine leaves
SCALE, FALL = 2.35, 0.58


@dataclass(frozen=True)
class Sampling:
    """Error that the mean of an element's rays may have, and the noise it is measured in.

    Parameters
    ----------
    error
        Of the mean, behind the lens. [σ of the noise]
    electrons_per_radiance
        Of a bare element, per band-mean radiance. [e / (W m⁻² sr⁻¹ µm⁻¹)]
    dark_noise_e
        Noise of an element without light. [e]
    """

    error: float
    electrons_per_radiance: float
    dark_noise_e: float


@dataclass(frozen=True)
class RoughLight:
    """What light each material would send, roughly: reflected sun and sky, and sun let through. [e]"""

    sun: Float[Array, "material"]
    sky: Float[Array, "material"]
    through: Float[Array, "material"]


def rough_light(materials: xr.Dataset, electrons_per_radiance: float) -> RoughLight:
    """Electrons from a facet of each material that faces sun and sky in full, on a clear day."""
    um = materials["wavelength"].values
    inside = (um >= BAND_UM[0] - 1e-9) & (um <= BAND_UM[1] + 1e-9)
    weights = inside * um / (inside * um).sum()  # photons
    rho, tau = (materials[name].values @ weights for name in ("reflectance", "transmittance"))
    sun, sky = (electrons_per_radiance / np.pi * light for light in (SUN, SKY))
    return RoughLight(rho * sun, rho * sky, tau * sun)


def further_sides(
    samples: Samples, shape: tuple[int, int], sun: Float[Array, "3"], light: RoughLight, sampling: Sampling
) -> Int[Array, "element"]:
    """Side of the second grid of each element of a frame, 0 for none.

    Parameters
    ----------
    samples
        Of the first grid, of some elements or all.
    shape
        Rows and columns of elements.
    sun
        Unit vector toward the sun. [1]
    light, sampling
        From `rough_light`; what is asked for.
    """
    rows, columns = shape
    moments = np.zeros((rows * columns, 3))
    first = np.concatenate([[0], np.cumsum(samples.count)])
    spectra = light.sun, light.sky, light.through
    over_rows(_add_moments, len(samples.element), samples, first, np.asarray(sun, float), spectra, moments)
    spread = np.zeros(rows * columns)
    over_rows(_spread, rows, columns, moments, sampling.dark_noise_e**2, spread)
    sides = np.zeros(rows * columns, np.int64)
    reached = error_of(spread, FIRST_SIDE**2) <= sampling.error
    for side in FURTHER_SIDES:
        sides[~reached] = side
        reached |= error_of(spread, FIRST_SIDE**2 + side**2) <= sampling.error
    return sides


def error_of(spread: Float[Array, "element"], rays: int) -> Float[Array, "element"]:
    """RMS error of the mean of so many rays, behind the lens. [σ]"""
    return SCALE * np.sqrt(spread) / rays**FALL


@nb.njit(nogil=True, cache=True)
def _add_moments(start, stop, samples, first, sun, spectra, moments):
    """Rays, and the sums of light and its square over them, of each element."""
    from_sun, from_sky, through = spectra
    for k in range(start, stop):
        count = total = squares = 0.0
        for s in range(first[k], first[k + 1]):
            rays, m, value = samples.rays[s], samples.material[s], 0.0
            count += rays
            if m >= 0:
                up = samples.normal[s, 2]
                cosine = samples.normal[s, 0] * sun[0] + samples.normal[s, 1] * sun[1] + up * sun[2]
                lit = samples.sun_visible[s] * (from_sun[m] * cosine if cosine > 0 else -through[m] * cosine)
                dim = from_sky[m] * 0.5 * (1.0 + up)
                value = lit + dim
                if rays > 1.0:  # a sample of several rays that is lit in part is two values
                    part = samples.sun_visible[s]
                    squares += rays * lit * (1.0 - part) * (lit / part if part > 0 else 0.0)
            total += rays * value
            squares += rays * value * value
        moments[samples.element[k], 0] = count
        moments[samples.element[k], 1] = total
        moments[samples.element[k], 2] = squares


@nb.njit(nogil=True, cache=True)
def _spread(start, stop, columns, moments, dark, out):
    """Standard deviation of light over an element and those beside it, in σ of the noise."""
    rows = len(moments) // columns
    for row in range(start, stop):
        for column in range(columns):
            k = row * columns + column
            n, total, squares = moments[k, 0], moments[k, 1], moments[k, 2]
            if n == 0.0:
                continue
            own = squares / n - (total / n) ** 2
            for step in range(4):
                r, c = row + (step == 0) - (step == 1), column + (step == 2) - (step == 3)
                if 0 <= r < rows and 0 <= c < columns:
                    beside = r * columns + c
                    n += _BESIDE * moments[beside, 0]
                    total += _BESIDE * moments[beside, 1]
                    squares += _BESIDE * moments[beside, 2]
            mean = total / n
            around = squares / n - mean * mean
            widest = max(own, _LESS_BESIDE**2 * around, 0.0)
            out[k] = np.sqrt(widest / (max(mean, 0.0) + dark))
