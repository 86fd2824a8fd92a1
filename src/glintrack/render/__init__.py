"""Light that reaches the sensor: geometry traced once, spectra and Stokes components on demand."""

from glintrack.render.hits import Hits, one_sample_each
from glintrack.render.imaged import Outlines, outlines, vehicle_mask
from glintrack.render.observer import FrameCache, LightCache, Observer, TracedFrame, keep_frames
from glintrack.render.rays.tracer import SceneTracer, build_tracer
from glintrack.render.rays.tracer_protocol import Tracer
from glintrack.render.sampling import Sampling
from glintrack.render.shade import shade, shade_blocks
from glintrack.render.sky import Sky, unpack_sky
from glintrack.render.surface_model import surface_model
from glintrack.render.trace import frame_rays, trace
from glintrack.render.visibility import build_bare_tracer, visible_fraction
from glintrack.render.without_traffic import in_reach, without_traffic

__all__ = [
    "FrameCache",
    "Hits",
    "LightCache",
    "Observer",
    "Outlines",
    "Sampling",
    "SceneTracer",
    "Sky",
    "TracedFrame",
    "Tracer",
    "build_bare_tracer",
    "build_tracer",
    "frame_rays",
    "in_reach",
    "keep_frames",
    "one_sample_each",
    "outlines",
    "shade",
    "shade_blocks",
    "surface_model",
    "trace",
    "unpack_sky",
    "vehicle_mask",
    "visible_fraction",
    "without_traffic",
]
