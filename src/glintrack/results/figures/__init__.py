"""Figures of frames, tracks, sky, sensors and devices, with their common colour maps, marks and style.

There is one colour map per quantity and one mark per kind of track, in every picture, film and report page.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from matplotlib.axes import Axes

from glintrack.core.installation import read_data

RADIANCE, DOLP, AOP = "gray", "viridis", "twilight"  # safe for colour-blind eyes; AoP is cyclic
# on the ground AoP is from the meridian, and 90°, level, the palest, as in every picture
OF_CHANNEL: Mapping[str, str] = MappingProxyType({"pan": RADIANCE, "dolp": DOLP, "aop": f"{AOP}_shifted"})
MAX_DOLP = 0.5  # drawn brightest
MARKS: Mapping[str, str] = read_data("page", "scores.toml")["marks"]
NO_DATA = "#606874"  # of a picture of the ground
# lines by channel, as on the page; colour-blind eyes can tell them apart
_STYLES = {"pan": ("#2f5fd0", "-"), "dolp": ("#b81a63", "--"), "all": ("#8a5a00", ":")}
LOOP_STYLES: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {name: {"color": c, "linestyle": line} for name, (c, line) in _STYLES.items()}
)


def label_axes(axes: Axes, xlabel: str, ylabel: str, title: str = "", **settings: Any) -> None:
    """Set labels and title of a diagram, and its grid."""
    axes.set(xlabel=xlabel, ylabel=ylabel, title=title, **settings)
    axes.grid(alpha=0.3, which="both")
