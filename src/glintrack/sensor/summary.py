"""Figures that follow from a sensor's design, in words, and its modulation transfer as curves."""

import math

import numpy as np
import xarray as xr

from glintrack.sensor.design import SensorDesign
from glintrack.sensor.exposure import dark_noise_e, noise_equivalent_radiance
from glintrack.sensor.sensor import Sensor
from glintrack.sensor.wavefront import modulation_transfer

_FREQUENCIES = 200


def summary(sensor: Sensor) -> list[tuple[str, str]]:
    """Name and value of what follows from a design: resolution, electrons, noise, polarizers, transfer."""
    design = sensor.design
    reading = sensor.electrons_per_radiance
    full = design.full_well_e / reading
    nyquist = np.array([500 / design.pitch_um])
    middle = sum(design.band_um) / 2
    transfer = float(modulation_transfer(design, middle, nyquist)[0])
    kernel = sensor.kernels[0]
    node = kernel.strength.shape[0] // 2
    rows = [
        ("field of view", " × ".join(f"{_field_deg(design, n):.2f}°" for n in (design.columns, design.rows))),
        ("an element at 3000 m", f"{3000 * design.pitch_um / design.focal_length_mm * 1e-3:.3f} m"),
        ("electrons per W m⁻² sr⁻¹ µm⁻¹", f"{reading:.1f}"),
        ("radiance that fills the well", f"{full:.1f} W m⁻² sr⁻¹ µm⁻¹"),
        ("noise in the dark", f"{noise_equivalent_radiance(sensor):.3g} W m⁻² sr⁻¹ µm⁻¹"),
        ("", f"{dark_noise_e(sensor):.1f} e"),
        ("signal to noise, half full", f"{_half_full(sensor):.0f}"),
        ("MTF at Nyquist", f"{transfer:.3f} at {nyquist[0]:.1f} mm⁻¹ and {middle:.2f} µm"),
        ("light on the element it belongs to", f"{kernel.at(node, node).max():.3f}"),
    ]
    if design.has_stokes:
        rows += [
            ("diattenuation over the band", f"{sensor.diattenuation:.4f}"),
            ("DoLP lost by the ideal formula", f"{1 - sensor.diattenuation:.4f} of it"),
            ("condition number of the polarizers", f"{sensor.condition:.3f}"),
        ]
    if design.has_mirror:
        bands = len(sensor.band_centre_um)
        rows.append(("spectrometer", f"{bands} bands, {design.spectrometer}"))
    return rows


def _half_full(sensor: Sensor) -> float:
    half = sensor.design.full_well_e / 2
    return half / math.sqrt(half + dark_noise_e(sensor) ** 2)


def _field_deg(design: SensorDesign, elements: int) -> float:
    return 2 * math.degrees(math.atan(elements / 2 * design.pitch_um * 1e-3 / design.focal_length_mm))


def transfer_curves(design: SensorDesign) -> xr.Dataset:
    """Modulation transfer in the middle and in the corner, at the middle of the band. [1]"""
    wavelength_um = sum(design.band_um) / 2
    frequency = np.linspace(0, 1.2e3 / design.pitch_um, _FREQUENCIES)
    corner = (design.columns, design.rows)
    size = math.hypot(*corner)
    field = (corner[0] / size, corner[1] / size)
    curves = {
        "diffraction": modulation_transfer(_perfect(design), wavelength_um, frequency, element=False),
        "lens": modulation_transfer(design, wavelength_um, frequency, element=False),
        "lens and element": modulation_transfer(design, wavelength_um, frequency),
        "in the corner, across": modulation_transfer(design, wavelength_um, frequency, "x", field),
        "in the corner, down": modulation_transfer(design, wavelength_um, frequency, "y", field),
    }
    return xr.Dataset(
        {name: ("frequency", values, {"units": "1"}) for name, values in curves.items()},
        coords={"frequency": ("frequency", frequency, {"units": "mm-1"})},
        attrs={"nyquist_per_mm": 500 / design.pitch_um, "wavelength_um": wavelength_um},
    )


def _perfect(design: SensorDesign) -> SensorDesign:
    open_pupil = type(design.optics)(obscuration=design.optics.obscuration)
    return design.model_copy(update={"spot_sigma_um": 0.0, "optics": open_pupil})
