"""Devices over the detector's elements, solved from their physics: wire grids, etalon and micromirror."""

from . import optical_constants, wiregrid
from .grid_design import PAPER_GRIDS, FemDesign, WireGridDesign
from .optical_constants import (
    MetalDesign,
    conductor_permittivity,
    lorentz_drude_permittivity,
    permittivity,
    read_nk,
)

__all__ = [
    "PAPER_GRIDS",
    "FemDesign",
    "MetalDesign",
    "WireGridDesign",
    "conductor_permittivity",
    "lorentz_drude_permittivity",
    "optical_constants",
    "permittivity",
    "read_nk",
    "wiregrid",
]
