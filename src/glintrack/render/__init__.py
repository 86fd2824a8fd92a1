"""What reaches the sensor: geometry traced once, spectra and Stokes components on demand."""

from .shade import shade
from .sky import Sky, unpack_sky
from .trace import Hits, build_tracer, trace
from .visibility import build_bare_tracer, visible_fraction

__all__ = [
    "Hits",
    "Sky",
    "build_bare_tracer",
    "build_tracer",
    "shade",
    "trace",
    "unpack_sky",
    "visible_fraction",
]
