"""The adaptive sensor: superpixels, lens, noise, spectra on request, and a navigator that errs."""

from glintrack.sensor.demosaicking import boost, demosaic
from glintrack.sensor.design import OpticsDesign, SensorDesign, design_keys, design_names
from glintrack.sensor.exposure import (
    array_readout,
    depolarize,
    expose,
    frame_of,
    light_on_elements,
    mosaic_of,
    next_exposure_ms,
    noiseless_frame,
    photo_electrons,
    read_out,
    with_exposure,
)
from glintrack.sensor.ghosts import ghosts, with_window
from glintrack.sensor.lens import LensDesign, lens_quality, read_lens, with_lens
from glintrack.sensor.navigation import NavigationDesign, image_motion, navigate, navigation_errors, smear
from glintrack.sensor.polarizer import Polarizer, load_polarizer
from glintrack.sensor.presets import build_preset, read_arrays, read_presets
from glintrack.sensor.raw import RawDesign, measure_polarization, read_analysers
from glintrack.sensor.response import response_curves
from glintrack.sensor.sensor import Sensor, build_sensor, noise_equivalent_radiance
from glintrack.sensor.spectrometer import fill_dark_mirrors, measure_spectra, noiseless_spectra, serve
from glintrack.sensor.wavefront import modulation_transfer

__all__ = [
    "LensDesign", "NavigationDesign", "OpticsDesign", "Polarizer", "RawDesign", "Sensor", "SensorDesign",
    "array_readout", "boost", "build_preset", "build_sensor", "demosaic", "depolarize", "design_keys",
    "design_names", "expose", "fill_dark_mirrors", "frame_of", "ghosts", "image_motion", "lens_quality",
    "light_on_elements", "load_polarizer", "measure_polarization", "measure_spectra", "modulation_transfer",
    "mosaic_of", "navigate", "navigation_errors", "next_exposure_ms", "noise_equivalent_radiance",
    "noiseless_frame", "noiseless_spectra", "photo_electrons", "read_analysers", "read_arrays", "read_lens",
    "read_out", "read_presets", "response_curves", "serve", "smear", "with_exposure", "with_lens",
    "with_window",
]  # fmt: skip
