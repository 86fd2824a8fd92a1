"""Wire-grid polarizers, solved from Maxwell's equations (extra ``em``) or read from the shipped tables."""

from glintrack.devices.wire_grid.table import ANGLES_DEG, SOLVED, can_solve, field_maps, load, response, solve

__all__ = ["ANGLES_DEG", "SOLVED", "can_solve", "field_maps", "load", "response", "solve"]
