"""Rectification: detector frames to a fixed ground grid, what is hidden there, and registration."""

from glintrack.ortho.grid import (
    ground_grid,
    heights_at,
    on_ground,
    seen_ground,
    transform_axes,
    transform_places,
)
from glintrack.ortho.occlusion import occlusion_mask
from glintrack.ortho.rectify import (
    METHODS,
    orthorectify,
    rectify_array,
    rectify_frame,
    rectify_onto,
    rectify_stokes,
    register,
)

__all__ = [
    "METHODS",
    "ground_grid",
    "heights_at",
    "occlusion_mask",
    "on_ground",
    "orthorectify",
    "rectify_array",
    "rectify_frame",
    "rectify_onto",
    "rectify_stokes",
    "register",
    "seen_ground",
    "transform_axes",
    "transform_places",
]
