"""What reaches the sensor: geometry traced once, spectra and Stokes components on demand."""

from .hits import Hits, one_ray_each
from .shade import shade, shade_blocks
from .sky import Sky, unpack_sky
from .surface_model import surface_model
from .trace import frame_rays, trace
from .tracer import SceneTracer, build_tracer
from .tracer_protocol import Tracer
from .visibility import build_bare_tracer, visible_fraction

__all__ = [
    "Hits",
    "SceneTracer",
    "Sky",
    "Tracer",
    "build_bare_tracer",
    "build_tracer",
    "frame_rays",
    "one_ray_each",
    "shade",
    "shade_blocks",
    "surface_model",
    "trace",
    "unpack_sky",
    "visible_fraction",
]
