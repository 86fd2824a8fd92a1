"""Figure of a rendered frame with colour scale, north, direction of the sun and scale bar."""

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
from glintrack.results.figures import AOP, DOLP, MAX_DOLP, NO_DATA, RADIANCE

_STEP_M = 20.0  # over which a direction is measured in the picture


@dataclass(frozen=True)
class Bearings:
    """Directions of a picture as (right, up), of any length, and its scale.

    Parameters
    ----------
    north, sun
        Toward north and toward the sun; None for a sun that is not known.
    units_per_m
        Units of the axes per metre, for a length across the picture. [1/m]
    where
        Place of the scale, where it is not the same everywhere.
    """

    north: tuple[float, float]
    sun: tuple[float, float] | None
    units_per_m: float = 1.0
    where: str = ""


def azimuth_of(direction: Array) -> float:
    """Azimuth of a direction in ENU, clockwise from north. [rad]"""
    return math.atan2(float(direction[0]), float(direction[1]))


def on_map(sun_azimuth_rad: float | None) -> Bearings:
    """Bearings of a map in ENU metres, north up."""
    sun = None if sun_azimuth_rad is None else (math.sin(sun_azimuth_rad), math.cos(sun_azimuth_rad))
    return Bearings((0.0, 1.0), sun)


def in_view(camera: Camera, pose: Pose, sun_azimuth_rad: float) -> Bearings | None:
    """Bearings of the aircraft's view at the middle of the frame on level ground; None for the sky."""
    middle = ground_points(camera, pose, np.array([camera.rows - 1, camera.columns - 1]) / 2)
    if not np.isfinite(middle).all():
        return None
    north = np.array([0.0, 1.0, 0.0])
    sun = np.array([math.sin(sun_azimuth_rad), math.cos(sun_azimuth_rad), 0.0])
    line = middle - pose.position
    across = np.cross(line, [0.0, 0.0, 1.0])
    length = float(np.linalg.norm(across))
    across = across / length if length > 1e-9 * float(np.linalg.norm(line)) else np.array([1.0, 0.0, 0.0])
    steps = _STEP_M * np.stack([north, sun, across])
    moved = project(camera, pose, middle + steps) - project(camera, pose, middle - steps)
    right_up = np.stack([moved[:, 1], -moved[:, 0]], axis=1)
    scale = float(np.linalg.norm(right_up[2])) / (2 * _STEP_M)
    (north_right, north_up), (sun_right, sun_up) = right_up[:2].tolist()
    return Bearings((north_right, north_up), (sun_right, sun_up), scale, "across the middle")


MASKED = np.array(to_rgb(NO_DATA))  # no data, or hardly any polarization
FADE_DOLP = 0.05  # angles of light less polarized than this fade to grey
_INCHES_WIDE = 10.0
_BAR_SHARE = 0.2  # of the picture's width that the bar takes at most
_ARROW_PT = 22.0
_SUN_COLOUR = "#ffd94a"
_OUTLINE: list[AbstractPathEffect] = [withStroke(linewidth=3.0, foreground=(0, 0, 0, 0.75))]


def radiance_colours(values: Float[Array, "y x"]) -> tuple[Float[Array, "y x 3"], ScalarMappable]:
    """Colours and scale of a radiance, black to white over its middle 98 %. [1]"""
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, [1, 99]) if known.size else (0.0, 1.0)
    return _apply_colours(values, RADIANCE, float(low), max(float(high), float(low) + 1e-12))


def dolp_colours(values: Float[Array, "y x"]) -> tuple[Float[Array, "y x 3"], ScalarMappable]:
    """Colours and scale of a degree of linear polarization, safe for colour-blind eyes. [1]"""
    return _apply_colours(values, DOLP, 0.0, MAX_DOLP)


def aop_colours(
    aop_rad: Float[Array, "y x"], dolp: Float[Array, "y x"], light_at_rad: float
) -> tuple[Float[Array, "y x 3"], ScalarMappable]:
    """Colours and cyclic scale of an angle of polarization, faded to grey where DoLP is small. [1]

    ``light_at_rad``, 0 or π/2, is the angle that is drawn palest: that of horizontal polarization.
    """
    colours, scale = _apply_colours(
        np.degrees(aop_rad), f"{AOP}_shifted" if light_at_rad else AOP, 0.0, 180.0
    )
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
    """Figure of a picture with title and colour bar, north, sun and scale bar.

    Parameters
    ----------
    colours
        sRGB; NaN is drawn as no data. [1]
    scale, label
        Scale and label of the colour bar; none without a scale.
    extent_m
        West, south, east, north, if the picture is a map. [m]
    title
        Title above the picture.
    bearings
        Directions of north and sun, and scale.
    """
    rows, columns = colours.shape[:2]
    size = _INCHES_WIDE, max(_INCHES_WIDE * 0.87 * rows / columns, 2.0)
    figure = Figure(figsize=size, layout="constrained")
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
    """Figure of a picture without margins, pixel for pixel, with its bearings."""
    rows, columns = picture.shape[:2]
    figure = Figure(figsize=(columns / DOTS_PER_INCH, rows / DOTS_PER_INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.imshow(np.clip(picture, 0, 1), interpolation="nearest", aspect="auto")
    axes.set_axis_off()
    if bearings is not None:
        draw_bearings(axes, bearings)
    return figure


def _apply_colours(values: Array, name: str, low: float, high: float) -> tuple[Array, ScalarMappable]:
    scale = ScalarMappable(Normalize(low, high), matplotlib.colormaps[name])
    colours = np.asarray(scale.to_rgba(np.nan_to_num(values, nan=low)))[..., :3]
    return np.where(np.isfinite(values)[..., None], colours, MASKED), scale


def round_length(limit: float) -> float:
    """Largest of 1, 2, 5, 10, 20 … up to a limit."""
    power = 10.0 ** math.floor(math.log10(limit))
    return max(step * power for step in (1, 2, 5) if step * power <= limit * (1 + 1e-9))


def draw_bearings(ax: Axes, bearings: Bearings) -> None:
    """Draw north and sun at the upper left, and the scale bar at the lower left."""
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
    """Draw an arrow about a point of the axes, with its name below."""
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
    """Draw white outlined text, offset from a place. [pt]"""
    label = ax.annotate(
        text, place, offset, textcoords="offset points", color="white", fontsize=8, fontweight="bold",
        annotation_clip=False, **style,
    )  # fmt: skip
    label.set(path_effects=_OUTLINE, zorder=9)
