"""Micromirrors: their equilibrium and drive, motion, bending plate and scattered light."""

from glintrack.devices.micromirror import scatter
from glintrack.devices.micromirror.equilibrium import (
    ELECTRODE_ANGLES_RAD,
    ActuatorDesign,
    DriveDesign,
    Equilibrium,
    MicromirrorDesign,
    PlateDesign,
    SurfaceDesign,
    drive_voltages,
    dynamic_pull_in_voltage,
    effective_stiffness,
    equilibrium,
    forces,
    holding_voltage,
    lever_arms,
    pull_in,
    pull_in_voltage,
    steepest_tilt,
)
from glintrack.devices.micromirror.table import tabulate

__all__ = [
    "ELECTRODE_ANGLES_RAD",
    "ActuatorDesign",
    "DriveDesign",
    "Equilibrium",
    "MicromirrorDesign",
    "PlateDesign",
    "SurfaceDesign",
    "drive_voltages",
    "dynamic_pull_in_voltage",
    "effective_stiffness",
    "equilibrium",
    "forces",
    "holding_voltage",
    "lever_arms",
    "pull_in",
    "pull_in_voltage",
    "scatter",
    "steepest_tilt",
    "tabulate",
]
