"""Spectral responses: filter, quantum efficiency and polarizers, as electrons per unit of radiance.

Electrons ∝ ∫ λ·QE·τ·T·L dλ: photons, not energy, weigh the mean.
"""

import math
from pathlib import Path

import numpy as np
import xarray as xr
from jaxtyping import Float
from scipy.constants import c, h

from glintrack.core.arrays import Array
from glintrack.core.spectral import (
    band_response,
    channel_weights,
    quadrature_weights,
    resample,
    share_of_cells,
)
from glintrack.io.spectra import read_spectra
from glintrack.sensor.derivation import SILICON, am15g_light
from glintrack.sensor.design import SensorDesign
from glintrack.sensor.layouts import filter_band
from glintrack.sensor.polarizer import Polarizer, load_polarizer


def element_response(
    design: SensorDesign, wavelength_um: Float[Array, "wavelength"]
) -> Float[Array, "wavelength"]:
    """Filter × quantum efficiency × lens of an element with nothing over it. [electrons per photon]"""
    response = band_response(*design.band_um, wavelength_um)
    efficiency = design.quantum_efficiency
    if isinstance(efficiency, str):
        name = SILICON if efficiency == "silicon" else efficiency
        efficiency = _curve(name, "efficiency", wavelength_um, "sensor.quantum_efficiency")
    response = response * efficiency * design.optics_transmission
    if design.response is not None:
        response = response * _curve(design.response, "response", wavelength_um, "sensor.response")
    return response


def filtered_response(
    design: SensorDesign, what: str, wavelength_um: Float[Array, "wavelength"]
) -> Float[Array, "wavelength"]:
    """Response of an element without a polarizer, and with the filter that its layout names, if any.

    Returns
    -------
    Response. [electrons per photon]

    Raises
    ------
    ValueError
        If nothing of the filter's band is within that of the sensor.
    """
    bare, band = element_response(design, wavelength_um), filter_band(what)
    if band is None:
        return bare
    response = bare * band_response(*band, wavelength_um)
    if not response.any():
        raise ValueError(f"`sensor.band_um` must overlap the filter {what} µm; got {design.band_um}.")
    return response


def analyser_response(
    design: SensorDesign, polarizer: Polarizer, wavelength_um: Float[Array, "wavelength"]
) -> Float[Array, "3 wavelength"]:
    """Response of an element under a polarizer to I, Q and U about the pass axis: analyser row × bare one.

    Parameters
    ----------
    design, polarizer
        The sensor, and the polarizer over the element.
    wavelength_um
        Grid; the polarizer must cover what the bare element responds to. [µm]

    Returns
    -------
    Of light that is not circularly polarized, as the scene's is not. [electrons per photon]
    """
    bare = element_response(design, wavelength_um)
    used, row = bare > 0, np.zeros((3, len(bare)))
    if used.any():
        row[:, used] = polarizer.analyser_row(wavelength_um[used], 0.0)[:, :3].T
    return row * bare


def reference_light(
    design: SensorDesign, wavelength_um: Float[Array, "wavelength"]
) -> Float[Array, "wavelength"]:
    """Spectrum of the light the polarizers' responses were calibrated with, by name. [relative]"""
    name = design.reference_spectrum
    if name == "flat":
        return np.ones(len(wavelength_um))
    if name == "am15g":
        return am15g_light(wavelength_um)
    return _curve(name, "radiance", wavelength_um, "sensor.reference_spectrum")


def photon_gain(
    design: SensorDesign, wavelength_um: Float[Array, "wavelength"], response: Float[Array, "wavelength"]
) -> float:
    """Electrons an element collects per unit spectral radiance that is the same at all wavelengths.

    A·fill factor·π/(4N² + 1)·t·∫ λ/(hc)·response dλ. The response may be negative (a difference).
    """
    integral_um2 = float((response * wavelength_um) @ quadrature_weights(wavelength_um))
    return electrons(design, integral_um2, design.integration_time_ms)


def electrons(design: SensorDesign, photon_integral_um2: float, time_ms: float) -> float:
    """Electrons per unit radiance from ∫ λ·response dλ [µm²] and an integration time [ms]."""
    area_m2 = design.pitch_m**2 * design.fill_factor
    solid_angle = math.pi / (4 * design.f_number**2 + 1) * (1 - design.optics.obscuration**2)
    photons_per_joule = photon_integral_um2 * 1e-6 / (h * c)
    return area_m2 * solid_angle * time_ms * 1e-3 * photons_per_joule


def photon_weights(
    wavelength_um: Float[Array, "wavelength"], response: Float[Array, "wavelength"]
) -> Float[Array, "wavelength"]:
    """Photon weights, their magnitudes summing to 1; a band mean, if the response is never negative. [1]"""
    weights = response * wavelength_um
    total = channel_weights(wavelength_um, np.abs(weights)[None])[0]
    return np.where(weights < 0, -total, total)


def response_curves(design: SensorDesign, wavelength_um: Float[Array, "wavelength"]) -> xr.Dataset:
    """Electrons per photon that reaches the lens over an element, over ``wavelength``, by kind of element.

    Returns
    -------
    ``bare``, but where all elements have filters; filters by their bands, such as ``0.5-0.6``; with
    polarizers ``pass`` and ``block``, for light of best and worst transmittance; with a mirror
    ``spectrometer``, zero outside its range. [1]

    Raises
    ------
    ValueError
        If a table or curve does not cover the band.
    """
    wavelength_um = np.asarray(wavelength_um, dtype=float)
    kinds = [str(what) for row in design.superpixel for what in row]
    filters = sorted({what for what in kinds if filter_band(what)})
    curves = {} if set(kinds) == set(filters) else {"bare": element_response(design, wavelength_um)}
    curves |= {what: filtered_response(design, what, wavelength_um) for what in filters}
    if design.has_stokes:
        row = analyser_response(design, load_polarizer(design), wavelength_um)
        difference = np.hypot(row[1], row[2])
        curves |= {"pass": row[0] + difference, "block": row[0] - difference}
    if design.has_mirror:
        first, last = design.spectrometer_um
        used = (wavelength_um >= first - 1e-9) & (wavelength_um <= last + 1e-9)
        curves["spectrometer"] = np.where(used, spectrometer_response(design, wavelength_um), 0.0)
    return xr.Dataset(
        {name: ("wavelength", values, {"units": "1"}) for name, values in curves.items()},
        coords={"wavelength": ("wavelength", wavelength_um, {"units": "um"})},
        attrs={"polarizer": design.polarizer},
    )


def spectrometer_response(
    design: SensorDesign, wavelength_um: Float[Array, "wavelength"]
) -> Float[Array, "wavelength"]:
    """Lens × mirror × the spectrometer's quantum efficiency: the array's own, without its filter."""
    band_um = float(wavelength_um[0]), float(wavelength_um[-1])
    free = design.model_copy(update={"band_um": band_um, "response": None})
    return design.mirror_throughput * element_response(free, wavelength_um)


def spectrometer_bands(
    design: SensorDesign, wavelength_um: Float[Array, "wavelength"]
) -> tuple[Float[Array, "band"], Float[Array, "band wavelength"]]:
    """Centres of the spectrometer's bands, and their photon response on the grid.

    A band is as wide as an element. A relay convolves it with the mirror's image, which is as wide: a
    triangle with a full width at half maximum of one band.
    """
    start, stop = design.spectrometer_um
    width = design.spectrometer_bandwidth_um
    centres = start + width * (np.arange(max(int((stop - start) / width + 1e-9), 1)) + 0.5)
    parts = np.linspace(-0.5, 0.5, 41) * width if design.spectrometer == "relay" else np.zeros(1)
    first = centres + parts[:, None] - width / 2
    return centres, share_of_cells(first, first + width, wavelength_um).mean(axis=0) * wavelength_um


def _curve(name: str, column: str, wavelength_um: Array, key: str) -> Array:
    """Read a curve from a CSV file onto the grid."""
    if not Path(name).suffix:
        raise ValueError(f"`{key}` must be a known name or a CSV file (NAME.csv); got {name!r}.")
    limits = 0.0, np.finfo(float).max if column == "radiance" else 1.0
    table = read_spectra(name, key, {column: limits})
    return resample(wavelength_um, table["wavelength_um"], table[column], key)
