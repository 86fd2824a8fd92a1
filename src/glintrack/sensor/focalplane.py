"""Radiance at the aperture to a calibrated frame of superpixels, with the noise of the way.

Order of effects: radiance at each element's own ray → the lens's point spread → polarizer or mirror →
electrons → shot and read noise → full well → quantizer → calibration back to radiance → Stokes by Fesenkov.
The instantaneous-field-of-view error of the 2×2 mosaic comes from the elements' different rays and from
nothing else.
"""

from collections.abc import Callable

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter

from ..records import ServedQueries
from ..schema import RADIANCE, check
from .design import LAYOUTS, MIRROR, Sensor
from .polarimetry import superpixel_stokes

Array = np.ndarray
Radiance = Callable[..., xr.DataArray]
NOISE_FLOORS = 3.0  # DoLP is masked where S0 is under three times its noise


def expose(
    radiance: Radiance, sensor: Sensor, served: ServedQueries, rng: np.random.Generator, time_s: float = 0.0
) -> xr.Dataset:
    """One frame: panchromatic from the mirrors, Stokes from the polarizers.

    Parameters
    ----------
    radiance
        ``radiance(channels)`` gives the Stokes radiance of every element in the ``detector`` frame,
        dims (y, x, channel, stokes); see `render.shade`.
    sensor
        From `build_sensor`.
    served
        Mirrors that feed the spectrometer in this frame; they go dark in pan.
    rng
        Shot and read noise.
    time_s
        Written to the frame.

    Returns
    -------
    Schema ``frame``; pan is NaN where the mirror was away.
    """
    light = radiance(sensor.pan_weights).values[:, :, 0]
    expected = (sensor.camera.rows, sensor.camera.columns, 3)
    if light.shape != expected:
        raise ValueError(f"`radiance` must give a frame of {expected}, got {light.shape}")
    light = _blur(light, sensor.blur_sigma)
    through = np.empty(light.shape[:2], np.float64)
    for row in range(2):
        for column in range(2):
            through[row::2, column::2] = light[row::2, column::2] @ sensor.analysers[row, column]
    measured = _read_out(through, sensor, rng)

    row, column = sensor.mirror_element
    pan = measured[row::2, column::2].astype(np.float32)
    away = served.served
    pan[served.rows[away], served.columns[away]] = np.nan
    stokes = superpixel_stokes(measured, sensor.design.layout, sensor.design.demosaic).astype(np.float32)
    return check(_label(pan, stokes, sensor, time_s), "frame")


def noise_equivalent_radiance(sensor: Sensor) -> float:
    """RMS of the dark noise (read and quantizer) as a band-mean radiance. [W m⁻² sr⁻¹ µm⁻¹]"""
    design = sensor.design
    step = design.full_well_e / 2**design.bits
    return float(np.hypot(design.read_noise_e, step / np.sqrt(12)) / sensor.electrons_per_radiance)


def _blur(light: Array, sigma: float) -> Array:
    """Each Stokes component through the lens's point spread, a Gaussian of ``sigma`` elements."""
    if sigma < 0.05:  # under a twentieth of an element nothing moves
        return light
    return gaussian_filter(light, (sigma, sigma, 0), mode="nearest", truncate=3.0)


def _read_out(through: Array, sensor: Sensor, rng: np.random.Generator) -> Array:
    """Radiance on the elements to calibrated radiance: shot noise, read noise, full well, quantizer."""
    design = sensor.design
    # ten full wells are full for certain: glints need no larger Poisson deviates than that
    expected = np.clip(through * sensor.electrons_per_radiance, 0, 10 * design.full_well_e)
    electrons = np.minimum(rng.poisson(expected), design.full_well_e).astype(np.float64)
    electrons += design.read_noise_e * rng.standard_normal(electrons.shape)
    step = design.full_well_e / 2**design.bits
    counts = np.clip(np.round(electrons / step), -(2**6), 2**design.bits - 1)  # a pedestal of 64 counts
    return counts * step / sensor.electrons_per_radiance


def _label(pan: Array, stokes: Array, sensor: Sensor, time_s: float) -> xr.Dataset:
    row, column = sensor.mirror_element
    polarizers = [place for place, what in LAYOUTS[sensor.design.layout].items() if what != MIRROR]
    # the three polarizers' centroid from the superpixel's centre, unless each was brought to the centre
    bilinear = sensor.design.demosaic == "bilinear"
    centre = np.zeros(2) if bilinear else np.mean(polarizers, axis=0) - 0.5
    rows, columns = pan.shape
    return xr.Dataset(
        {
            "pan": (
                ("y", "x"),
                pan,
                {"units": RADIANCE, "row_offset": row - 0.5, "column_offset": column - 0.5},
            ),
            "stokes_radiance": (
                ("y", "x", "stokes"),
                stokes,
                {
                    "units": RADIANCE,
                    "stokes_frame": "detector",
                    "row_offset": float(centre[0]),
                    "column_offset": float(centre[1]),
                },
            ),
        },
        coords={
            "y": ("y", 2.0 * np.arange(rows) + 0.5, {"units": "element"}),
            "x": ("x", 2.0 * np.arange(columns) + 0.5, {"units": "element"}),
            "stokes": ["I", "Q", "U"],
        },
        attrs={
            "time_s": float(time_s),
            # S0 = ⅔(I₀+I₆₀+I₁₂₀) has 2/√3 times the noise of one element
            "dolp_floor": NOISE_FLOORS * 2 / np.sqrt(3) * noise_equivalent_radiance(sensor),
        },
    )
