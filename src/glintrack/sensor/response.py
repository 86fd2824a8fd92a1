"""Spectral responses: filter, quantum efficiency and polarizers, as electrons per unit of radiance.

Electrons ∝ ∫ λ·QE·τ·T·L dλ: photons, not energy, weigh the mean.
"""

import csv
import math
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
import pvlib
import xarray as xr
from jaxtyping import Float
from scipy.constants import c, h

from glintrack.arrays import Array
from glintrack.devices import wire_grid
from glintrack.sensor.design import POLARIZER_TABLES, SensorDesign
from glintrack.spectral import Band, channel_weights, quadrature_weights, resample

APERTURE_SHARE = 10 / 15  # of the 15 µm port that the paper's Eq. (7) refers to: the aperture's width
LARGEST_TRANSMITTANCE = 1.5  # a narrow aperture gathers some light from beside it, not this much
_PRINCIPAL = ("pass_transmittance", "block_transmittance")


@dataclass(frozen=True)
class Polarizer:
    """Response of a polarizer per light that falls on its aperture.

    Parameters
    ----------
    wavelength_um
        Rising. [µm]
    pass_transmittance, block_transmittance
        Irradiance. Above 1 is possible: a slit of a few wavelengths gathers light from beside it. [1]
    """

    wavelength_um: Float[Array, "wavelength"]
    pass_transmittance: Float[Array, "wavelength"]
    block_transmittance: Float[Array, "wavelength"]


def load_polarizer(design: SensorDesign) -> Polarizer | None:
    """The design's polarizer table; None where the polarizers are ideal.

    Raises
    ------
    ValueError
        If a file cannot be read or is no table of pass and block transmittance.
    """
    name = design.polarizer
    if name == "ideal":
        return None
    if name == "constant":
        ends, t = np.array([0.4, 2.5]), design.polarizer_transmittance
        block = t / design.polarizer_extinction_ratio
        return Polarizer(ends, np.full(2, t), np.full(2, block))
    try:
        if name in POLARIZER_TABLES:
            return _per_aperture(wire_grid.load(name), name)
        with xr.open_dataset(name, engine="h5netcdf") as dataset:
            return _per_aperture(dataset.load(), name)
    except (OSError, ValueError) as error:
        if isinstance(error, ValueError) and str(error).startswith("`"):
            raise
        raise ValueError(
            f"`sensor.polarizer` must be ideal, constant, {', '.join(POLARIZER_TABLES)} or a NetCDF file, "
            f"got {name!r} ({type(error).__name__})"
        ) from error


def _per_aperture(table: xr.Dataset, name: str) -> Polarizer:
    """Transmittances of the aperture alone: as the table gives them, or from the paper's Eq. (7)."""
    columns = []
    for column in _PRINCIPAL:
        share = 1.0 if f"{column}_per_aperture" in table else APERTURE_SHARE
        source = f"{column}_per_aperture" if share == 1 else column
        if source not in table or table[source].dims != ("wavelength",):
            raise ValueError(
                f"`sensor.polarizer` must hold {column} over wavelength, got "
                f"{sorted(map(str, table))} in {name}"
            )
        values = np.asarray(table[source].values, dtype=float)
        if not (np.isfinite(values).all() and values.min() >= 0 and values.max() <= LARGEST_TRANSMITTANCE):
            raise ValueError(
                f"`sensor.polarizer` must have {source} within 0 to {LARGEST_TRANSMITTANCE:g}, "
                f"got others in {name}"
            )
        columns.append(values / share)
    return Polarizer(table["wavelength"].values.astype(float), *columns)


def element_response(
    design: SensorDesign, wavelength_um: Float[Array, "wavelength"]
) -> Float[Array, "wavelength"]:
    """Filter × quantum efficiency × lens of an element with nothing over it. [electrons per photon]"""
    response = Band("pan", *design.band_um, design.band_shape).response(wavelength_um)
    response = response * _efficiency(design, wavelength_um) * design.optics_transmission
    if design.response is not None:
        response = response * _curve(design.response, "response", wavelength_um, "sensor.response")
    return response


def polarized_response(
    design: SensorDesign, polarizer: Polarizer | None, wavelength_um: Float[Array, "wavelength"]
) -> tuple[Float[Array, "wavelength"], Float[Array, "wavelength"]]:
    """½(T_pass + T_block) and ½(T_pass − T_block) times the element's response. [electrons per photon]"""
    bare = element_response(design, wavelength_um)
    if polarizer is None:
        return 0.5 * bare, 0.5 * bare
    used = bare > 0
    if not used.any():
        return bare, bare
    sums, differences = np.zeros_like(bare), np.zeros_like(bare)
    along, across = (
        resample(wavelength_um[used], polarizer.wavelength_um, values, "sensor.polarizer")
        for values in (polarizer.pass_transmittance, polarizer.block_transmittance)
    )
    sums[used], differences[used] = 0.5 * (along + across), 0.5 * (along - across)
    return sums * bare, differences * bare


def reference_light(
    design: SensorDesign, wavelength_um: Float[Array, "wavelength"]
) -> Float[Array, "wavelength"]:
    """Spectrum of the light the polarizers' responses were calibrated with, by name. [relative]"""
    name = design.reference_spectrum
    if name == "flat":
        return np.ones(len(wavelength_um))
    if name == "am15g":
        table = pvlib.spectrum.get_reference_spectra(standard="ASTM G173-03")["global"]
        return np.interp(wavelength_um, table.index.to_numpy(dtype=float) * 1e-3, table.to_numpy(dtype=float))
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
    area_m2 = (design.pitch_um * 1e-6) ** 2 * design.fill_factor
    solid_angle = math.pi / (4 * design.f_number**2 + 1) * (1 - design.optics.obscuration**2)
    photons_per_joule = photon_integral_um2 * 1e-6 / (h * c)
    return area_m2 * solid_angle * time_ms * 1e-3 * photons_per_joule


def signed_weights(
    wavelength_um: Float[Array, "wavelength"], response: Float[Array, "wavelength"]
) -> Float[Array, "wavelength"]:
    """Photon weights whose magnitudes sum to 1; the band mean, if the response is nowhere negative. [1]"""
    weights = response * wavelength_um
    total = channel_weights(wavelength_um, np.abs(weights)[None])[0]
    return np.where(weights < 0, -total, total)


def _efficiency(design: SensorDesign, wavelength_um: Array) -> Array:
    what = design.quantum_efficiency
    if not isinstance(what, str):
        return np.full(len(wavelength_um), what)
    if what == "silicon":
        what = str(resources.files("glintrack") / "data" / "sensors" / "silicon.csv")
    return _curve(what, "efficiency", wavelength_um, "sensor.quantum_efficiency")


def _curve(name: str, column: str, wavelength_um: Array, key: str) -> Array:
    """A user's curve on the grid, from a CSV file."""
    path = Path(name)
    try:
        lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"`{key}` must be a known name or a readable CSV file, got {name!r}") from error
    rows = list(csv.DictReader(lines))
    try:
        table_um = np.array([float(row["wavelength_um"]) for row in rows])
        values = np.array([float(row[column]) for row in rows])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"`{key}` must have columns wavelength_um and {column} of numbers, got {name}"
        ) from error
    if (
        len(rows) < 2
        or not np.all(np.diff(table_um) > 0)
        or not np.isfinite(values).all()
        or values.min() < 0
    ):
        raise ValueError(f"`{key}` must have rising wavelengths and values from 0 up, got others in {name}")
    if column != "radiance" and values.max() > 1:
        raise ValueError(f"`{key}` must lie within 0 to 1, got {values.max():g} in {name}")
    return resample(wavelength_um, table_um, values, key)
