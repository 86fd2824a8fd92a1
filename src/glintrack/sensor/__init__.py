"""The adaptive sensor: superpixels, noise, spectra on request, and a navigator that errs."""

from .design import Sensor, SensorDesign, build_sensor
from .focalplane import expose, noise_equivalent_radiance
from .navigation import NavigationDesign, navigate
from .spectrometer import measure_spectra, serve

__all__ = [
    "NavigationDesign",
    "Sensor",
    "SensorDesign",
    "build_sensor",
    "expose",
    "measure_spectra",
    "navigate",
    "noise_equivalent_radiance",
    "serve",
]
