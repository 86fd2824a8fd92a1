"""North, the sun's direction and a scale bar on a picture, of the ground or as the aircraft sees it."""

import math
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import AbstractPathEffect, withStroke
from matplotlib.text import Annotation

from glintrack.arrays import Array
from glintrack.camera import Camera, Pose, ground_points, project

_STEPS = (1, 2, 5)
_BAR_SHARE = 0.2  # of the picture's width that the bar takes at most
_ARROW_PT = 22.0
_FAR_M = 20.0  # over which a direction is measured in the picture
_SUN_COLOUR = "#ffd94a"
_OUTLINE: list[AbstractPathEffect] = [withStroke(linewidth=3.0, foreground=(0, 0, 0, 0.75))]


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


def round_length(most: float) -> float:
    """The longest of 1, 2, 5, 10, 20 … that is no longer."""
    power = 10.0 ** math.floor(math.log10(most))
    return max(step * power for step in _STEPS if step * power <= most * (1 + 1e-9))


def draw_bearings(ax: Axes, bearings: Bearings) -> None:
    """North and sun at the upper left, the scale bar at the lower left, over what is drawn."""
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    wide, high = right - left, top - bottom
    length_m = round_length(_BAR_SHARE * abs(wide) / bearings.units_per_m)
    x, y = left + 0.02 * wide, bottom + 0.03 * high
    bar = math.copysign(length_m * bearings.units_per_m, wide)
    style = {"color": "white", "lw": 1.6, "path_effects": _OUTLINE, "solid_capstyle": "butt", "zorder": 9}
    ax.plot(
        [x, x, x + bar, x + bar],
        [y + 0.012 * high, y, y, y + 0.012 * high],
        **style,
        scalex=False,
        scaley=False,
    )
    said = f"{length_m:g} m {bearings.where}".strip()
    _say(ax, said, (x + bar, y), (5, 0), {"xycoords": "data", "ha": "left", "va": "bottom"})
    _arrow(ax, 0.05, bearings.north, "N", "white")
    if bearings.sun is not None:
        _arrow(ax, 0.05 + 0.085, bearings.sun, "sun", _SUN_COLOUR)


def _arrow(ax: Axes, across: float, direction: tuple[float, float], name: str, colour: str) -> None:
    """An arrow about a point of the axes, with its name below."""
    length = math.hypot(*direction)
    if length == 0:
        return
    dx, dy = (0.5 * _ARROW_PT * part / length for part in direction)
    place = {"xycoords": "axes fraction", "textcoords": "offset points", "annotation_clip": False}
    foot = ax.annotate("", (across, 0.93), (-dx, -dy), **place)
    tip = ax.annotate("", (across, 0.93), (dx, dy), **place)
    for width, shade in ((4.5, (0, 0, 0, 0.75)), (1.8, colour)):
        drawn = ax.annotate(
            "", (0.5, 0.5), (0.5, 0.5), xycoords=tip, textcoords=foot, annotation_clip=False,
            arrowprops={"arrowstyle": "->", "color": shade, "lw": width, "shrinkA": 0, "shrinkB": 0},
        )  # fmt: skip
        drawn.set_zorder(9)
    _say(
        ax,
        name,
        (across, 0.93),
        (0, -0.5 * _ARROW_PT - 3),
        {"xycoords": "axes fraction", "ha": "center", "va": "top"},
    )


def _say(
    ax: Axes, text: str, place: tuple[float, float], offset: tuple[float, float], style: dict
) -> Annotation:
    said = ax.annotate(
        text, place, offset, textcoords="offset points", color="white", fontsize=8, fontweight="bold",
        annotation_clip=False, **style,
    )  # fmt: skip
    said.set_path_effects(_OUTLINE)
    said.set_zorder(9)
    return said


def _pair(values: Array) -> tuple[float, float]:
    return float(values[0]), float(values[1])
