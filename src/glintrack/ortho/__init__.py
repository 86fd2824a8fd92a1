"""Rectification: frames to a fixed ground grid, what is hidden there, and registration."""

from glintrack.ortho.grid import (
    ground_grid,
    heights_at,
    intersect_terrain,
    on_ground,
    transform_axes,
    transform_places,
)
from glintrack.ortho.occlusion import occlusion_mask
from glintrack.ortho.rectify import METHODS, orthorectify, rectify_array, rectify_onto, register

__all__ = [
    "METHODS", "ground_grid", "heights_at", "intersect_terrain", "occlusion_mask", "on_ground",
    "orthorectify", "rectify_array", "rectify_onto", "register", "transform_axes", "transform_places",
]  # fmt: skip
