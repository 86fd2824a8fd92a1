"""Micromirrors: their equilibrium and drive, motion, bending plate and scattered light."""

from glintrack.devices.micromirror.dynamics import tabulate
from glintrack.devices.micromirror.equilibrium import MicromirrorDesign, equilibrium, pull_in, steepest_tilt

__all__ = ["MicromirrorDesign", "equilibrium", "pull_in", "steepest_tilt", "tabulate"]
