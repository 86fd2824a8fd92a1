"""Derive spot, full well, read noise and exposure from the figures of a data sheet.

A case may leave these keys out. Each law passes through the default sensor (elements of 17 µm behind F/5.6),
so that sensor keeps its values and another pitch, F-number or band gets its own.
"""

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.designs import Design
from glintrack.core.installation import data_file, read_data
from glintrack.core.spectral import MAX_WAVELENGTH_UM, MIN_WAVELENGTH_UM, quadrature_weights, share_of_cells
from glintrack.core.units import unit_of
from glintrack.io.spectra import read_spectra
from glintrack.sensor.layouts import LAYOUTS, filter_band

SILICON = str(data_file("sensors", "silicon.csv"))
DEFAULT_PITCH_UM, DEFAULT_F_NUMBER, DEFAULT_EFFICIENCY, DEFAULT_TRANSMISSION = 17.0, 5.6, 0.6, 0.85
DEFAULT_BAND_UM = (0.4, 1.0)
_SPOT_UM, _FULL_WELL_E, _READ_NOISE_E, _EXPOSURE_MS = 12.0, 267e3, 20.0, 0.085
MAX_EXPOSURE_MS = 1.0  # a car at 50 km/h moves 14 mm in it
_AIRY_SIGMA = 0.42  # Gaussian closest to the Airy pattern, per λF: Zhang et al., Appl. Opt. 46, 1819 (2007)
ORIGINS: Mapping[str, str] = read_data("sensor_laws.toml")


def derived_values(design: Design) -> dict[str, str]:
    """Describe value and law of each key of ``[sensor]`` that neither a case nor its ready design states."""
    values = {key: float(f"{getattr(design, key):.3g}") for key in ORIGINS}
    return {
        key: f"sensor.{key} = {values[key]:,g} {unit_of(key)}: {law}"
        for key, law in ORIGINS.items()
        if key not in design.model_fields_set
    }


def spot_sigma(known: Mapping[str, Any]) -> float:
    """Blur by aberrations; with diffraction at F/5.6 it has the default's ratio to the pitch. [µm]

    Notes
    -----
    Aberrations of a real lens shrink when it is stopped down; a data sheet does not say how far. The spot
    stays here, so that blur grows with the F-number as diffraction does, and has no optimum.
    """
    ratio2 = (_SPOT_UM**2 + _airy_sigma_um(DEFAULT_BAND_UM) ** 2) / DEFAULT_PITCH_UM**2
    spot2 = ratio2 * known["pitch_um"] ** 2 - _airy_sigma_um(_band_um(known)) ** 2
    return _rounded(math.sqrt(max(spot2, 0.0)))


def full_well(known: Mapping[str, Any]) -> float:
    """Full well in proportion to the element's area; the default is the IMX250MZR's 11 ke on 3.45 µm. [e]"""
    return _rounded(_FULL_WELL_E * (known["pitch_um"] / DEFAULT_PITCH_UM) ** 2)


def read_noise(known: Mapping[str, Any]) -> float:
    """Read noise in proportion to the pitch, as reset noise of a capacity that grows with the area. [e]"""
    return _rounded(_READ_NOISE_E * known["pitch_um"] / DEFAULT_PITCH_UM)


def integration_time(known: Mapping[str, Any]) -> float:
    """Exposure that fills the well to the default sensor's share, with the limit of `MAX_EXPOSURE_MS`. [ms]

    A quantum efficiency from a file counts as 0.6, and a `response` curve as 1: neither is read here.
    """
    layout = known["layout"]
    rows = LAYOUTS.get(layout, ((layout,),)) if isinstance(layout, str) else layout
    kinds = [what for row in rows for what in row]
    has_unpolarized = any(isinstance(what, str) for what in kinds)
    efficiency = known["quantum_efficiency"]
    if isinstance(efficiency, str) and efficiency != "silicon":
        efficiency = DEFAULT_EFFICIENCY
    light = (
        (known["pitch_um"] / DEFAULT_PITCH_UM) ** 2
        * ((4 * DEFAULT_F_NUMBER**2 + 1) / (4 * known["f_number"] ** 2 + 1))
        * (1 - known["optics"].obscuration ** 2)
        * known["fill_factor"]
        * (known["optics_transmission"] / DEFAULT_TRANSMISSION)
        * (1.0 if has_unpolarized else 0.5 * known["polarizer_transmittance"])
        * max(_relative_signal(band_um, efficiency) for band_um in _element_bands_um(known, kinds))
    )
    gain = known["gain_e_per_count"]
    full_e = min(known["full_well_e"], gain * 2 ** known["bits"] if gain else math.inf)
    time_ms = _EXPOSURE_MS * (full_e / _FULL_WELL_E) / max(light, 1e-9)
    return _rounded(min(time_ms, MAX_EXPOSURE_MS, 0.9e3 / known["max_frame_rate_hz"]))


def am15g_light(wavelength_um: Float[Array, "wavelength"]) -> Float[Array, "wavelength"]:
    """Sunlight on the ground of ASTM G173-03, global, per wavelength. [W m⁻² nm⁻¹]"""
    import pvlib  # takes a tenth of a second

    table = pvlib.spectrum.get_reference_spectra(standard="ASTM G173-03")["global"]
    return np.interp(wavelength_um, table.index.to_numpy(dtype=float) * 1e-3, table.to_numpy(dtype=float))


@lru_cache(maxsize=64)
def _relative_signal(band_um: tuple[float, float], efficiency: float | str) -> float:
    """Electrons of AM1.5G sunlight in a band, relative to the default band and efficiency. [1]"""
    if band_um == DEFAULT_BAND_UM and not isinstance(efficiency, str):
        return efficiency / DEFAULT_EFFICIENCY
    grid = np.arange(DEFAULT_BAND_UM[0], max(band_um[1], DEFAULT_BAND_UM[1]) + 0.005, 0.01)
    photons = grid * am15g_light(grid)
    part = np.full(len(grid), efficiency if not isinstance(efficiency, str) else 0.0)
    if isinstance(efficiency, str):
        table = read_spectra(SILICON, "sensor.quantum_efficiency", {"efficiency": (0.0, 1.0)})
        part = np.interp(grid, table["wavelength_um"], table["efficiency"], right=0.0)
    photons *= quadrature_weights(grid)
    own, default = (share_of_cells(*band, grid) for band in (band_um, DEFAULT_BAND_UM))
    return float((photons * part) @ own / (DEFAULT_EFFICIENCY * photons @ default))


def _element_bands_um(known: Mapping[str, Any], kinds: list[str | float]) -> list[tuple[float, float]]:
    """Band of each kind of element: the sensor's, or what a filter leaves of it. [µm]"""
    first, last = _band_um(known)
    bands = [filter_band(what) or (first, last) for what in kinds]
    return [(max(first, low), min(last, high)) for low, high in bands]


def _band_um(known: Mapping[str, Any]) -> tuple[float, float]:
    """Band within the wavelengths of the program, which the design checks only later. [µm]"""
    first, last = (min(max(um, MIN_WAVELENGTH_UM), MAX_WAVELENGTH_UM) for um in known["band_um"])
    return first, last


def _airy_sigma_um(band_um: tuple[float, float]) -> float:
    """Width (standard deviation) of the Gaussian closest to the Airy pattern at F/5.6 and mid-band. [µm]"""
    return _AIRY_SIGMA * sum(band_um) / 2 * DEFAULT_F_NUMBER


def _rounded(value: float) -> float:
    """Round to four significant digits, so that a printed value is the value that is used."""
    return float(f"{value:.4g}")
