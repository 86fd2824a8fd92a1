"""What reaches the sensor: geometry traced once, spectra and Stokes components on demand."""

from .hits import Hits
from .shade import shade, shade_blocks
from .sky import Sky, unpack_sky
from .trace import trace
from .tracer import build_tracer
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
