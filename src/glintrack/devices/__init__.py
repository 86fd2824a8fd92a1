"""Devices over the detector's elements, solved from their physics: wire grids, etalon and micromirror."""

from . import etalon, gap_sweep, micromirror, optical_constants, scatter, wiregrid
from .etalon import EtalonDesign
from .grid_design import PAPER_GRIDS, FemDesign, WireGridDesign
from .micromirror import MicromirrorDesign
from .optical_constants import (
    MetalDesign,
    conductor_permittivity,
    lorentz_drude_permittivity,
    permittivity,
    read_nk,
)

__all__ = [
    "PAPER_GRIDS",
    "EtalonDesign",
    "FemDesign",
    "MetalDesign",
    "MicromirrorDesign",
    "WireGridDesign",
    "conductor_permittivity",
    "etalon",
    "gap_sweep",
    "lorentz_drude_permittivity",
    "micromirror",
    "optical_constants",
    "permittivity",
    "read_nk",
    "scatter",
    "wiregrid",
]
