"""Draw north, the sun's direction and a scale bar onto a picture."""

import math

from matplotlib.axes import Axes
from matplotlib.patheffects import AbstractPathEffect, withStroke
from matplotlib.text import Annotation

from glintrack.core.bearings import Bearings

_STEPS = (1, 2, 5)
_BAR_SHARE = 0.2  # of the picture's width that the bar takes at most
_ARROW_PT = 22.0
_SUN_COLOUR = "#ffd94a"
_OUTLINE: list[AbstractPathEffect] = [withStroke(linewidth=3.0, foreground=(0, 0, 0, 0.75))]


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
    style = {"arrowstyle": "->", "color": colour, "lw": 1.8, "path_effects": _OUTLINE}
    drawn = ax.annotate(
        "", (0.5, 0.5), (0.5, 0.5), xycoords=tip, textcoords=foot, annotation_clip=False,
        arrowprops={**style, "shrinkA": 0, "shrinkB": 0},
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
