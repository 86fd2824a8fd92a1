"""Wire-grid polarizers, solved from Maxwell's equations (extra ``em``) or read from the shipped tables."""

from typing import TYPE_CHECKING

from glintrack.lazy import lazy_names

if TYPE_CHECKING:
    from glintrack.devices.wire_grid.table import (
        ANGLES_DEG,
        SOLVED,
        can_solve,
        complete,
        describe_metal,
        field_maps,
        field_ratio,
        load,
        response,
        solve,
        transmittance,
    )

_HOMES = {
    "ANGLES_DEG": "glintrack.devices.wire_grid.table:ANGLES_DEG",
    "SOLVED": "glintrack.devices.wire_grid.table:SOLVED",
    "can_solve": "glintrack.devices.wire_grid.table:can_solve",
    "complete": "glintrack.devices.wire_grid.table:complete",
    "describe_metal": "glintrack.devices.wire_grid.table:describe_metal",
    "field_maps": "glintrack.devices.wire_grid.table:field_maps",
    "field_ratio": "glintrack.devices.wire_grid.table:field_ratio",
    "load": "glintrack.devices.wire_grid.table:load",
    "response": "glintrack.devices.wire_grid.table:response",
    "solve": "glintrack.devices.wire_grid.table:solve",
    "transmittance": "glintrack.devices.wire_grid.table:transmittance",
}
__all__ = [
    "ANGLES_DEG",
    "SOLVED",
    "can_solve",
    "complete",
    "describe_metal",
    "field_maps",
    "field_ratio",
    "load",
    "response",
    "solve",
    "transmittance",
]
__getattr__, __dir__ = lazy_names(__name__, _HOMES)
