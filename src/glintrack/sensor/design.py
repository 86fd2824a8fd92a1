"""The sensor's design: one frozen model, from the ``[sensor]`` table of a case."""

import math
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from glintrack.core.arrays import Array
from glintrack.core.designs import Design, refuse_ignored
from glintrack.core.distortion import Distortion
from glintrack.core.installation import data_file, read_data
from glintrack.core.spectral import MAX_WAVELENGTH_UM, MIN_WAVELENGTH_UM, check_band
from glintrack.io.untrusted import resolve_path
from glintrack.sensor import derivation as derive
from glintrack.sensor.catalogue import read_catalogue
from glintrack.sensor.layouts import MIRROR, Demosaicker, Superpixel, check_demosaicker, places, superpixel

_FILES = ("polarizer", "quantum_efficiency", "response", "reference_spectrum")
_OF_CONSTANT_POLARIZER = ("polarizer_transmittance", "polarizer_extinction_ratio")
# keys by the choice, and its values, that use them
_USES = {
    ("polarizer", ("constant",)): _OF_CONSTANT_POLARIZER,
    ("auto_exposure.quantile", ()): ["auto_exposure.longest_ms"],
}
Rms = Annotated[float, Field(ge=-1e4, le=1e4)]
Wavelength = Annotated[
    float, Field(json_schema_extra={"minimum": MIN_WAVELENGTH_UM, "maximum": MAX_WAVELENGTH_UM})
]
Share = Annotated[float, Field(ge=0, le=1)]
Angle = Annotated[float, Field(ge=-360, le=360)]


class OpticsDesign(Design):
    """The lens beyond focal length and F-number; the ``[sensor.optics]`` table. Zero is perfect.

    Aberrations are wavefront errors in the exit pupil as RMS, in nm, whatever the wavelength.
    """

    obscuration: float = Field(default=0.0, ge=0, le=1, description="Diameter of the blocked centre")
    defocus_um: float = Field(default=0.0, ge=-5000, le=5000, description="Detector array behind best focus")
    zernike_rms_nm: dict[int, Rms] = Field(default={})
    """Noll's index (4 defocus, 5-6 astigmatism, 7-8 coma, 11 spherical) to RMS."""
    scatter_fraction: float = Field(default=0.0, ge=0, lt=1, description="Light scattered into the wings")
    relative_illumination: Literal["cos4", "even"] = "cos4"
    """Illumination over the field. Calibration corrects the signal; the corners keep a lower SNR."""
    lens: str = ""
    """Prescription (`glintrack sensor lens`) by name or file: sets wavefront, distortion and vignetting by
    its rays (extra `optics`)."""
    field_zernikes_rms_nm: tuple[tuple[dict[int, Rms], ...], ...] = ()
    """As zernike_rms_nm, added to it: a matrix of places evenly over the frame."""
    distortion: Distortion = Distortion()
    vignetting: float = Field(default=0.0, ge=0, lt=1, description="Further light lost in the corner")
    depolarizer: bool = False
    """Perfect, before the lens: the control for what polarization is worth."""

    @model_validator(mode="after")
    def _check_light_and_terms(self) -> Self:
        if self.obscuration >= 1:
            raise ValueError(
                f"`sensor.optics.obscuration` must leave part of the pupil open; got {self.obscuration}."
            )
        nodes = [node for row in self.field_zernikes_rms_nm for node in row]
        unknown = [index for node in (self.zernike_rms_nm, *nodes) for index in node if not 2 <= index <= 37]
        if unknown:
            raise ValueError(f"`sensor.optics.zernike_rms_nm` must have keys 2 to 37; got {unknown[0]}.")
        sizes = {len(row) for row in self.field_zernikes_rms_nm}
        if nodes and (len(sizes) != 1 or min(*sizes, len(self.field_zernikes_rms_nm), 9) < 2):
            raise ValueError(
                "`sensor.optics.field_zernikes_rms_nm` must be a matrix of two rows and columns at least; "
                f"got rows of {sorted(sizes)}."
            )
        if self.lens and (nodes or self.distortion != Distortion() or self.vignetting):
            raise ValueError(
                "`sensor.optics.lens` must not be given with field_zernikes_rms_nm, distortion or "
                f"vignetting, which it sets; got {self.lens}."
            )
        return self


class PolarizerSpread(Design):
    """Uncalibrated differences between polarizers of one kind; ``[sensor.polarizer_spread]``.

    Each element under a polarizer has its own, normally distributed.
    """

    gain: float = Field(default=0.0, ge=0, le=0.5)
    """RMS of relative gain."""
    diattenuation: float = Field(default=0.0, ge=0, le=0.5)
    """RMS of relative diattenuation."""
    angle_deg: float = Field(default=0.0, ge=0, le=45)
    """RMS error of the pass axis."""


class AutoExposure(Design):
    """Exposure that follows the light from frame to frame; the ``[sensor.auto_exposure]`` table.

    The first frame has ``integration_time_ms``. Each later exposure would have brought a quantile of the
    previous frame's elements to a fixed share of the full well.
    """

    quantile: float = Field(default=0.0, ge=0, lt=1)
    """Of a frame's elements; 0: every frame has integration_time_ms."""
    longest_ms: float = Field(default=1.0, gt=0, le=1000, description="Greatest exposure")


class SensorDesign(Design):
    """Array, lens, polarizers, exposure and spectrometer; the ``[sensor]`` table of a case.

    The default is the paper's standard frame: 880 × 560 elements of 0.75 m at 3000 m slant range.
    A key that is derived follows from the others if it is left out, by the laws of `sensor.derivation`.
    """

    ready: str = Field(default="", description="Ready design to start from (`glintrack sensor list`)")
    focal_length_mm: float = Field(default=68.0, gt=0, le=5000, description="Principal distance")
    f_number: float = Field(default=5.6, ge=0.5, le=64, description="Focal ratio")
    optics: OpticsDesign = OpticsDesign()
    optics_transmission: float = Field(default=0.85, gt=0, le=1)
    """Transmittance of the optics."""
    pitch_um: float = Field(default=17.0, ge=1, le=100)
    """Spacing of the elements (Table 1: 17, 10.8, 8.5)."""
    fill_factor: float = Field(default=1.0, gt=0, le=1, description="Area of an element that collects light")
    rows: int = Field(default=560, ge=4, le=8192, description="Elements down the array")
    columns: int = Field(default=880, ge=4, le=8192, description="Elements across the array")
    layout: str | tuple[tuple[Angle | str, ...], ...] = "mirror-0-60-120"
    """Superpixel: mirror-0-60-120, 0-45-90-135, pan, mirror, rgb, four-bands, or rows of 'mirror', 'open',
    angles [deg] or bands of filters such as '0.5-0.6' [µm]."""
    polarizer: str = "grid_b"
    """ideal, constant, grid_a, grid_b, grid_a_physical, grid_b_physical, or a NetCDF file."""
    polarizer_transmittance: float = Field(default=1.0, gt=0, le=1)
    """Of the pass axis, where the polarizer is 'constant'."""
    polarizer_extinction_ratio: float = Field(default=1e6, ge=1, le=1e12)
    """Pass over block transmittance, where the polarizer is 'constant'."""
    polarizer_incidence: Literal["normal", "chief_ray"] = "normal"
    """Of light on the polarizers: normal (a telecentric lens), or by each element's chief ray."""
    polarizer_spread: PolarizerSpread = PolarizerSpread()
    stokes: Literal["measured", "fesenkov"] = "measured"
    """Invert the polarizers' measured responses, or take them for ideal (Fesenkov)."""
    reference_spectrum: str = "flat"
    """Light the responses were measured in: flat, am15g, or a CSV (wavelength_um, radiance)."""
    demosaic: Demosaicker = "eari"
    """How the polarizer elements come to one place before Stokes is formed."""
    band_um: tuple[Wavelength, Wavelength] = Field(default=(0.4, 1.0), description="Panchromatic band")
    response: str | None = None
    """CSV file (wavelength_um, response) that multiplies the band's filter."""
    quantum_efficiency: Share | str = 0.6
    """Over the whole band, or silicon, or a CSV file (wavelength_um, efficiency)."""
    spot_sigma_um: float = Field(default_factory=derive.spot_sigma, ge=0, le=200)
    """Standard deviation of a Gaussian blur for all aberrations not given as Zernike terms; derived."""
    full_well_e: float = Field(default_factory=derive.full_well, gt=0, le=1e12)
    """Electrons an element can hold; derived."""
    max_frame_rate_hz: float = Field(default=10.0, gt=0, le=1e4, description="Highest readout rate of frames")
    gain_e_per_count: float | None = Field(default=None, gt=0, le=1e9)
    """Electrons a count; the full well over all counts if left out."""
    bits: int = Field(default=14, ge=1, le=24, description="Of the quantizer")
    integration_time_ms: float = Field(default_factory=derive.integration_time, gt=0, le=1000)
    """Exposure of a frame; derived: white paint in sunlight half fills the well."""
    auto_exposure: AutoExposure = AutoExposure()
    read_noise_e: float = Field(default_factory=derive.read_noise, ge=0, le=1e6, description="RMS; derived")
    dark_current_e_per_s: float = Field(default=0.0, ge=0, le=1e9, description="Mean over the elements")
    prnu: float = Field(default=0.0, ge=0, le=0.5, description="RMS of the elements' relative gains")
    dsnu_e: float = Field(default=0.0, ge=0, le=1e6)
    """RMS of the elements' dark offsets, electrons."""
    oversampling: int = Field(default=3, ge=1, le=5, description="Rays along each side of an element")
    sun_samples: int = Field(default=1, ge=1, le=64)
    """Rays from each point to the sun's disc; 1 goes to its centre, and shadows are sharp."""
    spectrometer: Literal["relay", "etalon"] = "relay"
    """The mirrors feed a grating spectrometer, or are tunable etalons themselves."""
    spectrometer_um: tuple[Wavelength, Wavelength] = (0.4, 1.0)
    """Range of the spectrometer."""
    spectrometer_bandwidth_um: float = Field(default=0.01, ge=0.01, le=0.1)
    """Of each of its bands."""
    spectrometer_integration_time_ms: float = Field(default=10.0, gt=0, le=1000)
    """Exposure of a spectrum."""
    mirror_settling_ms: float = Field(default=0.0, ge=0, le=1000)
    """Settling time of the mirrors in each frame, before the exposure starts."""
    mirror_throughput: float = Field(default=1.0, gt=0, le=1)
    """Light into the spectrometer over light on the mirror."""
    fill_dark_mirrors: Literal["none", "spectrum", "interpolate", "polarizers"] = "none"
    """Pan value of a mirror that faces the spectrometer: NaN, the band integral of its spectrum, the mean of
    the neighbours, or S0 of the same superpixel."""

    @model_validator(mode="before")
    @classmethod
    def _start_from_a_ready_design(cls, values: Any) -> Any:
        if not isinstance(values, dict) or not values.get("ready"):
            return values
        base = design_keys(str(values["ready"]))
        if values.get("pitch_um", base.get("pitch_um")) != base.get("pitch_um"):
            base = {key: v for key, v in base.items() if key not in derive.ORIGINS}  # those of another pitch
        if values.get("polarizer", "constant") != "constant":
            base = {key: v for key, v in base.items() if key not in _OF_CONSTANT_POLARIZER}
        both = {**base, **values}
        if isinstance(base.get("optics"), dict) and isinstance(values.get("optics"), dict):
            both["optics"] = {**base["optics"], **values["optics"]}
        return both

    @model_validator(mode="after")
    def _check_superpixels_and_bands(self) -> Self:
        side = len(self.superpixel)
        for name in ("rows", "columns"):
            if getattr(self, name) % side:
                raise ValueError(
                    f"`sensor.{name}` must be {'even' if side == 2 else f'a multiple of {side}'} "
                    f"({side}×{side} superpixels); got {getattr(self, name)}."
                )
        refuse_ignored(self, _USES)
        check_demosaicker(self.demosaic, self.superpixel)
        check_band("sensor.band_um", *self.band_um)
        check_band("sensor.spectrometer_um", *self.spectrometer_um)
        if not isinstance(self.quantum_efficiency, str) and not 0 < self.quantum_efficiency <= 1:
            raise ValueError(
                f"`sensor.quantum_efficiency` must be above 0 and at most 1; got {self.quantum_efficiency}."
            )
        return self

    @model_validator(mode="after")
    def _check_times_and_filling(self) -> Self:
        """Check that exposures fit into a frame, and that dark mirrors can be filled."""
        frame_ms = 1e3 / self.max_frame_rate_hz
        times_ms = {
            "integration_time_ms": self.integration_time_ms,
            "spectrometer_integration_time_ms": self.has_mirror * self.spectrometer_integration_time_ms,
            "auto_exposure.longest_ms": self.longest_integration_time_ms,
        }
        for name, time_ms in times_ms.items():
            if time_ms > frame_ms:
                raise ValueError(
                    f"`sensor.{name}` must end within a frame's {frame_ms:g} ms (see max_frame_rate_hz); "
                    f"got {time_ms:g}."
                )
        exposure_ms = max(self.longest_integration_time_ms, self.spectrometer_integration_time_ms)
        if self.has_mirror and self.mirror_settling_ms + exposure_ms > frame_ms:
            raise ValueError(
                f"`sensor.mirror_settling_ms` must leave the {exposure_ms:g} ms of exposure of a frame's "
                f"{frame_ms:g} ms (see max_frame_rate_hz); got {self.mirror_settling_ms:g}."
            )
        first, last = self.spectrometer_um
        if self.fill_dark_mirrors == "spectrum" and not (
            first <= self.band_um[0] + 1e-9 and last >= self.band_um[1] - 1e-9
        ):
            raise ValueError(
                "`sensor.fill_dark_mirrors` must not be 'spectrum' where the spectrometer does not span the "
                f"pan band; got spectrometer_um = {self.spectrometer_um} and band_um = {self.band_um}."
            )
        if self.fill_dark_mirrors == "polarizers" and not self.has_stokes:
            raise ValueError(
                "`sensor.fill_dark_mirrors` must not be 'polarizers' without polarizers; "
                f"got layout {self.layout!r}."
            )
        return self

    def explicit_values(self) -> dict[str, Any]:
        """Values that differ from the defaults and from the ready design."""
        values = super().explicit_values()
        if not self.ready:
            return values
        own = SensorDesign(ready=self.ready)
        # a derived value of the ready design changes with its other keys, where a stated one does not
        changed = self.pitch_um != own.pitch_um
        kept = {"ready", *(key for key in derive.ORIGINS if changed or key not in own.model_fields_set)}
        return {name: v for name, v in values.items() if name in kept or v != getattr(own, name)}

    @property
    def superpixel(self) -> Superpixel:
        """Polarizer, mirror or nothing over each element."""
        return superpixel(self.layout)

    @property
    def second_exposure_ends_ms(self) -> float:
        """End of the second exposure (spectra of a frame's own detections) from the frame's start. [ms]"""
        longest_ms = self.longest_integration_time_ms
        return longest_ms + self.mirror_settling_ms + self.spectrometer_integration_time_ms

    @property
    def longest_integration_time_ms(self) -> float:
        """Longest exposure of any frame. [ms]"""
        automatic = self.auto_exposure
        return automatic.longest_ms if automatic.quantile else self.integration_time_ms

    @property
    def has_mirror(self) -> bool:
        """Return True if queries can be served."""
        return bool(places(self.superpixel, MIRROR))

    @property
    def has_stokes(self) -> bool:
        """Return True if there are polarizers."""
        return bool(places(self.superpixel, "polarizer"))

    @property
    def electrons_per_count(self) -> float:
        """Gain of the quantizer."""
        return self.gain_e_per_count or self.full_well_e / 2**self.bits

    @property
    def saturation_e(self) -> float:
        """Electrons at which an element or its converter is full."""
        return min(self.full_well_e, (2**self.bits - 1) * self.electrons_per_count)

    @property
    def pedestal_counts(self) -> int:
        """Counts of the converter below zero, so that dark noise is not cut off."""
        spread_e = math.hypot(self.dark_noise_e, self.dsnu_e)
        return max(64, math.ceil(6 * spread_e / self.electrons_per_count))

    @property
    def pitch_m(self) -> float:
        """Spacing of the elements. [m]"""
        return self.pitch_um * 1e-6

    @property
    def focal_length_m(self) -> float:
        """Principal distance. [m]"""
        return self.focal_length_mm * 1e-3

    @property
    def ifov_rad(self) -> float:
        """Instantaneous field of view of an element on the axis; times the slant range its GSD. [rad]"""
        return 1e-3 * self.pitch_um / self.focal_length_mm

    @property
    def field_of_view_deg(self) -> tuple[float, float]:
        """Field of view across columns and rows. [deg]"""
        tangents = (n / 2 * self.pitch_m / self.focal_length_m for n in (self.columns, self.rows))
        columns, rows = (2 * math.degrees(math.atan(half)) for half in tangents)
        return columns, rows

    @property
    def dark_noise_e(self) -> float:
        """RMS of dark current, read and quantizer noise of one element. [e]"""
        dark_e = self.dark_current_e_per_s * self.integration_time_ms * 1e-3
        return math.sqrt(dark_e + self.read_noise_e**2 + self.electrons_per_count**2 / 12)

    def noise_variance_e2(self, electrons: Array | float) -> Array:
        """Variance of shot and dark noise of elements with so many electrons of light. [e²]"""
        return np.maximum(electrons, 0) + self.dark_noise_e**2

    def resolve_files(self, folder: Path) -> "SensorDesign":
        """Resolve relative file names against a folder."""
        found = {}
        for name in _FILES:
            value = getattr(self, name)
            if isinstance(value, str) and Path(value).suffix:
                found[name] = str(resolve_path(folder / value))
        if Path(self.optics.lens).suffix:
            lens = str(resolve_path(folder / self.optics.lens))
            found["optics"] = self.optics.model_copy(update={"lens": lens})
        return self.model_copy(update=found) if found else self


def design_names() -> list[str]:
    """Names of the ready designs that come with the package."""
    return sorted(path.stem for path in data_file("sensors").glob("*.toml"))


def design_keys(name: str) -> dict[str, Any]:
    """Keys of a ready design, or of a detector array of the catalogue; their files name the sources.

    Raises
    ------
    ValueError
        If there is none of that name.
    """
    packaged, arrays = design_names(), read_catalogue("detectors")
    if name not in (*packaged, *arrays):
        raise ValueError(
            f"`sensor.ready` must be one of {', '.join(packaged)}, or a detector of "
            f"`glintrack sensor list`; got {name!r}."
        )
    array = dict(arrays[name].figures) if name in arrays else {}
    return array | (read_data("sensors", f"{name}.toml") if name in packaged else {})
