"""Wire-grid polarizers, solved from Maxwell's equations (extra ``em``) or read from the shipped tables."""

from typing import TYPE_CHECKING

from glintrack.core.lazy import lazy_names

if TYPE_CHECKING:
    from glintrack.devices.wire_grid.table import (
        ANGLES_DEG,
        SOLVED,
        can_solve,
        field_maps,
        load,
        response,
        solve,
    )

__all__ = [
    "ANGLES_DEG",
    "SOLVED",
    "can_solve",
    "field_maps",
    "load",
    "response",
    "solve",
]
__getattr__, __dir__ = lazy_names(__name__, __file__)
