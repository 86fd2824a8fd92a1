"""How a picture of the ground, or the aircraft's view, lies: where north and the sun are, and its scale."""

import math
from dataclasses import dataclass

import numpy as np

from glintrack.camera import Camera, Pose, ground_points, project
from glintrack.core.arrays import Array

_FAR_M = 20.0  # over which a direction is measured in the picture


@dataclass(frozen=True)
class Bearings:
    """How a picture lies: directions as (right, up), of any length, and its scale.

    Parameters
    ----------
    north, sun
        Toward north, and toward where the sun stands; None for a sun that is not known.
    units_per_m
        Of the axes, for a length across the picture. [1/m]
    where
        At which place the scale holds, where it is not the same all over.
    """

    north: tuple[float, float]
    sun: tuple[float, float] | None
    units_per_m: float = 1.0
    where: str = ""


def azimuth_of(direction: Array) -> float:
    """Clockwise from north, of a direction in ENU. [rad]"""
    return math.atan2(float(direction[0]), float(direction[1]))


def on_map(sun_azimuth_rad: float | None) -> Bearings:
    """Of a map in ENU metres, north up."""
    sun = None if sun_azimuth_rad is None else (math.sin(sun_azimuth_rad), math.cos(sun_azimuth_rad))
    return Bearings((0.0, 1.0), sun)


def in_view(camera: Camera, pose: Pose, sun_azimuth_rad: float) -> Bearings | None:
    """Of the aircraft's view, at the middle of the frame on level ground; None if that is the sky."""
    middle = ground_points(camera, pose, np.array([camera.rows - 1, camera.columns - 1]) / 2)
    if not np.isfinite(middle).all():
        return None
    north = np.array([0.0, 1.0, 0.0])
    sun = np.array([math.sin(sun_azimuth_rad), math.cos(sun_azimuth_rad), 0.0])
    line = middle - pose.position
    across = np.cross(line, [0.0, 0.0, 1.0])
    length = float(np.linalg.norm(across))
    across = across / length if length > 1e-9 * float(np.linalg.norm(line)) else np.array([1.0, 0.0, 0.0])
    steps = _FAR_M * np.stack([north, sun, across])
    moved = project(camera, pose, middle + steps) - project(camera, pose, middle - steps)
    right_up = np.stack([moved[:, 1], -moved[:, 0]], axis=1)
    scale = float(np.linalg.norm(right_up[2])) / (2 * _FAR_M)
    return Bearings(_pair(right_up[0]), _pair(right_up[1]), scale, "across the middle")


def _pair(values: Array) -> tuple[float, float]:
    return float(values[0]), float(values[1])
