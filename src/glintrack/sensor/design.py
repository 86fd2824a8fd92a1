"""The sensor's design and what follows from it: camera, spectral weights, analysers, responsivity."""

import math
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from jaxtyping import Float, Int
from pydantic import BaseModel, ConfigDict, Field, model_validator
from scipy.constants import c, h

from ..camera import Camera, Pose, project
from ..spectral import Band, channel_weights, quadrature_weights

Array = np.ndarray

MIRROR = "mirror"
# element of the 2×2 superpixel -> what stands over it, (row, column) from the top left
LAYOUTS: dict[str, dict[tuple[int, int], str | float]] = {
    "mirror-0-60-120": {(0, 0): MIRROR, (0, 1): 0.0, (1, 0): 60.0, (1, 1): 120.0},
}


class SensorDesign(BaseModel):
    """The ``[sensor]`` table of a case.

    The default is the paper's standard frame: 880 × 560 elements of 0.75 m at 3000 m slant range.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    focal_length_mm: float = Field(default=68.0, gt=0, le=5000, description="Principal distance")
    f_number: float = Field(default=5.6, ge=0.5, le=64, description="Focal ratio")
    pitch_um: float = Field(
        default=17.0, ge=1, le=100, description="Spacing of the elements (Table 1: 17, 10.8, 8.5)"
    )
    rows: int = Field(default=560, ge=4, le=8192, description="Elements down the array, even")
    columns: int = Field(default=880, ge=4, le=8192, description="Elements across the array, even")
    layout: Literal["mirror-0-60-120"] = Field(
        default="mirror-0-60-120", description="Superpixel of 2×2 elements"
    )
    spot_sigma_um: float = Field(
        default=12.0,
        ge=0,
        le=200,
        description="RMS radius along an axis of the lens's aberration spot, Gaussian",
    )
    demosaic: Literal["superpixel", "bilinear"] = Field(
        default="bilinear", description="How the polarizer elements come to one place before Stokes is formed"
    )
    band_um: tuple[float, float] = Field(default=(0.4, 1.0), description="Panchromatic band, flat filter")
    optics_transmission: float = Field(default=0.85, gt=0, le=1)
    quantum_efficiency: float = Field(default=0.6, gt=0, le=1, description="Over the whole band")
    integration_time_ms: float = Field(default=0.1, gt=0, le=1000)
    full_well_e: float = Field(default=100e3, gt=0, description="Electrons an element can hold")
    read_noise_e: float = Field(default=20.0, ge=0, description="RMS electrons a read")
    bits: int = Field(default=14, ge=1, le=24, description="Of the quantizer, over the full well")
    oversampling: int = Field(default=1, ge=1, le=5, description="Rays along each side of an element")
    spectrometer_um: tuple[float, float] = Field(default=(0.4, 1.0), description="Range of the spectrometer")
    spectrometer_bandwidth_um: float = Field(
        default=0.01, ge=0.01, le=0.1, description="Of each of its bands"
    )
    spectrometer_integration_time_ms: float = Field(default=10.0, gt=0, le=1000)

    @model_validator(mode="after")
    def _whole_superpixels_and_rising_bands(self) -> Self:
        for name in ("rows", "columns"):
            if getattr(self, name) % 2:
                raise ValueError(f"`sensor.{name}` must be even (2×2 superpixels), got {getattr(self, name)}")
        Band("sensor.band_um", *self.band_um)
        Band("sensor.spectrometer_um", *self.spectrometer_um)
        return self


@dataclass(frozen=True)
class Sensor:
    """A design made ready for one wavelength grid.

    Parameters
    ----------
    design
        What the user asked for.
    camera
        Its geometry, in elements.
    pan_weights
        Photon-weighted response of an element; its product with a radiance spectrum is the band mean.
        [1]
    electrons_per_radiance
        Electrons an element collects for a band-mean radiance of 1 W m⁻² sr⁻¹ µm⁻¹.
    analysers
        (2, 2, 3): weights of I, Q, U behind each element of the superpixel. [1]
    band_centre_um, band_weights, band_electrons_per_radiance
        The spectrometer's bands, likewise.
    """

    design: SensorDesign
    camera: Camera
    pan_weights: Float[Array, "1 wavelength"]
    electrons_per_radiance: float
    analysers: Float[Array, "2 2 3"]
    band_centre_um: Float[Array, "band"]
    band_weights: Float[Array, "band wavelength"]
    band_electrons_per_radiance: Float[Array, "band"]

    def column_of(self, enu: Float[Array, "point 3"], pose: Pose) -> Int[Array, "point"]:
        """Column of superpixels in which ground points fall, −1 off the array."""
        return self.superpixel_of(enu, pose)[:, 1]

    def superpixel_of(self, enu: Float[Array, "point 3"], pose: Pose) -> Int[Array, "point 2"]:
        """(row, column) of the superpixel whose *mirror* sees each ground point, −1 off the array."""
        element = project(self.camera, pose, np.asarray(enu, dtype=float).reshape(-1, 3))
        mirror = np.array(self.mirror_element)
        index = np.round((np.nan_to_num(element, nan=-9.0) - mirror) / 2)
        size = np.array([self.design.rows // 2, self.design.columns // 2])
        inside = np.all((index >= 0) & (index < size), axis=1)
        return np.where(inside[:, None], index, -1).astype(int)

    @property
    def blur_sigma(self) -> float:
        """Width of the point spread: the aberration spot and diffraction, as Gaussians. [element]

        The Airy disk at the band's centre λ has the core of a Gaussian of standard deviation 0.42 λN (Zhang,
        Zerubia and Olivo-Marin, Applied Optics 46, 2007, within a few per cent for this use).
        """
        diffraction_um = 0.42 * self.design.f_number * sum(self.design.band_um) / 2
        return math.hypot(self.design.spot_sigma_um, diffraction_um) / self.design.pitch_um

    @property
    def mirror_element(self) -> tuple[int, int]:
        """Where the micromirror stands in the superpixel."""
        layout = LAYOUTS[self.design.layout]
        return next(place for place, what in layout.items() if what == MIRROR)


def build_sensor(design: SensorDesign, wavelength_um: Float[Array, "wavelength"]) -> Sensor:
    """Camera, spectral weights and responsivities of a design.

    Parameters
    ----------
    design
        The sensor.
    wavelength_um
        Grid of the radiance it will be given, covering its bands. [µm]

    Raises
    ------
    ValueError
        If a band reaches beyond the grid.
    """
    wavelength_um = np.asarray(wavelength_um, dtype=float)
    for name in ("band_um", "spectrometer_um"):
        low, high = getattr(design, name)
        if low < wavelength_um[0] - 1e-9 or high > wavelength_um[-1] + 1e-9:
            raise ValueError(
                f"`sensor.{name}` must lie within the atmosphere's {wavelength_um[0]:g} to "
                f"{wavelength_um[-1]:g} µm, got {low:g} to {high:g}"
            )
    # electrons ∝ ∫ λ·QE·τ·L dλ (physics.md, §2.1): photons, not energy, weigh the mean
    pan = Band("pan", *design.band_um).response(wavelength_um) * wavelength_um
    centres, bands = _spectrometer_bands(design, wavelength_um)
    width = design.spectrometer_bandwidth_um
    return Sensor(
        design,
        Camera(design.focal_length_mm * 1e-3, design.pitch_um * 1e-6, design.rows, design.columns),
        channel_weights(wavelength_um, pan[None]),
        _electrons(design, float(pan @ quadrature_weights(wavelength_um)), design.integration_time_ms),
        _analysers(design.layout),
        centres,
        channel_weights(wavelength_um, bands),
        np.array([_electrons(design, x * width, design.spectrometer_integration_time_ms) for x in centres]),
    )


def _spectrometer_bands(design: SensorDesign, wavelength_um: Array) -> tuple[Array, Array]:
    """Centres of the spectrometer's flat bands, and their photon response by overlap with grid cells."""
    start, stop = design.spectrometer_um
    width = design.spectrometer_bandwidth_um
    centres = start + width * (np.arange(max(int((stop - start) / width + 1e-9), 1)) + 0.5)
    half_cell = 0.5 * float(np.min(np.diff(wavelength_um)))
    right = np.minimum(wavelength_um + half_cell, centres[:, None] + width / 2)
    left = np.maximum(wavelength_um - half_cell, centres[:, None] - width / 2)
    return centres, np.maximum(right - left, 0.0) * wavelength_um


def _electrons(design: SensorDesign, photon_integral_um2: float, time_ms: float) -> float:
    """Electrons per unit band-mean radiance, A·Ω·t·QE·τ·∫ λ dλ/(hc), from ∫ λ·response dλ [µm²]."""
    throughput = (design.pitch_um * 1e-6) ** 2 * math.pi / (4 * design.f_number**2 + 1)
    photons_per_joule = photon_integral_um2 * 1e-6 / (h * c)
    efficiency = design.quantum_efficiency * design.optics_transmission
    return throughput * time_ms * 1e-3 * efficiency * photons_per_joule


def _analysers(layout: str) -> Float[Array, "2 2 3"]:
    """Weights of I, Q, U: 1, 0, 0 under the mirror; ½(1, cos 2θ, sin 2θ) under an ideal polarizer."""
    weights = np.zeros((2, 2, 3))
    for (row, column), what in LAYOUTS[layout].items():
        if what == MIRROR:
            weights[row, column] = 1, 0, 0
        else:
            angle = 2 * math.radians(float(what))
            weights[row, column] = 0.5, 0.5 * math.cos(angle), 0.5 * math.sin(angle)
    return weights
