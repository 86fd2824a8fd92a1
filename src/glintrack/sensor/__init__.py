"""The adaptive sensor: superpixels, lens, noise, spectra on request, and a navigator that errs."""

from typing import TYPE_CHECKING

from glintrack.core.lazy import lazy_names

if TYPE_CHECKING:
    from glintrack.sensor.auto_exposure import next_exposure_ms, with_exposure
    from glintrack.sensor.design import OpticsDesign, SensorDesign, ready_design, ready_designs
    from glintrack.sensor.exposure import (
        dark_noise_e,
        depolarized,
        detector_readout,
        expose,
        frame_of,
        light_on_elements,
        noise_equivalent_radiance,
        noise_scales,
    )
    from glintrack.sensor.ideal import noiseless_frame, noiseless_spectra
    from glintrack.sensor.layouts import Demosaicker
    from glintrack.sensor.lens.ghosts import Ghost, ghosts, with_window
    from glintrack.sensor.lens.in_frame import with_lens
    from glintrack.sensor.lens.prescription import (
        LensDesign,
        lens_names,
        lens_quality,
        read_lens,
        wavefront_rms,
    )
    from glintrack.sensor.mosaic import mosaic_of
    from glintrack.sensor.motion import image_motion, motion_kernel, smear
    from glintrack.sensor.navigation import NavigationDesign, navigate, navigation_errors
    from glintrack.sensor.polarimetry import boost, debiased_dolp, demosaic, masked_aop, stokes_noise
    from glintrack.sensor.polarizer import Polarizer, load_polarizer
    from glintrack.sensor.raw import Analysers, RawDesign, measure_polarization, read_analysers
    from glintrack.sensor.readout import photo_electrons, read_out
    from glintrack.sensor.sensor import Sensor, build_sensor, response_curves
    from glintrack.sensor.spectrometer import fill_dark_mirrors, measure_spectra, serve
    from glintrack.sensor.wavefront import modulation_transfer, point_spread, wavefront_um

__all__ = [
    "Analysers",
    "Demosaicker",
    "Ghost",
    "LensDesign",
    "NavigationDesign",
    "OpticsDesign",
    "Polarizer",
    "RawDesign",
    "Sensor",
    "SensorDesign",
    "boost",
    "build_sensor",
    "dark_noise_e",
    "debiased_dolp",
    "demosaic",
    "depolarized",
    "detector_readout",
    "expose",
    "fill_dark_mirrors",
    "frame_of",
    "ghosts",
    "image_motion",
    "lens_names",
    "lens_quality",
    "light_on_elements",
    "load_polarizer",
    "masked_aop",
    "measure_polarization",
    "measure_spectra",
    "modulation_transfer",
    "mosaic_of",
    "motion_kernel",
    "navigate",
    "navigation_errors",
    "next_exposure_ms",
    "noise_equivalent_radiance",
    "noise_scales",
    "noiseless_frame",
    "noiseless_spectra",
    "photo_electrons",
    "point_spread",
    "read_analysers",
    "read_lens",
    "read_out",
    "ready_design",
    "ready_designs",
    "response_curves",
    "serve",
    "smear",
    "stokes_noise",
    "wavefront_rms",
    "wavefront_um",
    "with_exposure",
    "with_lens",
    "with_window",
]
__getattr__, __dir__ = lazy_names(__name__, __file__)
