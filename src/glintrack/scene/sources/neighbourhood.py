"""A random neighbourhood on any street network.

Blocks have houses with gardens and driveways, rows of town houses, shopping centres, office parks, or parks.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import shapely
from shapely.affinity import rotate, scale
from shapely.geometry import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from glintrack.scene.objects.buildings import Building
from glintrack.scene.objects.geometry import bounding_rectangle, polygons
from glintrack.scene.objects.layout import Layout, ParkedVehicle, heading_of
from glintrack.scene.objects.plants import HALF_WIDTH_M, HedgePiece, Tree, draw_tree, hedge_along
from glintrack.scene.objects.surfaces import GroundPatch, RoadAreas, RoadNetwork, blocks
from glintrack.scene.sources.lots import (
    Frontage,
    frontages,
    kerbside_parking,
    parking_rows,
    scatter,
    street_trees,
)

_MAX_FRONT_M = 6.0  # of a lot from its street; outlines of blocks are simplified by half of it
Use = Literal["housing", "town", "shopping", "offices", "park", "green"]


@dataclass
class _Plan:
    """Objects placed so far, and the streets."""

    streets: BaseGeometry
    patches: list[GroundPatch] = field(default_factory=list)
    buildings: list[Building] = field(default_factory=list)
    trees: list[Tree] = field(default_factory=list)
    parked: list[ParkedVehicle] = field(default_factory=list)
    hedges: list[HedgePiece] = field(default_factory=list)


def neighbourhood(
    network: RoadNetwork,
    streets: RoadAreas,
    area: BaseGeometry,
    use_of: Callable[[Polygon, np.random.Generator], Use],
    rng: np.random.Generator,
) -> Layout:
    """Fill the blocks of a street network.

    Parameters
    ----------
    network, streets
        Streets, and their areas.
    area
        Area to fill. [m]
    use_of
        Use of a block; `use_by_size`, or a plan.
    rng
        Source of all random choices.
    """
    fill = {"shopping": _shopping_centre, "offices": _office_park, "park": _park}
    fill |= {"town": _town_block, "green": _green, "housing": _housing}
    plan = _Plan(streets.all)
    shapely.prepare(plan.streets)
    for block in blocks(streets, area):
        block_rng = rng.spawn(1)[0]
        fill[use_of(block, block_rng.spawn(1)[0])](plan, block, block_rng)
    street_rng = rng.spawn(1)[0]
    plan.parked += kerbside_parking(network, area, street_rng, occupancy=0.3)
    solid = unary_union([b.footprint for b in plan.buildings]).buffer(2.0)
    paved = [p.shape for p in plan.patches if p.material in ("concrete", "asphalt_worn", "water")]
    taken = unary_union([streets.carriageway.buffer(0.5), solid, unary_union(paved)])
    plan.trees += street_trees(network, taken, area, street_rng)
    return Layout(
        streets,
        tuple(plan.patches),
        tuple(plan.buildings),
        tuple(plan.trees),
        tuple(plan.parked),
        hedges=tuple(plan.hedges),
    )


def use_by_size(block: Polygon, rng: np.random.Generator) -> Use:
    """Draw the use of a block by its size: large compact ones may be a park, shops or offices."""
    _, _, length, width = bounding_rectangle(block)
    compact = block.area > 0.7 * length * width
    west, south, east, north = block.bounds
    square = block.area > 0.7 * (east - west) * (north - south)  # shops and offices are laid out north-up
    draw = rng.random()
    if width < 22 or block.area < 1500:
        return "green"
    if compact and width > 70 and draw < 0.12:
        return "park"
    if compact and square and min(east - west, north - south) > 100 and block.area < 40000:
        if draw < 0.45:
            return "shopping" if draw < 0.28 else "offices"
    return "town" if 3000 < block.area < 25000 and draw > 0.66 else "housing"


def _housing(plan: _Plan, block: Polygon, rng: np.random.Generator) -> None:
    """Place detached houses along the streets, with driveways, and gardens behind."""
    placed: list[Polygon] = []
    drives: list[Polygon] = []
    lots: list[Frontage] = []
    for lot in _on_streets(plan, frontages(block, lot_m=(15.5, 19.0), corner_m=9.0, rng=rng)):
        house, drive = _house(lot, block, placed, rng)
        if house is None:
            continue
        placed.append(house.footprint)
        plan.buildings.append(house)
        lots.append(lot)
        if drive is not None:
            drives.append(drive)
            plan.patches.append(GroundPatch("concrete" if rng.random() < 0.6 else "asphalt_worn", drive))
            if rng.random() < 0.55:
                x, y = lot.point(lot.width_m / 2 - 1.6, rng.uniform(3.2, 5.5))
                model = 0 if rng.random() < 0.7 else 1
                heading = heading_of(lot.inward) + (math.pi if rng.random() < 0.5 else 0.0)
                plan.parked.append(ParkedVehicle(x, y, heading, model, 0.05))
    built = unary_union([p.buffer(2.5) for p in placed] + [d.buffer(1.0) for d in drives])
    solid = unary_union([*placed, *drives]).buffer(HALF_WIDTH_M + 0.1)
    plan.hedges += _hedges(lots, block.buffer(-HALF_WIDTH_M - 0.1).difference(solid), rng.spawn(1)[0])
    garden = block.buffer(-3.0).difference(built)
    for x, y in scatter(garden, spacing_m=9.0, count=int(block.area / 280), rng=rng):
        plan.trees.append(draw_tree(x, y, rng, (5.0, 13.0)))
    west, south, east, north = block.bounds
    for _ in range(int(block.area / 1500)):  # some lawns are dry, some beds are bare
        x, y = rng.uniform(west, east), rng.uniform(south, north)
        blob = scale(Point(x, y).buffer(1.0, 6), rng.uniform(4, 10), rng.uniform(4, 10))
        material = "grass_dry" if rng.random() < 0.7 else "soil"
        plan.patches.append(GroundPatch(material, rotate(blob, rng.uniform(0, 180)).intersection(block)))


def _on_streets(plan: _Plan, lots: list[Frontage]) -> list[Frontage]:
    """Select lots at a street: a block at the edge of the area has sides without one."""
    return [lot for lot in lots if plan.streets.distance(Point(lot.middle)) < _MAX_FRONT_M]


def _house(
    lot: Frontage, block: Polygon, placed: list[Polygon], rng: np.random.Generator
) -> tuple[Building | None, Polygon | None]:
    width, depth = rng.uniform(8.5, 11.5), rng.uniform(8.0, 10.5)
    setback, shift = rng.uniform(5.5, 8.0), -1.2
    footprint = lot.rectangle(shift - width / 2, shift + width / 2, setback, setback + depth)
    if rng.random() < 0.35:  # an L: a wing toward the garden
        wing = lot.rectangle(shift - width / 2, shift, setback + depth - 0.2, setback + depth + 4.0)
        footprint = polygons(footprint.union(wing))[0]
    apart = footprint.buffer(2.0)
    if not block.contains(footprint) or any(apart.intersects(p) for p in placed):
        return None, None
    whole = footprint.area > 0.98 * shapely.minimum_rotated_rectangle(footprint).area
    roof = ("gable" if rng.random() < 0.6 else "hip") if whole else "mansard"
    wall = str(rng.choice(["siding", "brick", "plaster", "wood"], p=[0.4, 0.3, 0.2, 0.1]))
    tiles = ["roof_shingle", "roof_tile", "roof_tile_new", "roof_tile_grey", "roof_slate"]
    house = Building(
        footprint,
        eaves_m=float(rng.choice([3.0, 5.6], p=[0.35, 0.65])),
        roof=roof,
        wall=wall,
        roof_material=str(rng.choice(tiles, p=[0.4, 0.15, 0.2, 0.15, 0.1])),
        slope_rad=math.radians(rng.uniform(27, 42)),
    )
    drive = lot.rectangle(lot.width_m / 2 - 3.1, lot.width_m / 2 - 0.1, -0.5, setback + 3.0)
    clear = not any(drive.intersects(p) for p in [*placed, footprint])
    return house, drive if clear else None


def _hedges(lots: list[Frontage], free: BaseGeometry, rng: np.random.Generator) -> list[HedgePiece]:
    """Place hedges along some gardens' sides and fronts, clear of houses and drives."""
    pieces: list[HedgePiece] = []
    for lot in lots:
        draw, leaf = rng.random(2), "leaf" if rng.random() < 0.6 else "leaf_walnut"
        side = -lot.width_m / 2 + 0.1 + HALF_WIDTH_M
        hedges = []
        if draw[0] < 0.45:
            hedges.append(LineString([lot.point(side, 1.6), lot.point(side, rng.uniform(14, 24))]))
        if draw[1] < 0.3:
            hedges.append(LineString([lot.point(side + 0.6, 1.0), lot.point(lot.width_m / 2 - 3.8, 1.0)]))
        pieces += [piece for line in hedges if free.contains(line) for piece in hedge_along(line, leaf)]
    return pieces


def _town_block(plan: _Plan, block: Polygon, rng: np.random.Generator) -> None:
    """Place closed rows of three to four storeys along the streets, and a yard with parking behind."""
    placed: list[Polygon] = []
    for lot in _on_streets(plan, frontages(block, lot_m=(11.0, 17.0), corner_m=1.0, rng=rng)):
        depth = rng.uniform(11.0, 13.0)
        footprint = lot.rectangle(-lot.width_m / 2, lot.width_m / 2, 1.5, 1.5 + depth)
        footprint = footprint.intersection(block.buffer(-1.0)).difference(unary_union(placed).buffer(0.02))
        parts = [p for p in polygons(footprint) if p.area > 60]
        if not parts:
            continue
        footprint = max(parts, key=lambda p: p.area)
        placed.append(footprint)
        square = footprint.area > 0.93 * shapely.minimum_rotated_rectangle(footprint).area
        roof, tiles, shares = "gable", ["roof_tile", "roof_slate", "roof_tile_new"], None
        if not square or rng.random() < 0.5:
            roof, tiles, shares = "flat", ["roof_bitumen", "roof_membrane"], [0.65, 0.35]
        plan.buildings.append(
            Building(
                footprint,
                eaves_m=2.9 * int(rng.integers(3, 5)) + 0.8,
                roof=roof,
                wall=str(rng.choice(["brick", "plaster", "concrete"], p=[0.5, 0.35, 0.15])),
                roof_material=str(rng.choice(tiles, p=shares)),
                slope_rad=math.radians(rng.uniform(28, 38)),
            )
        )
    plan.patches.append(GroundPatch("pavement", block.buffer(0.6).difference(block.buffer(-2.5)), 0.10))
    yards = block.buffer(-1.5).difference(unary_union(placed).buffer(2.5)).buffer(-1).buffer(1)
    for yard in polygons(yards):
        _car_park(plan, yard, rng, occupancy=0.36)


def _shopping_centre(plan: _Plan, block: Polygon, rng: np.random.Generator) -> None:
    """Place a large low hall with a glass front, and a car park in front of it."""
    west, south, east, north = block.buffer(-6).bounds
    hall = shapely.box(west + 8, north - 48, east - 8, north - 8).intersection(block.buffer(-6))
    shop = shapely.box(west + 6, south + 6, west + 30, south + 24).intersection(block.buffer(-5))
    for footprint, height, material in ((hall, 7.5, "roof_membrane"), (shop, 5.0, "roof_bitumen")):
        if not (parts := polygons(footprint)):  # a block without this corner
            continue
        piece = max(parts, key=lambda p: p.area)
        plan.buildings.append(
            Building(piece, height, "flat", "concrete", material, glazing="shopfront", storey_m=3.5)
        )
    _car_park(plan, block.buffer(-4).difference(unary_union([hall, shop]).buffer(4)), rng, occupancy=0.36)
    _verge(plan, block, rng)


def _office_park(plan: _Plan, block: Polygon, rng: np.random.Generator) -> None:
    """Place glass-fronted offices with flat roofs, their car park and lawns."""
    inside = block.buffer(-10)
    west, south, east, north = inside.bounds
    footprints = (
        shapely.box(west, north - 18, west + 52, north),
        shapely.box(west, north - 62, west + 17, north - 26),
        shapely.box(east - 60, north - 17, east - 8, north),
        shapely.box(east - 18, south + 4, east, south + 34),
    )
    placed = []
    for footprint, storeys in zip(footprints, (6, 4, 5, 8), strict=True):
        piece = footprint.intersection(inside)
        if piece.area < 150:
            continue
        rotated = rotate(max(polygons(piece), key=lambda p: p.area), rng.uniform(-4, 4))
        placed.append(rotated)
        roof = "roof_bitumen" if storeys != 5 else "roof_membrane"
        plan.buildings.append(
            Building(rotated, 3.5 * storeys, "flat", "concrete", roof, glazing="curtain", storey_m=3.5)
        )
    rest = block.buffer(-9).difference(unary_union(placed).buffer(5))
    if parts := polygons(rest.buffer(-3).buffer(3)):
        _car_park(plan, max(parts, key=lambda p: p.area), rng, occupancy=0.34)
    _verge(plan, block, rng)


def _park(plan: _Plan, block: Polygon, rng: np.random.Generator) -> None:
    """Place a lawn, a pond, gravel paths and old trees."""
    centre = block.centroid
    pond = rotate(scale(Point(centre.x + 12, centre.y - 18).buffer(1.0, 24), 24, 15), 25)
    plan.patches.append(GroundPatch("water", pond, -0.05))
    west, south, east, north = block.bounds
    paths = unary_union(
        [
            LineString([(west, south), (centre.x - 15, centre.y + 5), (east, north)]).buffer(1.3),
            LineString([(west, north), (centre.x - 15, centre.y + 5)]).buffer(1.3),
            pond.buffer(4.5).difference(pond.buffer(2.2)),
        ]
    ).difference(pond.buffer(1.0))
    plan.patches.append(GroundPatch("soil", paths.intersection(block), 0.06))
    free = block.buffer(-4).difference(pond.buffer(5)).difference(paths.buffer(1))
    for x, y in scatter(free, spacing_m=7.5, count=70, rng=rng):
        plan.trees.append(draw_tree(x, y, rng, (9.0, 18.0)))


def _car_park(plan: _Plan, shape: BaseGeometry, rng: np.random.Generator, occupancy: float) -> None:
    for piece in polygons(shape):
        if piece.area < 150:
            continue
        plan.patches.append(GroundPatch("asphalt_worn", piece, 0.03))
        lines, parked = parking_rows(piece, rng, occupancy)
        plan.patches.insert(len(plan.patches) - 1, GroundPatch("road_paint", lines, 0.03))
        plan.parked += parked


def _verge(plan: _Plan, block: Polygon, rng: np.random.Generator) -> None:
    """Place a row of trees inside the block's edge."""
    ring = block.buffer(-2.2).exterior
    for d in np.arange(5.0, ring.length, 11.0):
        p = ring.interpolate(d + rng.uniform(-2, 2))
        plan.trees.append(draw_tree(p.x, p.y, rng, (6.0, 10.0)))


def _green(plan: _Plan, block: Polygon, rng: np.random.Generator) -> None:
    """Place a few trees on grass."""
    for x, y in scatter(block.buffer(-3.0), spacing_m=6.0, count=int(block.area / 200), rng=rng):
        plan.trees.append(draw_tree(x, y, rng, (5.0, 11.0)))
