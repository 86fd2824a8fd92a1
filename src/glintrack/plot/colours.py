"""One colour map per quantity, in every picture, film and report page."""

from collections.abc import Mapping
from types import MappingProxyType

RADIANCE, DOLP, AOP = (
    "gray",
    "viridis",
    "twilight",
)  # kept apart by any eye; AoP is cyclic
OF_CHANNEL: Mapping[str, str] = MappingProxyType({"pan": RADIANCE, "dolp": DOLP, "aop": AOP})
HIGHEST_DOLP = 0.5  # drawn brightest
