"""What reaches the sensor: geometry traced once, spectra and Stokes components on demand."""

from .shade import shade, shade_blocks
from .sky import Sky, unpack_sky
from .trace import Hits, build_tracer, trace
from .visibility import build_bare_tracer, visible_fraction

__all__ = [
    "Hits",
    "Sky",
    "build_bare_tracer",
    "build_tracer",
    "shade",
    "shade_blocks",
    "trace",
    "unpack_sky",
    "visible_fraction",
]
