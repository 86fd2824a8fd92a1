"""Devices over the detector's elements, solved from their physics: wire grids, etalon and micromirror."""

from glintrack.devices import etalon, micromirror, optical_constants, wire_grid
from glintrack.devices.etalon import EtalonDesign
from glintrack.devices.micromirror import MicromirrorDesign
from glintrack.devices.optical_constants import (
    MetalDesign,
    conductor_permittivity,
    lorentz_drude_permittivity,
    permittivity,
    read_nk,
)
from glintrack.devices.wire_grid.design import PAPER_GRIDS, FemDesign, WireGridDesign

__all__ = [
    "PAPER_GRIDS",
    "EtalonDesign",
    "FemDesign",
    "MetalDesign",
    "MicromirrorDesign",
    "WireGridDesign",
    "conductor_permittivity",
    "etalon",
    "lorentz_drude_permittivity",
    "micromirror",
    "optical_constants",
    "permittivity",
    "read_nk",
    "wire_grid",
]
