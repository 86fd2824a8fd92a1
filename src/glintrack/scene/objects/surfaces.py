"""Roads and ground of a city: the network's lanes, carriageways, kerbs, pavements, markings and patches.

Surfaces do not overlap; only road markings are 2 cm above the asphalt. A plane 10 cm below fills gaps of
rounding between surfaces, and extends 3 km beyond them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np
import shapely
import xarray as xr
from jaxtyping import Float
from shapely.geometry import LineString, MultiPolygon, Polygon, box
from shapely.geometry.base import BaseGeometry
from shapely.ops import substring, unary_union

from glintrack.core.arrays import Array
from glintrack.core.interpolation import height_at
from glintrack.scene.objects.geometry import MeshBuilder, clip, cut_into_tiles, flat, polygons, walls
from glintrack.scene.objects.terrain import STEP_M, ground_surface

LaneKind = Literal["car", "parking", "walk", "rail", "crossing", "walking_area", "internal"]
LANE_KINDS: tuple[LaneKind, ...] = get_args(LaneKind)


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
        Use of the lane; a ``walking_area`` is a polygon, all others are centre lines.
    points
        Centre line in driving direction, or the polygon's corners. [m]
    width_m
        [m]
    signalled
        True if a traffic light stands at its end.
    street_type
        The network's own name of the street's class, e.g. ``highway.residential``.
    is_motorway
        True for motorways and their ramps, along which nothing is built.
    """

    edge_id: str
    index: int
    kind: LaneKind
    points: Float[Array, "point 2"]
    width_m: float
    signalled: bool = False
    street_type: str = ""
    is_motorway: bool = False

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
    left_hand
        True if traffic keeps left: the kerb is left of the lanes, and oncoming traffic right.
    """

    lanes: tuple[Lane, ...]
    junctions: tuple[Float[Array, "corner 2"], ...]
    left_hand: bool = False

    @property
    def kerb_side(self) -> float:
        """Sign of offsets towards the kerb: 1 is left of the driving direction, −1 right."""
        return 1.0 if self.left_hand else -1.0

    def of_kind(self, *kinds: LaneKind) -> list[Lane]:
        """Select the lanes of some kinds."""
        return [lane for lane in self.lanes if lane.kind in kinds]

    def shift(self, east_m: float, north_m: float) -> "RoadNetwork":
        """Move the origin by adding a vector to all coordinates. [m]"""
        move = np.array([east_m, north_m])
        return RoadNetwork(
            tuple(replace(lane, points=lane.points + move) for lane in self.lanes),
            tuple(corners + move for corners in self.junctions),
            self.left_hand,
        )

    def within(self, area: Polygon) -> "RoadNetwork":
        """Select the lanes and junctions that touch an area, without cutting them."""
        shapes = [Polygon(one.points) if one.kind == "walking_area" else one.line for one in self.lanes]
        lanes = (lane for lane, shape in zip(self.lanes, shapes, strict=True) if shape.intersects(area))
        junctions = tuple(c for c in self.junctions if Polygon(c).intersects(area))
        return RoadNetwork(tuple(lanes), junctions, self.left_hand)


ROAD_M, PAVEMENT_M, GROUND_M, MARKING_M, BASE_M = 0.0, 0.12, 0.05, 0.02, -0.10
KERB_WIDTH_M = 0.15
_OUTLINE_TOLERANCE_M = 0.04  # of outlines simplified to fewer corners
_LINE_HALF_WIDTH_M = 0.075
_BASE_REACH_M = 3000.0


@dataclass(frozen=True)
class GroundPatch:
    """A piece of ground of one material: a lawn, a car park, a pond."""

    material: str
    shape: BaseGeometry
    height_m: float = GROUND_M


@dataclass(frozen=True)
class RoadAreas:
    """Plan areas of the streets, which do not overlap; the markings are on the carriageway."""

    carriageway: BaseGeometry
    kerb: BaseGeometry
    pavement: BaseGeometry
    rail: BaseGeometry
    markings: BaseGeometry

    @cached_property
    def all(self) -> BaseGeometry:
        """Union of carriageway, kerb, pavement and rail."""
        return unary_union([self.carriageway, self.kerb, self.pavement, self.rail])


def road_areas(network: RoadNetwork, area: BaseGeometry) -> RoadAreas:
    """Plan areas of a network's streets within an area. [m]"""
    driven = [_strip(lane) for lane in network.of_kind("car", "parking", "internal")]
    driven += [Polygon(corners).buffer(0) for corners in network.junctions]
    # closing by 0.6 m fills the wedges between lanes that meet at an angle
    road = unary_union(driven).buffer(0.6, quad_segs=3).buffer(-0.6, quad_segs=3)
    road = road.simplify(_OUTLINE_TOLERANCE_M).intersection(area)
    kerb = road.buffer(KERB_WIDTH_M, join_style="mitre").difference(road).intersection(area)
    walked = [_strip(lane) for lane in network.of_kind("walk")]
    walked += [Polygon(lane.points).buffer(0) for lane in network.of_kind("walking_area")]
    pavement = unary_union(walked).buffer(0.2, quad_segs=3).buffer(-0.2, quad_segs=3)
    pavement = pavement.simplify(_OUTLINE_TOLERANCE_M).difference(road.union(kerb)).intersection(area)
    rail = unary_union([_strip(lane) for lane in network.of_kind("rail")])
    rail = rail.difference(unary_union([road, kerb, pavement])).intersection(area)
    markings = _markings(network).intersection(road.buffer(-0.05))
    return RoadAreas(road, kerb, pavement, rail, markings)


def add_ground(
    builder: MeshBuilder,
    streets: RoadAreas,
    patches: Sequence[GroundPatch],
    area: BaseGeometry,
    rest: str,
    terrain: xr.Dataset | None = None,
) -> None:
    """Build streets, patches and the rest of the area as surfaces.

    Parameters
    ----------
    builder
        Receives the surfaces.
    streets
        Areas of the streets, which cover everything else.
    patches
        Patches of ground; earlier ones cover later ones.
    area
        Area to cover. [m]
    rest
        Material of the ground without a patch, and of the plane below and beyond.
    terrain
        Schema ``terrain``: the surfaces are cut finer and draped over it; without it the ground is level.
    """
    mark = builder.mark()

    def lay(material: str, shape: BaseGeometry, height_m: float) -> None:
        pieces = cut_into_tiles(shape) if terrain is None else cut_into_tiles(shape, STEP_M)
        builder.add(material, flat(MultiPolygon(pieces), height_m))

    lay("asphalt", streets.carriageway, ROAD_M)
    lay("kerb", streets.kerb, PAVEMENT_M)
    lay("pavement", streets.pavement, PAVEMENT_M)
    raised = streets.kerb.union(streets.pavement)
    ring = raised if terrain is None else raised.segmentize(STEP_M)
    builder.add("kerb", walls(ring, BASE_M, PAVEMENT_M))
    lay("soil", streets.rail, GROUND_M)
    lay("road_paint", streets.markings, MARKING_M)
    laid = [patch.shape for patch in patches]
    bounds = np.array([s.bounds if not s.is_empty else (0, 0, 0, 0) for s in laid]).reshape(-1, 4)
    for k, patch in enumerate(patches):
        shape = patch.shape.intersection(area)
        # only shapes near by are subtracted, because the whole street network is slow to subtract
        west, south, east, north = bounds[k]
        close = (bounds[:k, 0] <= east) & (bounds[:k, 2] >= west)
        close &= (bounds[:k, 1] <= north) & (bounds[:k, 3] >= south)
        near = [laid[i] for i in np.flatnonzero(close) if laid[i].intersects(shape)]
        if not shape.is_empty:
            try:
                shape = shape.difference(unary_union([*near, clip(streets.all, shape.bounds)]))
            except shapely.GEOSException:  # quick clipping may leave rings that cross themselves
                shape = shape.difference(unary_union([*near, streets.all.intersection(shape)]))
        lay(patch.material, shape, patch.height_m)
    lay(rest, area.difference(unary_union([streets.all, *laid])), GROUND_M)
    if terrain is None:
        reach = max(_BASE_REACH_M, *(abs(b) + _BASE_REACH_M / 2 for b in area.bounds))
        builder.add(rest, flat(box(-reach, -reach, reach, reach), BASE_M))
        return
    builder.raise_since(mark, lambda v: height_at(terrain, v[:, 0], v[:, 1]))
    builder.add(rest, ground_surface(terrain, -BASE_M))


def blocks(streets: RoadAreas, area: BaseGeometry) -> list[Polygon]:
    """Pieces of the area enclosed by streets, from 400 m², ordered by position. [m]"""
    pieces = polygons(area.difference(streets.all).buffer(-0.5).buffer(0.5))
    large = [p for p in pieces if p.area >= 400.0]
    return sorted(large, key=lambda p: (round(p.centroid.x, 3), round(p.centroid.y, 3)))


def _strip(lane: Lane) -> BaseGeometry:
    return lane.line.buffer(lane.width_m / 2, cap_style="flat", join_style="mitre", mitre_limit=2)


def _markings(network: RoadNetwork) -> BaseGeometry:
    shapes: list[BaseGeometry] = []
    cars = network.of_kind("car")
    top = {}
    for lane in cars:
        top[lane.edge_id] = max(top.get(lane.edge_id, -1), lane.index)
    inner = {(lane.edge_id, lane.index) for lane in cars}
    for lane in cars:
        line = lane.line
        if line.length < 6 or lane.width_m < 2.8 or "service" in lane.street_type:
            continue
        if (lane.edge_id, lane.index - 1) in inner:
            shapes += _dashes(line.offset_curve(network.kerb_side * lane.width_m / 2), 3.0, 6.0)
        if lane.index == top[lane.edge_id]:
            centre = line.offset_curve(network.kerb_side * (0.12 - lane.width_m / 2))
            shapes += _dashes(centre, 3.0, 4.5) if "residential" in lane.street_type else [centre]
        if lane.signalled:  # a stop line
            end = np.array(line.interpolate(max(line.length - 0.8, 0.0)).coords[0])
            forward = lane.points[-1] - lane.points[-2]
            across = np.array([-forward[1], forward[0]]) / max(np.hypot(*forward), 1e-9)
            across = across * (lane.width_m / 2 - 0.15)
            shapes.append(LineString([end - across, end + across]).buffer(0.25, cap_style="flat"))
    solid = [
        s.buffer(_LINE_HALF_WIDTH_M, cap_style="flat") if isinstance(s, LineString) else s for s in shapes
    ]
    for lane in network.of_kind("crossing"):
        starts = np.arange(0.4, lane.line.length - 0.5, 1.0)
        bars = [substring(lane.line, start, start + 0.5) for start in starts]
        solid += [
            b.buffer(lane.width_m / 2 - 0.3, cap_style="flat") for b in bars if isinstance(b, LineString)
        ]
    return unary_union(solid)


def _dashes(line: BaseGeometry, on_m: float, off_m: float) -> list[BaseGeometry]:
    starts = np.arange(1.0, line.length - on_m, on_m + off_m)
    return [substring(line, s, s + on_m) for s in starts] if isinstance(line, LineString) else []
