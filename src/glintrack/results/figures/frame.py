"""One rendered frame as a picture with its scale, north, the sun's direction and a scale bar."""

import math
from dataclasses import dataclass

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patheffects import AbstractPathEffect, withStroke

from glintrack.camera import Camera, Pose, ground_points, project
from glintrack.core.arrays import Array
from glintrack.io.images import DOTS_PER_INCH
from glintrack.results.figures import AOP, DOLP, HIGHEST_DOLP, NO_DATA, RADIANCE

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


MASKED = np.array(to_rgb(NO_DATA))  # no data, or no polarization to speak of
FADE_DOLP = 0.05  # angles of light less polarized than this fade to grey
_INCHES_WIDE = 10.0
_STEPS = (1, 2, 5)
_BAR_SHARE = 0.2  # of the picture's width that the bar takes at most
_ARROW_PT = 22.0
_SUN_COLOUR = "#ffd94a"
_OUTLINE: list[AbstractPathEffect] = [withStroke(linewidth=3.0, foreground=(0, 0, 0, 0.75))]


def radiance_colours(values: Float[Array, "y x"]) -> tuple[Float[Array, "y x 3"], ScalarMappable]:
    """Black to white over the middle 98 % of a radiance. [1]"""
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, [1, 99]) if known.size else (0.0, 1.0)
    return _mapped(values, RADIANCE, float(low), max(float(high), float(low) + 1e-12))


def dolp_colours(values: Float[Array, "y x"]) -> tuple[Float[Array, "y x 3"], ScalarMappable]:
    """Degree of linear polarization in a scale that the colour-blind and a grey printer keep in order. [1]"""
    return _mapped(values, DOLP, 0.0, HIGHEST_DOLP)


def aop_colours(
    aop_rad: Float[Array, "y x"], dolp: Float[Array, "y x"], light_at_rad: float
) -> tuple[Float[Array, "y x 3"], ScalarMappable]:
    """Angle of polarization on a cyclic scale, 0° and 180° alike; faded to grey where DoLP is small. [1]

    ``light_at_rad``, 0 or π/2, is the angle that is drawn palest: that of horizontal polarization.
    """
    colours, scale = _mapped(np.degrees(aop_rad), f"{AOP}_shifted" if light_at_rad else AOP, 0.0, 180.0)
    share = np.clip(np.nan_to_num(dolp) / FADE_DOLP, 0, 1)[..., None]
    return share * colours + (1 - share) * MASKED, scale


def frame_figure(
    colours: Float[Array, "y x 3"],
    scale: ScalarMappable | None,
    label: str,
    extent_m: tuple[float, float, float, float] | None = None,
    title: str = "",
    bearings: Bearings | None = None,
) -> Figure:
    """The picture with title and colour bar, north, sun and scale bar.

    Parameters
    ----------
    colours
        sRGB; NaN is drawn as no data. [1]
    scale, label
        Of the colour bar; none where there is no scale.
    extent_m
        West, south, east, north, if the picture is a map. [m]
    title
        Above the picture.
    bearings
        How it lies.
    """
    rows, columns = colours.shape[:2]
    figure = Figure(
        figsize=(_INCHES_WIDE, max(_INCHES_WIDE * 0.87 * rows / columns, 2.0)), layout="constrained"
    )
    axes = figure.add_subplot()
    axes.set_title(title)
    colours = np.where(np.isfinite(colours), np.clip(colours, 0, 1), MASKED)
    if extent_m is None:
        axes.imshow(colours, interpolation="nearest")
        axes.set_axis_off()
    else:
        west, south, east, north = extent_m
        axes.imshow(colours, interpolation="nearest", extent=(west, east, south, north))
        axes.set(xlabel="east [m]", ylabel="north [m]")
    if bearings is not None:
        draw_bearings(axes, bearings)
    if scale is not None:
        figure.colorbar(scale, ax=axes, shrink=0.8, label=label)
    return figure


def picture_figure(picture: Float[Array, "y x 3"], bearings: Bearings | None) -> Figure:
    """A picture without margins, its pixels those of the file, with how it lies drawn on it."""
    rows, columns = picture.shape[:2]
    figure = Figure(figsize=(columns / DOTS_PER_INCH, rows / DOTS_PER_INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.imshow(np.clip(picture, 0, 1), interpolation="nearest", aspect="auto")
    axes.set_axis_off()
    if bearings is not None:
        draw_bearings(axes, bearings)
    return figure


def _mapped(values: Array, name: str, low: float, high: float) -> tuple[Array, ScalarMappable]:
    scale = ScalarMappable(Normalize(low, high), matplotlib.colormaps[name])
    colours = np.asarray(scale.to_rgba(np.nan_to_num(values, nan=low)))[..., :3]
    return np.where(np.isfinite(values)[..., None], colours, MASKED), scale


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
    ends = [y + 0.012 * high, y, y, y + 0.012 * high]
    ax.plot([x, x, x + bar, x + bar], ends, **style, scalex=False, scaley=False)
    length = f"{length_m:g} m {bearings.where}".strip()
    _label(ax, length, (x + bar, y), (5, 0), xycoords="data", ha="left", va="bottom")
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
    style = {"arrowstyle": "->", "color": colour, "lw": 1.8, "path_effects": _OUTLINE}
    drawn = ax.annotate(
        "", (0.5, 0.5), (0.5, 0.5), xycoords=tip, textcoords=foot, annotation_clip=False,
        arrowprops={**style, "shrinkA": 0, "shrinkB": 0},
    )  # fmt: skip
    drawn.set_zorder(9)
    below = (0, -0.5 * _ARROW_PT - 3)
    _label(ax, name, (across, 0.93), below, xycoords="axes fraction", ha="center", va="top")


def _label(ax: Axes, text: str, place: tuple[float, float], offset: tuple[float, float], **style) -> None:
    """White outlined text, offset from a place. [pt]"""
    label = ax.annotate(
        text, place, offset, textcoords="offset points", color="white", fontsize=8, fontweight="bold",
        annotation_clip=False, **style,
    )  # fmt: skip
    label.set(path_effects=_OUTLINE, zorder=9)
