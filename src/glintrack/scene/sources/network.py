"""A road network as the scene needs it: lanes, junctions and crossings as plan geometry, in ENU."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from shapely.geometry import LineString, Polygon

from glintrack.core.arrays import Array

LaneKind = Literal["car", "parking", "walk", "rail", "crossing", "walking_area", "internal"]
LANE_KINDS: tuple[LaneKind, ...] = (
    "car",
    "parking",
    "walk",
    "rail",
    "crossing",
    "walking_area",
    "internal",
)


@dataclass(frozen=True)
class Lane:
    """One lane of a street, or a strip across or within a junction.

    Parameters
    ----------
    edge_id
        Street the lane belongs to.
    index
        Position among the lanes of its street, 0 at the kerb.
    kind
        What moves on it; a ``walking_area`` is a polygon, all others are centre lines.
    points
        Centre line in driving direction, or the polygon's corners. [m]
    width_m
        [m]
    signalled
        True if a traffic light stands at its end.
    street_type
        The network's own name of the street's class, e.g. ``highway.residential``.
    """

    edge_id: str
    index: int
    kind: LaneKind
    points: Float[Array, "point 2"]
    width_m: float
    signalled: bool = False
    street_type: str = ""

    @property
    def line(self) -> LineString:
        """Centre line."""
        return LineString(self.points)


@dataclass(frozen=True)
class RoadNetwork:
    """Lanes and junction areas.

    Parameters
    ----------
    lanes
        Every lane, crossing and walking area.
    junctions
        Areas of the junctions where motor vehicles pass.
    """

    lanes: tuple[Lane, ...]
    junctions: tuple[Float[Array, "corner 2"], ...]

    def of_kind(self, *kinds: LaneKind) -> list[Lane]:
        """Lanes of the given kinds."""
        return [lane for lane in self.lanes if lane.kind in kinds]

    def shifted(self, east_m: float, north_m: float) -> "RoadNetwork":
        """The same network with its origin moved by the given vector (coordinates are added). [m]"""
        move = np.array([east_m, north_m])
        return RoadNetwork(
            tuple(replace(lane, points=lane.points + move) for lane in self.lanes),
            tuple(corners + move for corners in self.junctions),
        )

    def within(self, area: Polygon) -> "RoadNetwork":
        """Only what touches the area; nothing is cut."""
        return RoadNetwork(
            tuple(
                lane
                for lane in self.lanes
                if (Polygon(lane.points) if lane.kind == "walking_area" else lane.line).intersects(area)
            ),
            tuple(c for c in self.junctions if Polygon(c).intersects(area)),
        )
