"""The adaptive sensor: superpixels, noise, spectra on request, and a navigator that errs."""

from .design import Sensor, SensorDesign, build_sensor
from .focalplane import expose, noise_equivalent_radiance
from .motion import image_motion, motion_kernel, smeared
from .navigation import NavigationDesign, navigate, navigation_errors
from .spectrometer import measure_spectra, serve

__all__ = [
    "NavigationDesign",
    "Sensor",
    "SensorDesign",
    "build_sensor",
    "expose",
    "image_motion",
    "measure_spectra",
    "motion_kernel",
    "navigate",
    "navigation_errors",
    "noise_equivalent_radiance",
    "serve",
    "smeared",
]
