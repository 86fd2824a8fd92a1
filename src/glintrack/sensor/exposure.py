"""Radiance at the aperture to a calibrated frame of superpixels, with the noise of the way.

Order of effects: radiance at each element's own ray → the lens's transmission, point spread and scatter →
element sampling and fill factor → polarizer or mirror response over the band → electrons → shot, dark and
read noise, full well, gain, quantizer, fixed pattern → calibration back to radiance → Stokes. The
instantaneous-field-of-view error of the mosaic comes from the elements' different rays and nothing else.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.records import Radiance, ServedQueries
from glintrack.core.schema import RADIANCE, check
from glintrack.sensor.design import SensorDesign
from glintrack.sensor.layouts import Superpixel, pan_element, places
from glintrack.sensor.lens.in_frame import with_lens
from glintrack.sensor.lens_kernels import lens_kernels, through_lens
from glintrack.sensor.polarimetry import demosaic, polarizer_centroid
from glintrack.sensor.readout import read_out
from glintrack.sensor.response import element_response, photon_gain
from glintrack.sensor.sensor import Sensor
from glintrack.sensor.wings import with_wings

NOISE_FLOORS = 3.0  # DoLP is masked where S0 is under three times its noise


def expose(
    radiance: Radiance, sensor: Sensor, served: ServedQueries, rng: np.random.Generator, time_s: float = 0.0
) -> xr.Dataset:
    """One frame: panchromatic from the mirrors, Stokes from the polarizers.

    Parameters
    ----------
    radiance
        ``radiance(channels)`` gives the Stokes radiance of every element in the ``detector`` frame,
        dims (y, x, channel, stokes), or of n × n cells of every element; see `render.shade`.
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
    Schema ``frame``; pan is NaN where the mirror was away. Without a mirror or an open element pan is S0;
    without polarizers S0 is pan, and S1 and S2 are NaN.
    """
    return frame_of(detector_readout(radiance(sensor.channels).values, sensor, rng), sensor, served, time_s)


def frame_of(
    measured: Float[Array, "row column"], sensor: Sensor, served: ServedQueries, time_s: float = 0.0
) -> xr.Dataset:
    """The frame from what the elements read (`detector_readout`); the rest as in `expose`."""
    side, layout = sensor.side, sensor.design.superpixel
    place = sensor.pan_element
    pan = None
    dark = np.zeros((measured.shape[0] // side, measured.shape[1] // side), bool)
    if place is not None:
        pan = measured[place[0] :: side, place[1] :: side].copy()
        away = served.served
        dark[served.rows[away], served.columns[away]] = True
        pan[dark] = np.nan
    if sensor.stokes_matrix is not None:
        readings = demosaic(measured, layout, sensor.design.demosaic, dark)
        stokes = readings @ sensor.stokes_matrix.T.astype(np.float32)
    else:
        stokes = np.full((*dark.shape, 3), np.nan, np.float32)
        stokes[..., 0] = pan
    about = {"time_s": float(time_s), "dolp_floor": NOISE_FLOORS * s0_noise_floor(sensor)}
    pan = stokes[..., 0] if pan is None else pan
    return check(label_frame(pan, stokes, layout, sensor.design.demosaic, about), "frame")


def detector_readout(light: Array, sensor: Sensor, rng: np.random.Generator) -> Array:
    """What every element reads, (row, column), from light (y, x, channel, stokes). [W m⁻² sr⁻¹ µm⁻¹]

    Raises
    ------
    ValueError
        If the light's size is no whole multiple of the array's.
    """
    return read_out(light_on_elements(light, sensor), sensor, rng)


def light_on_elements(light: Array, sensor: Sensor) -> Float[Array, "plane row column"]:
    """Light behind the lens on every element, `Sensor.planes` of it, from light (y, x, channel, stokes).

    Behind `sensor.optics.depolarizer`, M = diag(1, 0, 0), S1 and S2 are 0.

    Raises
    ------
    ValueError
        As `detector_readout`.
    """
    rows, columns = sensor.camera.rows, sensor.camera.columns
    fine = light.shape[0] // rows if light.ndim == 4 else 0
    expected = (rows * max(fine, 1), columns * max(fine, 1), len(sensor.channels), 3)
    if light.shape != expected:
        raise ValueError(
            f"`radiance` must give a frame of {expected} (the design's elements, or whole cells "
            f"of each), got {light.shape}"
        )
    planes = np.stack([light[:, :, channel, component] for channel, component in sensor.planes])
    if sensor.design.optics.depolarizer:
        planes = depolarized(planes, sensor)
    kernels = sensor.kernels
    if fine > 1:
        kernels = lens_kernels(sensor.design, sensor.wavelength_um, sensor.channels, fine)
    own = tuple(kernels[channel] for channel, _ in sensor.planes)
    on_elements = through_lens(planes, own, fine, _window(sensor, fine))
    for k, kernel in enumerate(own):
        on_elements[k] = with_wings(on_elements[k], sensor.design, kernel.far_share, kernel.half_side_um)
    return on_elements


def depolarized(planes: Float[Array, "plane row column"], sensor: Sensor) -> Float[Array, "plane row column"]:
    """The same light on the elements with S1 = S2 = 0."""
    component = np.array([component for _, component in sensor.planes])
    return np.where((component == 0)[:, None, None], planes, 0.0)


def noise_equivalent_radiance(sensor: Sensor) -> float:
    """RMS of the dark noise (dark current, read, quantizer) of a bare element. [W m⁻² sr⁻¹ µm⁻¹]"""
    return dark_noise_e(sensor) / sensor.electrons_per_radiance


def noise_scales(design: SensorDesign) -> tuple[float, float]:
    """Electrons per band-mean radiance of a bare element, and its dark noise. [e / (W m⁻² sr⁻¹ µm⁻¹), e]"""
    design = with_lens(design)
    band_um = np.linspace(*design.band_um, 61)
    return photon_gain(design, band_um, element_response(design, band_um)), design_dark_noise_e(design)


def dark_noise_e(sensor: Sensor) -> float:
    """RMS of dark current, read and quantizer noise of one element. [e]"""
    return design_dark_noise_e(sensor.design)


def design_dark_noise_e(design: SensorDesign) -> float:
    """As `dark_noise_e`, of a design. [e]"""
    dark_e = design.dark_current_e_per_s * design.integration_time_ms * 1e-3
    return math.sqrt(dark_e + design.read_noise_e**2 + design.electrons_per_count**2 / 12)


def s0_noise_floor(sensor: Sensor) -> float:
    """RMS of S0 in the dark; that of pan without polarizers. [W m⁻² sr⁻¹ µm⁻¹]"""
    if sensor.stokes_matrix is None:
        return noise_equivalent_radiance(sensor)
    polarizers = places(sensor.design.superpixel, "polarizer")
    noise = np.array([dark_noise_e(sensor) / sensor.electrons_per_reading[place] for place in polarizers])
    return float(np.hypot.reduce(sensor.stokes_matrix[0] * noise))


def _window(sensor: Sensor, fine: int) -> Array:
    """Part of each cell along an element that its aperture, in the middle, covers; sums to 1."""
    half = 0.5 * math.sqrt(sensor.design.fill_factor)
    edges = np.linspace(-0.5, 0.5, fine + 1)
    covered = np.maximum(np.minimum(edges[1:], half) - np.maximum(edges[:-1], -half), 0)
    return covered / covered.sum()


def label_frame(
    pan: Float[Array, "y x"],
    stokes: Float[Array, "y x 3"],
    layout: Superpixel,
    demosaic_method: str,
    attributes: Mapping[str, float],
    units: str = RADIANCE,
) -> xr.Dataset:
    """A frame of the schema ``frame``, with where the samples of each variable lie.

    Parameters
    ----------
    pan, stokes
        Of every superpixel; pan is that of the mirror or open element, else S0.
    layout, demosaic_method
        Superpixel, and how its elements came to one place.
    attributes
        Of the frame: ``time_s`` [s], ``dolp_floor``.
    units
        Of pan and the Stokes vectors.
    """
    side = len(layout)
    middle = (side - 1) / 2
    centre = polarizer_centroid(layout, demosaic_method)
    place = pan_element(layout)
    offset_of_pan = centre if place is None else np.array(place, dtype=float) - middle
    offsets: dict[str, dict[str, Any]] = {
        name: {"units": units, "row_offset": float(offset[0]), "column_offset": float(offset[1])}
        for name, offset in (("pan", offset_of_pan), ("stokes_radiance", centre))
    }
    rows, columns = pan.shape
    return xr.Dataset(
        {
            "pan": (("y", "x"), pan, offsets["pan"]),
            "stokes_radiance": (
                ("y", "x", "stokes"),
                stokes,
                {**offsets["stokes_radiance"], "stokes_frame": "detector"},
            ),
        },
        coords={
            "y": ("y", side * np.arange(rows) + middle, {"units": "element"}),
            "x": ("x", side * np.arange(columns) + middle, {"units": "element"}),
            "stokes": ["I", "Q", "U"],
        },
        attrs=dict(attributes),
    )
