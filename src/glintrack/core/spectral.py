"""Wavelength grids, band responses and integration over them.

Wavelengths are in µm, spectra per µm. Band values are *means* over the response, per µm, unless a name ends
in ``_integrated``.
"""

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from glintrack.core.arrays import Array

MIN_WAVELENGTH_UM, MAX_WAVELENGTH_UM = 0.4, 2.5
STANDARD_STEP_UM = 0.01
MIN_STEP_UM = 1e-5
_ROUNDING_UM = 1e-9


def wavelength_grid(
    start_um: float = MIN_WAVELENGTH_UM, stop_um: float = MAX_WAVELENGTH_UM, step_um: float = STANDARD_STEP_UM
) -> Float[Array, "wavelength"]:
    """Evenly spaced wavelengths, both ends included; the default is the paper's 211 bands. [µm]

    Raises
    ------
    ValueError
        If the range leaves 0.4 to 2.5 µm, is empty, or is not a whole number of steps, or a step is below
        0.01 nm.
    """
    if not MIN_WAVELENGTH_UM <= start_um < stop_um <= MAX_WAVELENGTH_UM:
        raise ValueError(
            f"`wavelength` range must rise within {MIN_WAVELENGTH_UM} to {MAX_WAVELENGTH_UM} µm; "
            f"got {start_um} to {stop_um}."
        )
    if 0 < step_um < MIN_STEP_UM:
        raise ValueError(f"`step_um` must be at least {MIN_STEP_UM:g} µm; got {step_um:g}.")
    steps = (stop_um - start_um) / step_um if step_um > 0 else np.nan
    # a millionth of a step: rounding of decimal steps only
    if not (steps > 0.5 and abs(steps - np.rint(steps)) < 1e-6):
        raise ValueError(f"`step_um` must divide {start_um} to {stop_um} µm into whole steps; got {step_um}.")
    return np.round(np.linspace(start_um, stop_um, round(steps) + 1), 9)


def quadrature_weights(wavelength_um: Float[Array, "wavelength"]) -> Float[Array, "wavelength"]:
    """Trapezoid weights: ``weights @ spectrum`` is ∫ spectrum dλ; a single wavelength has 1 µm. [µm]"""
    wavelength_um = check_wavelengths(wavelength_um)
    if wavelength_um.size == 1:
        return np.ones(1)
    gaps = np.diff(wavelength_um)
    return 0.5 * (np.r_[gaps, 0.0] + np.r_[0.0, gaps])


def check_wavelengths(wavelength_um: ArrayLike, name: str = "wavelength_um") -> Float[Array, "wavelength"]:
    """Refuse wavelengths that are empty, not rising, or outside 0.4 to 2.5 µm. [µm]"""
    wavelength_um = np.atleast_1d(np.asarray(wavelength_um, dtype=float))
    if wavelength_um.size == 0:
        raise ValueError(f"`{name}` must name at least one wavelength; got none.")
    inside = (wavelength_um >= MIN_WAVELENGTH_UM - 1e-9) & (wavelength_um <= MAX_WAVELENGTH_UM + 1e-9)
    if not inside.all():
        raise ValueError(
            f"`{name}` must lie within {MIN_WAVELENGTH_UM} to {MAX_WAVELENGTH_UM} µm; "
            f"got {wavelength_um[~inside][0]:g}."
        )
    if np.any(np.diff(wavelength_um) <= 0):
        raise ValueError(f"`{name}` must rise; got {wavelength_um.tolist()[:6]}…")
    return wavelength_um


def resample(
    wavelength_um: Float[Array, "wavelength"],
    table_um: Float[Array, "node"],
    values: Float[Array, "*rest node"],
    name: str = "spectrum",
) -> Float[Array, "*rest wavelength"]:
    """Interpolate a table linearly along its last axis; wavelengths outside its range are an error.

    Parameters
    ----------
    wavelength_um
        Wavelengths to evaluate at. [µm]
    table_um
        Rising wavelengths of the table. [µm]
    values
        Table, last axis ``node``.
    name
        Name of the table in error messages.
    """
    table_um, values = np.asarray(table_um, dtype=float), np.asarray(values, dtype=float)
    wavelength_um = np.asarray(wavelength_um, dtype=float)
    if wavelength_um.min() < table_um[0] - 1e-9 or wavelength_um.max() > table_um[-1] + 1e-9:
        raise ValueError(
            f"`{name}` must cover {wavelength_um.min():g} to {wavelength_um.max():g} µm; "
            f"got data from {table_um[0]:g} to {table_um[-1]:g} µm."
        )
    flat = values.reshape(-1, values.shape[-1])
    out = np.stack([np.interp(wavelength_um, table_um, row) for row in flat])
    return out.reshape(*values.shape[:-1], wavelength_um.size)


def check_band(name: str, start_um: float, stop_um: float) -> None:
    """Refuse band edges that do not rise within 0.4 to 2.5 µm."""
    if not MIN_WAVELENGTH_UM <= start_um < stop_um <= MAX_WAVELENGTH_UM:
        raise ValueError(
            f"`{name}` must rise within {MIN_WAVELENGTH_UM} to {MAX_WAVELENGTH_UM} µm; "
            f"got {start_um} to {stop_um}."
        )


def band_response(
    start_um: float, stop_um: float, wavelength_um: Float[Array, "wavelength"]
) -> Float[Array, "wavelength"]:
    """Response of a flat band: 1 inside, ½ at a wavelength on its edge, 0 outside. [1]"""
    check_band("band", start_um, stop_um)
    return share_of_cells(start_um, stop_um, wavelength_um)


def share_of_cells(
    start_um: ArrayLike, stop_um: ArrayLike, wavelength_um: Float[Array, "wavelength"]
) -> Float[Array, "*band wavelength"]:
    """Fraction of the cell around each wavelength that lies in a band. [1]

    Cells end halfway between wavelengths, and at the ends of the grid. Their widths are the
    `quadrature_weights`. A single wavelength is 1 inside a band and 0 outside.
    """
    wavelength_um = np.asarray(wavelength_um, dtype=float)
    start, stop = (np.asarray(edge, dtype=float)[..., None] for edge in (start_um, stop_um))
    if wavelength_um.size == 1:
        is_below, is_above = wavelength_um < start - _ROUNDING_UM, wavelength_um > stop + _ROUNDING_UM
        return (~is_below & ~is_above).astype(float)
    between = (wavelength_um[1:] + wavelength_um[:-1]) / 2
    edges = np.r_[wavelength_um[0], between, wavelength_um[-1]]
    inside = np.clip(np.minimum(edges[1:], stop) - np.maximum(edges[:-1], start), 0, None)
    return np.round(inside / np.diff(edges), 9)  # whole cells are exactly 1


def channel_weights(
    wavelength_um: Float[Array, "wavelength"], responses: Float[Array, "channel wavelength"]
) -> Float[Array, "channel wavelength"]:
    """Weights whose product with a spectrum is its response-weighted *mean*. [1]

    Parameters
    ----------
    wavelength_um
        Rising wavelengths. [µm]
    responses
        Relative response of each channel, not negative. [1]

    Raises
    ------
    ValueError
        If a channel has no response on the grid.
    """
    weights = np.asarray(responses, dtype=float) * quadrature_weights(wavelength_um)
    total = weights.sum(axis=-1, keepdims=True)
    if np.any(total <= 0) or not np.isfinite(total).all():
        raise ValueError(
            f"`responses` must be positive somewhere on the wavelength grid; "
            f"got channel {int(np.argmin(total))} with none."
        )
    return weights / total


def cie_xyz(wavelength_um: Float[Array, "wavelength"]) -> Float[Array, "3 wavelength"]:
    """CIE 1931 2° colour-matching functions x̄, ȳ, z̄, for pictures. [1]

    References
    ----------
    Wyman, Sloan and Shirley, "Simple Analytic Approximations to the CIE XYZ Color Matching Functions",
    JCGT 2(2), 2013, the multi-lobe fit.
    """
    nm = np.asarray(wavelength_um, dtype=float) * 1e3

    def lobe(peak: float, centre: float, below: float, above: float) -> Array:
        t = (nm - centre) * np.where(nm < centre, below, above)
        return peak * np.exp(-0.5 * t * t)

    x = lobe(0.362, 442.0, 0.0624, 0.0374) + lobe(1.056, 599.8, 0.0264, 0.0323)
    x = x + lobe(-0.065, 501.1, 0.0490, 0.0382)
    y = lobe(0.821, 568.8, 0.0213, 0.0247) + lobe(0.286, 530.9, 0.0613, 0.0322)
    z = lobe(1.217, 437.0, 0.0845, 0.0278) + lobe(0.681, 459.0, 0.0385, 0.0725)
    return np.stack([x, y, z])
