"""Light that reaches the sensor: geometry traced once, spectra and Stokes components on demand."""

from glintrack.render.light.sky import Sky, unpack_sky
from glintrack.render.observer import FrameCache, Observer, TracedFrame, keep_frames
from glintrack.render.rays.surfaces import Tracer
from glintrack.render.shade import shade, shade_blocks
from glintrack.render.shading.hits import Hits, one_sample_each
from glintrack.render.trace import frame_rays, trace
from glintrack.render.tracer import SceneTracer, build_tracer, surface_model
from glintrack.render.vehicles import (
    Outlines,
    build_vehicle_tracer,
    elements_near_traffic,
    outlines,
    vehicle_mask,
    visible_fraction,
)

__all__ = [
    "FrameCache", "Hits", "Observer", "Outlines", "SceneTracer", "Sky", "TracedFrame", "Tracer",
    "build_tracer", "build_vehicle_tracer", "elements_near_traffic", "frame_rays", "keep_frames",
    "one_sample_each", "outlines", "shade", "shade_blocks", "surface_model", "trace", "unpack_sky",
    "vehicle_mask", "visible_fraction",
]  # fmt: skip
