"""NIIRS of a case by the General Image Quality Equation, version 5 (GIQE-5), from the design alone.

NIIRS, the National Imagery Interpretability Rating Scale, rates from 0 to 9 what an analyst can recognize in
one picture.

References
----------
Harrington, Blanchard, Salacain, Smith and Amanik, "General Image Quality Equation; GIQE version 5", National
Geospatial-Intelligence Agency (2015): Eqs. (2), (5) and (7).
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from glintrack.case.design import Case
from glintrack.case.quantities import ground_light, ground_view
from glintrack.core.arrays import Array
from glintrack.core.units import format_number
from glintrack.sensor import modulation_transfer, with_lens

TARGET, BACKGROUND = 0.15, 0.07  # reflectances of the equation's signal-to-noise ratio
Q_RANGE = (1.0, 2.0)  # λN/pitch of the pictures that the equation was fitted to
_M_PER_INCH = 0.0254
_FREQUENCY_STEP = 1e-3  # of the integral over the MTF [cycle/element]


class ImageQuality(NamedTuple):
    """NIIRS, 0 to 9 and extrapolated outside, and the quantities that it follows from."""

    niirs: float
    gsd_m: float  # geometric mean of those across the line of sight and on the ground
    edge_response: float  # the lower direction counts twice
    snr: float  # of a contrast of 15 % to 7 % reflectance
    q: float  # wavelength × F-number / pitch


def giqe5(gsd_m: float, edge_responses: tuple[float, float], snr: float, elevation_rad: float) -> float:
    """NIIRS by GIQE-5.

    Parameters
    ----------
    gsd_m
        Ground sample distance in the plane across the line of sight. [m]
    edge_responses
        Relative edge response in two directions, above 0. [1]
    snr
        Signal-to-noise ratio of the contrast, above 0. [1]
    elevation_rad
        Angle of the line of sight above the ground, above 0. [rad]
    """
    weighted_m = gsd_m / math.sin(elevation_rad) ** 0.25  # Eq. (5)
    low, high = sorted(edge_responses)
    edge = math.log10(low**2 * high) / 3  # Eq. (7)
    interaction = 3.32 * -math.expm1(-1.9 / snr) * edge
    return 9.57 - 3.32 * math.log10(weighted_m / _M_PER_INCH) + interaction - 2 * edge**4 - 1.8 / snr


def relative_edge_response(frequency: Float[Array, "n"], transfer: Float[Array, "n"]) -> float:
    """Rise of a sharp edge's image from half an element before the edge to half an element behind it. [1]

    Parameters
    ----------
    frequency
        From 0 to where the transfer ends. [cycle/element]
    transfer
        Optical transfer, negative where contrast is reversed. [1]

    Notes
    -----
    The edge response is ½ + 1/π ∫ T(f)/f sin(2πfx) df, so its rise is 2 ∫ T(f) sinc(f) df.
    """
    return float(2 * np.trapezoid(transfer * np.sinc(frequency), frequency))


def image_quality(case: Case) -> ImageQuality | None:
    """NIIRS of the pan picture at the stare point, without image motion; None without light.

    The edge response is that of lens and element in the middle of the band and of the field. The signal is
    the difference in electrons between grounds of 15 % and 7 % reflectance (the contrast of GIQE-3, which
    GIQE-5 keeps), under the case's sun and haze. The noise is that of an element on the brighter ground.
    """
    sensor, light = with_lens(case.sensor), ground_light(case)
    if not light.well_fill > 0:
        return None
    wavelength_um = sum(sensor.band_um) / 2
    q = wavelength_um * sensor.f_number / sensor.pitch_um
    frequency = np.arange(0, 1 / q + _FREQUENCY_STEP, _FREQUENCY_STEP)
    aperture = np.sinc(frequency * math.sqrt(sensor.fill_factor))
    per_mm = 1e3 * frequency / sensor.pitch_um
    across, along = (
        relative_edge_response(
            frequency, aperture * modulation_transfer(sensor, wavelength_um, per_mm, direction, element=False)
        )
        for direction in ("x", "y")
    )
    noise_e = math.sqrt(sensor.noise_variance_e2(light.electrons(TARGET)))
    snr = light.white_e * (TARGET - BACKGROUND) / noise_e
    across_m, along_m = ground_view(case)[0]
    elevation_rad = math.asin(across_m / along_m)
    return ImageQuality(
        niirs=giqe5(across_m, (across, along), snr, elevation_rad),
        gsd_m=across_m / math.sin(elevation_rad) ** 0.25,
        edge_response=(min(across, along) ** 2 * max(across, along)) ** (1 / 3),
        snr=snr,
        q=q,
    )


def describe_niirs(case: Case) -> str:
    """Line with NIIRS within its scale and what it follows from; says so where GIQE-5 is extrapolated."""
    found = image_quality(case)
    if found is None:
        return "NIIRS: not known without light"
    rating = "below 0" if found.niirs < 0 else "above 9" if found.niirs > 9 else f"{found.niirs:.1f}"
    low, high = Q_RANGE
    fitted = "" if low <= found.q <= high else f", outside the fitted {low:g} to {high:g}"
    return (
        f"NIIRS {rating} of one picture by GIQE-5 (ground sample distance {format_number(found.gsd_m)} m, "
        f"edge response {found.edge_response:.2f}, signal-to-noise ratio {found.snr:.0f}, "
        f"Q = {found.q:.2g}{fitted}). It does not predict tracking (docs/guide/case.md)"
    )
