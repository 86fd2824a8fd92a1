"""Rules for what real data do not have: heights, roofs and walls of buildings, yards, gardens, parked cars.

Heights that are not known come from the footprint's area: sheds under 45 m² stand 2.8 m high, halls over
1500 m² 7 to 12 m, all else two to four storeys of 2.9 m.
"""

import math
from collections.abc import Sequence

import numpy as np
import shapely
from shapely.geometry import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from glintrack.scene.objects.buildings import Building
from glintrack.scene.objects.geometry import polygons
from glintrack.scene.objects.layout import ParkedVehicle, heading_of
from glintrack.scene.objects.surfaces import PAVEMENT_M, GroundPatch
from glintrack.scene.objects.plants import Tree, draw_tree
from glintrack.scene.sources.lots import scatter, street_trees
from glintrack.scene.objects.surfaces import RoadNetwork


def building_by_rule(footprint: Polygon, height_m: float | None, rng: np.random.Generator) -> Building:
    """Give a footprint a roof and a face, and a height by its area where none is known. [m]."""
    rectangle = shapely.minimum_rotated_rectangle(footprint)
    fill, size = footprint.area / rectangle.area, footprint.area
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


def yards(pieces: Sequence[Polygon], built: BaseGeometry, rng: np.random.Generator) -> list[GroundPatch]:
    """Paved yards about buildings, dry lawns and bare soil here and there; lawn is the rest."""
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


def parked_on_pavements(
    network: RoadNetwork,
    carriageway: BaseGeometry,
    built: BaseGeometry,
    area: BaseGeometry,
    rng: np.random.Generator,
) -> list[ParkedVehicle]:
    """Cars half on the pavement along quiet streets, as is usual there, clear of junctions and lanes."""
    quiet = [lane for lane in network.of_kind("car") if _is_quiet(lane.street_type) and lane.index <= 1]
    lanes = unary_union(
        [lane.line.buffer(lane.width_m / 2 - 0.3) for lane in network.of_kind("car", "internal")]
    )
    junctions = unary_union([Polygon(c).buffer(4.0) for c in network.junctions])
    blocked = unary_union([built.buffer(0.5), junctions, lanes])
    shapely.prepare(blocked)
    parked, taken = [], []
    for lane in quiet:
        if lane.line.length < 25:
            continue
        beside = lane.line.offset_curve(-(lane.width_m / 2 + 0.95))
        if not isinstance(beside, LineString):
            continue
        for d in np.arange(8.0, beside.length - 8.0, 5.9):
            wanted, model = rng.random() < 0.6, int(rng.choice([0, 1, 2], p=[0.6, 0.33, 0.07]))
            here, ahead = (np.array(beside.interpolate(d + e).coords[0]) for e in (-2.2, 2.2))
            body = LineString([here, ahead]).buffer(0.85, cap_style="flat")
            if not wanted or not area.contains(body) or blocked.intersects(body):
                continue
            if any(body.intersects(other) for other in taken[-200:]):
                continue
            taken.append(body)
            x, y = (here + ahead) / 2
            up = PAVEMENT_M if not carriageway.contains(Point(x, y)) else 0.0
            parked.append(ParkedVehicle(float(x), float(y), heading_of(ahead - here), model, up))
    return parked


def _is_quiet(street_type: str) -> bool:
    return any(word in street_type for word in ("residential", "unclassified", "living_street"))
