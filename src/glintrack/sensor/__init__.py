"""The adaptive sensor: superpixels, lens, noise, spectra on request, and a navigator that errs."""

from .design import OpticsDesign, SensorDesign, ready_design, ready_designs
from .focalplane import dark_noise_e, expose, frame_of, noise_equivalent_radiance, read_elements
from .ghosts import Ghost, ghosts, with_window
from .instrument import Sensor, build_sensor, response_curves
from .lens import LensDesign, lens_names, lens_quality, read_lens, wavefront_rms
from .lens_in_frame import with_lens
from .motion import image_motion, motion_kernel, smeared
from .navigation import NavigationDesign, navigate, navigation_errors
from .optics import modulation_transfer, point_spread, wavefront_um
from .polarimetry import boost, debiased_dolp, demosaic, masked_aop, stokes_noise
from .polarizer import dolp_bias, transmitted
from .spectrometer import fill_dark_mirrors, measure_spectra, serve
from .truth import noiseless_frame, noiseless_spectra

__all__ = [
    "Ghost",
    "LensDesign",
    "NavigationDesign",
    "OpticsDesign",
    "Sensor",
    "SensorDesign",
    "boost",
    "build_sensor",
    "dark_noise_e",
    "debiased_dolp",
    "demosaic",
    "dolp_bias",
    "expose",
    "frame_of",
    "fill_dark_mirrors",
    "ghosts",
    "image_motion",
    "lens_names",
    "lens_quality",
    "masked_aop",
    "measure_spectra",
    "modulation_transfer",
    "motion_kernel",
    "navigate",
    "navigation_errors",
    "noise_equivalent_radiance",
    "noiseless_frame",
    "noiseless_spectra",
    "point_spread",
    "read_elements",
    "read_lens",
    "ready_design",
    "ready_designs",
    "response_curves",
    "serve",
    "smeared",
    "stokes_noise",
    "transmitted",
    "wavefront_rms",
    "wavefront_um",
    "with_lens",
    "with_window",
]
