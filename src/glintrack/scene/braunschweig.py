"""Braunschweig: a real road network with real building outlines, from the installed SUMO wheel.

The network and the 3DS model of the buildings lie in ``sumo/tools/game/bs3d`` and derive from OpenStreetMap
(ODbL); they are read from there and not copied. Real are streets, lanes, rails and footprints. By rule,
because the data do not have it: heights (the model's 7.5 m stands for "unknown": drawn then by footprint
area), roofs (gable or hip on nearly rectangular footprints under 650 m², mansard on other small ones, flat on
the rest), walls, windows, gardens, trees and parked vehicles. The traffic is SUMO's, on signals rebuilt by
netconvert, since the bundled game signals gridlock the network.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely
from shapely.geometry import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from glintrack.scene.buildings import Building
from glintrack.scene.geometry import polygons
from glintrack.scene.layout import MARGIN_M, Layout, ParkedVehicle, covered_area, heading_of
from glintrack.scene.lots import scatter, street_trees
from glintrack.scene.network import RoadNetwork
from glintrack.scene.read_3ds import read_3ds
from glintrack.scene.recording import Recording
from glintrack.scene.run_sumo import SumoRun, recorded, sumo_home
from glintrack.scene.surfaces import PAVEMENT_M, GroundPatch, blocks, road_areas
from glintrack.scene.trees import Tree, draw_tree

CENTRE_M = (660.0, 640.0)  # of the window, in network coordinates
# netOffset of the bundled network: UTM zone 32 minus network coordinates
_UTM_OFFSET_M = (604099.60, 5792153.74)
# Placement of the 3DS model in the network, fitted so that footprints leave the lanes free:
# model axes are e = x, n = −z, h = y.
_MODEL_TO_NETWORK = np.array([[0.97430, -0.02153, 661.007], [0.02077, 1.01144, 678.675]])
_ROOF_MATERIAL = "Material - 20"  # the flat tops of the model's buildings
_UNKNOWN_HEIGHT_M = 7.5
_NETCONVERT = (
    *("-n", "bsplain.nod.xml", "-e", "bsplain.edg.xml", "--ignore-errors.edge-type"),
    *("--junctions.corner-detail", "5", "--no-turnarounds.except-deadend", "--keep-edges.components", "1"),
    *("--junctions.join", "--tls.guess", "--tls.guess.threshold", "45", "--tls.default-type", "actuated"),
    *("--sidewalks.guess", "--sidewalks.guess.max-speed", "20", "--crossings.guess"),
)


def braunschweig_recording(
    extent_m: tuple[float, float, float, float],
    margin_m: float,
    warmup_s: float,
    duration_s: float,
    insertion_period_s: float,
) -> tuple[Recording, tuple[str, float, float]]:
    """Network and traffic in ENU about the window's centre, and that centre's CRS, easting and northing.

    Parameters
    ----------
    extent_m
        West, south, east, north of the window in ENU. [m]
    margin_m
        Traffic is kept this far beyond it. [m]
    warmup_s, duration_s
        SUMO time before the recording, and its length. [s]
    insertion_period_s
        One vehicle enters each such interval. [s]
    """
    folder = _data_folder()
    west, south, east, north = extent_m
    run = SumoRun(
        inputs=(folder / "bsplain.nod.xml", folder / "bsplain.edg.xml"),
        netconvert=_NETCONVERT,
        extent_m=(
            CENTRE_M[0] + west - margin_m,
            CENTRE_M[1] + south - margin_m,
            CENTRE_M[0] + east + margin_m,
            CENTRE_M[1] + north + margin_m,
        ),
        origin_m=CENTRE_M,
        warmup_s=warmup_s,
        duration_s=duration_s,
        insertion_period_s=insertion_period_s,
        seed=42,
    )
    easting, northing = (CENTRE_M[i] + _UTM_OFFSET_M[i] for i in range(2))
    return recorded(run), ("EPSG:32632", easting, northing)


def braunschweig_layout(
    network: RoadNetwork, extent_m: tuple[float, float, float, float], trees: bool, rng: np.random.Generator
) -> Layout:
    """Streets, footprints and what is added by rule.

    Parameters
    ----------
    network
        Streets in ENU.
    extent_m
        West, south, east, north of the window. [m]
    trees
        False leaves every tree out; all else stays as it is.
    rng
        Draws what the data do not have.
    """
    area = covered_area(extent_m)
    network = network.within(area.buffer(MARGIN_M))
    streets = road_areas(network, area)
    building_rng, ground_rng, tree_rng, parking_rng = rng.spawn(4)
    clear = streets.carriageway.buffer(0.3)
    buildings = tuple(
        _by_rule(part, height_m, building_rng)
        for footprint, height_m in footprints()
        if area.contains(footprint.centroid)
        for part in polygons(footprint.intersection(area).difference(clear))
        if part.area > 12
    )
    built = unary_union([b.footprint for b in buildings])
    parked = _parked(network, streets.carriageway, built, area, parking_rng)
    return Layout(
        streets,
        tuple(_grounds(blocks(streets, area), built, ground_rng)),
        buildings,
        tuple(_trees(network, streets.all, built, area, tree_rng)) if trees else (),
        tuple(parked),
    )


def footprints() -> list[tuple[Polygon, float]]:
    """Building outlines in ENU about the window's centre, with the model's height. [m]."""
    found = []
    for thing in read_3ds(_data_folder() / "bs3.3ds"):
        if _ROOF_MATERIAL not in thing.material_faces:
            continue
        model = thing.vertices
        plan = np.c_[model[:, 0], -model[:, 2], np.ones(len(model))] @ _MODEL_TO_NETWORK.T
        plan = plan - CENTRE_M
        faces = thing.faces[thing.material_faces[_ROOF_MATERIAL]]
        triangles = shapely.polygons(plan[faces])
        heights = np.round(model[faces, 1].mean(axis=1) * 2) / 2  # the model's storeys come in half metres
        for height in np.unique(heights[heights > 2]):
            tops = triangles[(heights == height) & (shapely.area(triangles) > 0.02)]
            # triangles of one roof touch only to rounding: 3 cm closes them
            merged = unary_union([t.buffer(0.03, join_style="mitre") for t in tops]).simplify(0.25)
            found += [(p, float(height)) for p in polygons(merged) if p.area > 12]
    return sorted(found, key=lambda f: (round(f[0].centroid.x, 3), round(f[0].centroid.y, 3)))


def _data_folder() -> Path:
    folder = sumo_home() / "tools" / "game" / "bs3d"
    if not (folder / "bs3.3ds").is_file():
        raise ValueError(
            "`traffic` must be the eclipse-sumo wheel with its game networks, got one without bs3d "
            "(pip install eclipse-sumo)"
        )
    return folder


def _by_rule(footprint: Polygon, model_height_m: float, rng: np.random.Generator) -> Building:
    """Give a footprint a height, a roof and a face."""
    rectangle = shapely.minimum_rotated_rectangle(footprint)
    fill, size = footprint.area / rectangle.area, footprint.area
    draw, slope = rng.random(5), math.radians(rng.uniform(32, 46))
    if model_height_m != _UNKNOWN_HEIGHT_M:
        height = model_height_m
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


def _grounds(pieces: Sequence[Polygon], built: BaseGeometry, rng: np.random.Generator) -> list[GroundPatch]:
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


def _trees(
    network: RoadNetwork,
    streets: BaseGeometry,
    built: BaseGeometry,
    area: Polygon,
    rng: np.random.Generator,
) -> list[Tree]:
    near_walls = built.buffer(3.0)
    found = street_trees(network, unary_union([streets.buffer(0.4), near_walls]), area, rng)
    gardens = area.difference(unary_union([streets.buffer(2.0), built.buffer(4.5)])).buffer(-1.5)
    for garden in polygons(gardens):
        for x, y in scatter(garden, spacing_m=7.0, count=int(garden.area / 150), rng=rng):
            found.append(draw_tree(x, y, rng, (6.0, 15.0)))
    return found


def _parked(
    network: RoadNetwork,
    carriageway: BaseGeometry,
    built: BaseGeometry,
    area: Polygon,
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
