"""Rules for lots, parking, trees, yards and buildings where the data do not define them.

Unknown heights are drawn by footprint area: sheds under 45 m² are 2.8 m high, halls over 1500 m² 7 to 12 m,
the rest two to four storeys of 2.9 m.
"""

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from glintrack.core.arrays import Array
from glintrack.scene.objects.buildings import Building, rise_m
from glintrack.scene.objects.geometry import bounding_rectangle, outline, polygons
from glintrack.scene.objects.layout import ParkedVehicle, heading_of
from glintrack.scene.objects.plants import Tree, draw_tree
from glintrack.scene.objects.surfaces import PAVEMENT_M, GroundPatch, RoadNetwork
from glintrack.scene.read.polygons import Footprint

_STALL_M = (2.5, 5.0)
_AISLE_M = 6.2
_TREES_APART_M = 6.0
_LOWEST_EAVES_M = 2.2


@dataclass(frozen=True)
class Frontage:
    """A stretch of a block's edge: its middle, unit vectors along it and into the block, its width. [m]"""

    middle: Float[Array, "2"]
    along: Float[Array, "2"]
    inward: Float[Array, "2"]
    width_m: float

    def point(self, along_m: float, inward_m: float) -> tuple[float, float]:
        """Plan point by its distance along the edge from the middle, and into the block. [m]"""
        x, y = self.middle + along_m * self.along + inward_m * self.inward
        return float(x), float(y)

    def rectangle(self, start_m: float, stop_m: float, near_m: float, far_m: float) -> Polygon:
        """Rectangle between two distances along and two into the block. [m]"""
        corners = ((start_m, near_m), (stop_m, near_m), (stop_m, far_m), (start_m, far_m))
        return Polygon([self.point(*c) for c in corners])


def frontages(
    block: Polygon, lot_m: tuple[float, float], corner_m: float, rng: np.random.Generator
) -> list[Frontage]:
    """Lots along the sides of a block, with a range of widths, and free corners. [m]"""
    ring = outline(Polygon(block.exterior), tolerance_m=3.0).exterior
    corners = np.asarray(ring.coords)[:, :2]
    lots = []
    for a, b in itertools.pairwise(corners):
        length = float(np.hypot(*(b - a)))
        along = (b - a) / max(length, 1e-9)
        inward = np.array([-along[1], along[0]])
        count = int((length - 2 * corner_m) / rng.uniform(*lot_m))
        if count < 1:
            continue
        width = (length - 2 * corner_m) / count
        for k in range(count):
            lots.append(Frontage(a + (corner_m + (k + 0.5) * width) * along, along, inward, width))
    return lots


def scatter(
    free: BaseGeometry, spacing_m: float, count: int, rng: np.random.Generator
) -> list[tuple[float, float]]:
    """Draw up to ``count`` points in a shape, no two closer than ``spacing_m``. [m]"""
    if free.is_empty:
        return []
    west, south, east, north = free.bounds
    tries = rng.uniform((west, south), (east, north), (6 * count, 2))
    tries = tries[shapely.contains_xy(free, tries[:, 0], tries[:, 1])]
    chosen: list[Array] = []
    for point in tries:
        if len(chosen) == count:
            break
        if not chosen or np.min(np.hypot(*(np.array(chosen) - point).T)) >= spacing_m:
            chosen.append(point)
    return [(float(x), float(y)) for x, y in chosen]


def parking_rows(
    shape: Polygon, rng: np.random.Generator, occupancy: float, aisles_outside: bool = False
) -> tuple[BaseGeometry, list[ParkedVehicle]]:
    """Rows of stalls with aisles between, along a car park's long side; cars and hatchbacks only.

    Parameters
    ----------
    shape
        The car park. [m]
    rng
        Source of random choices.
    occupancy
        Share of the occupied stalls, 0 to 1. [1]
    aisles_outside
        Put two rows back to back on a piece too narrow for an aisle.

    Returns
    -------
    The painted lines, and the parked vehicles.
    """
    centre, axis, length, width = bounding_rectangle(shape)
    across = np.array([-axis[1], axis[0]])
    inside = shape.buffer(-0.3)
    lines, parked = [], []
    module = 2 * _STALL_M[1] + _AISLE_M
    for band in range(max(int(width / module), 1)):
        near = -width / 2 + band * module
        rows = ((near, -1.0), (near + _STALL_M[1] + _AISLE_M, 1.0))
        if aisles_outside and width < module:
            is_wide = width > 2 * _STALL_M[1]
            rows = ((-_STALL_M[1], 1.0), (0.0, -1.0)) if is_wide else ((-_STALL_M[1] / 2, 1.0),)
        for row, facing in rows:
            for k in range(int(length / _STALL_M[0])):
                start = -length / 2 + k * _STALL_M[0]
                stop, back = start + _STALL_M[0], row + _STALL_M[1]
                plan = ((start, row), (stop, row), (stop, back), (start, back))
                corners = [centre + u * axis + v * across for u, v in plan]
                taken = rng.random() < occupancy
                nose_in, nudge, model = rng.random() < 0.75, rng.uniform(-0.2, 0.2), int(rng.random() < 0.35)
                if not inside.contains(Polygon(corners)):
                    continue
                lines += [LineString([corners[0], corners[3]]), LineString([corners[1], corners[2]])]
                if taken:
                    x, y = np.mean(corners, axis=0) + nudge * across
                    heading = heading_of(across * facing * (1 if nose_in else -1))
                    parked.append(ParkedVehicle(float(x), float(y), heading, model, 0.03))
    painted = unary_union([line.buffer(0.05, cap_style="flat") for line in lines])
    return painted, parked


def kerbside_parking(
    network: RoadNetwork, area: BaseGeometry, rng: np.random.Generator, occupancy: float
) -> list[ParkedVehicle]:
    """Vehicles in the parking lanes of a network."""
    parked = []
    for lane in network.of_kind("parking"):
        line = lane.line
        for d in np.arange(8.0, line.length - 8.0, 6.6):
            taken, place = rng.random() < occupancy, d + rng.uniform(-0.25, 0.25)
            model = int(rng.choice([0, 1, 2], p=[0.62, 0.3, 0.08]))  # cars, hatchbacks, some vans
            here, ahead = (np.array(line.interpolate(place + e).coords[0]) for e in (-0.5, 0.5))
            x, y = (here + ahead) / 2
            if taken and area.contains(Point(x, y)):
                parked.append(ParkedVehicle(float(x), float(y), heading_of(ahead - here), model))
    return parked


def street_trees(
    network: RoadNetwork, taken: BaseGeometry, area: BaseGeometry, rng: np.random.Generator
) -> list[Tree]:
    """Trees behind the pavements, where nothing is built."""
    shapely.prepare(taken)
    trees: list[Tree] = []
    cells: dict[tuple[int, int], list[Tree]] = {}  # trees by squares of the least distance
    for lane in network.of_kind("walk"):
        if lane.line.length < 20:
            continue
        row = lane.line.offset_curve(network.kerb_side * (lane.width_m / 2 + 1.3))
        for d in np.arange(7.0, row.length - 7.0, 13.0):
            point = row.interpolate(d + rng.uniform(-2.5, 2.5))
            tree = draw_tree(point.x, point.y, rng, (6.0, 11.0))
            i, j = int(point.x // _TREES_APART_M), int(point.y // _TREES_APART_M)
            near = [t for di in (-1, 0, 1) for dj in (-1, 0, 1) for t in cells.get((i + di, j + dj), ())]
            apart = all(math.hypot(t.east_m - point.x, t.north_m - point.y) > _TREES_APART_M for t in near)
            if rng.random() < 0.8 and apart and area.contains(point) and not taken.intersects(point):
                trees.append(tree)
                cells.setdefault((i, j), []).append(tree)
    return trees


def _building_by_rule(footprint: Polygon, height_m: float | None, rng: np.random.Generator) -> Building:
    """Choose a roof, walls and windows for a footprint, and walls' height by its area if it is None. [m]"""
    size = footprint.area
    fill = size / shapely.minimum_rotated_rectangle(footprint).area
    draw, slope = rng.random(5), math.radians(rng.uniform(32, 46))
    if height_m is not None:
        height = height_m
    elif size < 45:
        height = 2.8
    elif size > 1500:
        height = 7.0 + 5.0 * draw[0]
    else:
        height = 2.9 * (2 + int(draw[0] * 3)) + 0.4
    wall = ("plaster", "plaster", "brick", "concrete")[int(draw[1] * 4)]
    if size < 45:
        return Building(footprint, height, "flat", wall, "roof_bitumen", glazing="none")
    if size < 650 and fill > 0.88 and height < 20:
        tiles = ("roof_tile", "roof_tile_new", "roof_tile", "roof_tile_grey", "roof_slate")[int(draw[2] * 5)]
        return Building(footprint, height, "hip" if draw[3] < 0.35 else "gable", wall, tiles, slope_rad=slope)
    if size < 900 and draw[3] < 0.7:
        tiles = ("roof_tile", "roof_tile_new", "roof_tile_grey")[int(draw[2] * 3)]
        return Building(footprint, height, "mansard", wall, tiles, slope_rad=slope)
    deck = "roof_bitumen" if draw[2] < 0.6 else "roof_membrane"
    glass = "curtain" if size > 900 and draw[4] < 0.3 else "rows"
    storey = 3.5 if glass == "curtain" else 2.9
    return Building(footprint, height, "flat", wall, deck, glazing=glass, storey_m=storey)


def buildings_by_rule(
    outlines: Iterable[Footprint],
    area: BaseGeometry,
    carriageway: BaseGeometry,
    rng: np.random.Generator,
) -> tuple[Building, ...]:
    """Draw buildings on outlines, in an area and clear of streets."""
    clear, found = carriageway.buffer(0.3), []
    for given in outlines:
        for part in polygons(given.shape.intersection(area).difference(clear)):
            if part.area > 12:
                building = _building_by_rule(part, given.height_m, rng)
                to_top = given.height_m is not None and not given.of_walls
                found.append(_lower_walls(building) if to_top else building)
    return tuple(found)


def _lower_walls(building: Building) -> Building:
    """Lower walls by the rise of the roof, which is flat if they would be lower than a storey."""
    eaves_m = building.eaves_m - rise_m(building)
    if eaves_m < _LOWEST_EAVES_M and building.roof != "flat":
        building = replace(building, roof="flat", roof_material="roof_bitumen")
        eaves_m = building.eaves_m - rise_m(building)
    return replace(building, eaves_m=max(eaves_m, 0.1))


def yards(pieces: Sequence[Polygon], built: BaseGeometry, rng: np.random.Generator) -> list[GroundPatch]:
    """Paved yards about buildings, and some dry lawns and bare soil."""
    patches = []
    for piece in pieces:
        yard = built.intersection(piece).buffer(4.5).intersection(piece).buffer(-0.5).buffer(0.5)
        if rng.random() < 0.65:
            material = "concrete" if rng.random() < 0.4 else "asphalt_worn"
            patches.append(GroundPatch(material, yard, 0.06))
        west, south, east, north = piece.bounds
        for _ in range(int(piece.area / 2500)):
            x, y, radius = rng.uniform(west, east), rng.uniform(south, north), rng.uniform(4, 11)
            material = "grass_dry" if rng.random() < 0.7 else "soil"
            patches.append(GroundPatch(material, Point(x, y).buffer(radius, 3).intersection(piece)))
    return patches


def garden_trees(
    network: RoadNetwork,
    streets: BaseGeometry,
    built: BaseGeometry,
    area: BaseGeometry,
    rng: np.random.Generator,
) -> list[Tree]:
    """Trees along the streets and in gardens, clear of walls."""
    near_walls = built.buffer(3.0)
    found = street_trees(network, unary_union([streets.buffer(0.4), near_walls]), area, rng)
    gardens = area.difference(unary_union([streets.buffer(2.0), built.buffer(4.5)])).buffer(-1.5)
    for garden in polygons(gardens):
        for x, y in scatter(garden, spacing_m=7.0, count=int(garden.area / 150), rng=rng):
            found.append(draw_tree(x, y, rng, (6.0, 15.0)))
    return found


def pavement_parking(
    network: RoadNetwork,
    carriageway: BaseGeometry,
    built: BaseGeometry,
    area: BaseGeometry,
    rng: np.random.Generator,
) -> list[ParkedVehicle]:
    """Cars half on the pavement along quiet streets, clear of junctions and lanes."""
    lanes = unary_union(
        [lane.line.buffer(lane.width_m / 2 - 0.3) for lane in network.of_kind("car", "internal")]
    )
    junctions = unary_union([Polygon(c).buffer(4.0) for c in network.junctions])
    blocked = unary_union([built.buffer(0.5), junctions, lanes])
    shapely.prepare(blocked)
    parked, taken = [], []
    for lane in network.of_kind("car"):
        quiet = any(word in lane.street_type for word in ("residential", "unclassified", "living_street"))
        if not quiet or lane.index > 1 or lane.line.length < 25:
            continue
        row = lane.line.offset_curve(network.kerb_side * (lane.width_m / 2 + 0.95))
        if not isinstance(row, LineString):
            continue
        for d in np.arange(8.0, row.length - 8.0, 5.9):
            is_parked, model = rng.random() < 0.6, int(rng.choice([0, 1, 2], p=[0.6, 0.33, 0.07]))
            here, ahead = (np.array(row.interpolate(d + e).coords[0]) for e in (-2.2, 2.2))
            body = LineString([here, ahead]).buffer(0.85, cap_style="flat")
            if not is_parked or not area.contains(body) or blocked.intersects(body):
                continue
            if any(body.intersects(other) for other in taken[-200:]):
                continue
            taken.append(body)
            x, y = (here + ahead) / 2
            up = PAVEMENT_M if not carriageway.contains(Point(x, y)) else 0.0
            parked.append(ParkedVehicle(float(x), float(y), heading_of(ahead - here), model, up))
    return parked
