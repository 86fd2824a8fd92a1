"""Devices over the elements, solved from their physics: wire grids, etalon and micromirror."""

from glintrack.devices import etalon, micromirror, optical_constants, wire_grid
from glintrack.devices.etalon import EtalonDesign
from glintrack.devices.micromirror import MicromirrorDesign
from glintrack.devices.optical_constants import MetalDesign, permittivity
from glintrack.devices.wire_grid.design import PAPER_GRIDS, FemDesign, WireGridDesign

__all__ = [
    "PAPER_GRIDS", "EtalonDesign", "FemDesign", "MetalDesign", "MicromirrorDesign", "WireGridDesign",
    "etalon", "micromirror", "optical_constants", "permittivity", "wire_grid",
]  # fmt: skip
