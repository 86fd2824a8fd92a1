"""Figures of frames, tracks, sky, sensors and devices: colour maps and marks that all of them share.

There is one colour map per quantity and one mark per kind of track, in every picture, film and report page.
"""

from collections.abc import Mapping
from types import MappingProxyType

RADIANCE, DOLP, AOP = (
    "gray",
    "viridis",
    "twilight",
)  # kept apart by any eye; AoP is cyclic
# on the ground AoP is from the meridian, and 90°, level, the palest, as in every picture
OF_CHANNEL: Mapping[str, str] = MappingProxyType({"pan": RADIANCE, "dolp": DOLP, "aop": f"{AOP}_shifted"})
HIGHEST_DOLP = 0.5  # drawn brightest
# Of Okabe and Ito, safe for colour-blind eyes; the shape says the same. As on the page: film.js and page.css.
MARKS: Mapping[str, str] = MappingProxyType(
    {
        "true": "#56b4e9",
        "coast": "#f0e442",
        "false": "#ff8a3d",
        "other": "#d9dde2",
        "missed": "#ff9fd2",
        "hidden": "#e3e6ea",
    }
)
NO_DATA = "#606874"  # of a picture of the ground
LOOP_COLOURS: Mapping[str, str] = MappingProxyType(
    {"pan": "#648fff", "dolp": "#dc267f", "all": "#785ef0"}
)  # by channel
