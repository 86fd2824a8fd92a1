"""A city from a network of a user: SUMO's own format with polygons, or an OpenStreetMap extract.

Streets, footprints, heights and kinds of ground come from the files. The rest is drawn by rule and reported:
unknown heights, roofs, gardens and trees, and the buildings themselves where a file has none.
"""

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import shapely
from shapely.affinity import translate
from shapely.geometry import Polygon, box
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from glintrack.core.installation import read_data
from glintrack.scene.design import SceneDesign
from glintrack.scene.objects.geometry import cut_into_tiles, polygons
from glintrack.scene.objects.layout import MARGIN_M, Layout, area_with_margin, expand_extent
from glintrack.scene.objects.plants import Tree, draw_tree
from glintrack.scene.objects.surfaces import GroundPatch, RoadNetwork, blocks, road_areas
from glintrack.scene.read.osm import keeps_left, read_osm
from glintrack.scene.read.polygons import Polygons, read_polygons
from glintrack.scene.read.sumo import (
    FULL_MIX,
    TRIPS_SEED,
    NetLocation,
    SumoRun,
    count_standing_signals,
    load_or_simulate,
    read_sumo_net,
)
from glintrack.scene.sources import lots
from glintrack.scene.sources import site as sites
from glintrack.scene.sources.neighbourhood import neighbourhood, use_by_size
from glintrack.scene.traffic import Recording

_CROP_MARGIN_M = 300.0  # of streets beyond the window, where traffic comes from
_LANES_PER_PERIOD_M = 60_000.0  # of lanes that one vehicle every 0.6 s fills without a jam
_GARDEN_REACH_M = 45.0
_PASSAGE_M = 2.0  # of a lane's middle within a building, more than the error of outlines
_MOTORWAY_CLEARANCE_M = 40.0  # of houses from its edge: German Federal Trunk Road Act, section 9
_NAMED_STREETS = 5
_NEAR_DEG = 1.0  # of the town's position, within which a centre is taken for degrees
_GROUND_MATERIAL: Mapping[str, tuple[str, float]] = read_data("cities.toml")["ground"]


def network_site(design: SceneDesign) -> sites.Site:
    """Streets, buildings and traffic of a design with city ``net`` or ``osm``.

    Raises
    ------
    ValueError
        If a file is missing, damaged or empty, or the window has no street.
    """
    with tempfile.TemporaryDirectory(prefix="glintrack-city-") as scratch:
        if design.city == "osm":
            net_path = Path(scratch) / "osm.net.xml"
            network, location, found = read_osm(
                sites.resolve_file(str(design.osm_file)), net_path, design.left_hand
            )
        else:
            net_path = sites.resolve_file(str(design.net_file))
            network, location = read_sumo_net(net_path)
            named = design.polygons_file
            found = read_polygons(sites.resolve_file(named), location) if named else Polygons()
        return _site(design, net_path, network, location, found)


def _site(
    design: SceneDesign, net_path: Path, network: RoadNetwork, location: NetLocation, found: Polygons
) -> sites.Site:
    if not network.of_kind("car"):
        raise ValueError(f"`{net_path.name}` must have a lane for motor vehicles; got none.")
    extent = design.extent_m
    assumptions: tuple[str, ...] = ()
    centre = design.centre_m
    if centre is None:
        centre = busiest_place(network, *design.size_m)
        assumptions += (
            f"the window is put where the network is densest, about ({centre[0]:g}, {centre[1]:g}).",
        )
    place, more = sites.place_of(design, location, centre, "network has no projection")
    degrees = place.longitude_latitude_deg
    assumptions += (_driving_side(design, network, None if more else degrees),)
    for pair in (degrees, degrees[::-1]):  # a small network has the town's degrees as metres too
        if design.centre_m and all(abs(a - b) < _NEAR_DEG for a, b in zip(centre, pair, strict=True)):
            raise ValueError(
                f"`scene.centre_m` must be in the network's own coordinates, in m; got ({centre[0]:g}, "
                f"{centre[1]:g}), which are the town's degrees. Leave it out for the densest place."
            )
    window = box(*extent)
    area = area_with_margin(extent)
    near = network.shift(-centre[0], -centre[1]).within(area.buffer(MARGIN_M))
    driven = sum(lane.line.intersection(window).length for lane in near.of_kind("car"))
    if driven < 50:
        raise ValueError(
            f"`scene.centre_m` must put streets into the window; got {driven:.0f} m of lanes in "
            f"{design.size_m[0]:g} × {design.size_m[1]:g} m about ({centre[0]:g}, {centre[1]:g})."
        )
    recording, guessed = _traffic(design, net_path, network, near, centre, None if more else place)
    shapes = ((f, translate(f.shape, -centre[0], -centre[1])) for f in found.footprints)
    grounds = ((kind, translate(shape, -centre[0], -centre[1])) for kind, shape in found.grounds)
    local = replace(
        found,
        footprints=tuple(replace(f, shape=s) for f, s in shapes if area.contains(s.centroid)),
        grounds=tuple((kind, shape.intersection(area)) for kind, shape in grounds if shape.intersects(area)),
    )
    if design.polygons_file and found.footprints and not local.footprints:
        raise ValueError(
            f"`scene.polygons_file` must have a building in the window; got {len(found.footprints)} "
            "elsewhere. Convert it with SUMO's polyconvert and this network, or leave it out."
        )
    fill = design.fill_blocks if design.fill_blocks is not None else not local.footprints
    assumptions += (*more, *guessed, *_guesses(local, streets_through_buildings(near, local), fill))
    if fill and any(lane.is_motorway for lane in near.lanes):
        assumptions += (f"nothing is built within {_MOTORWAY_CLEARANCE_M:g} m of motorways and their ramps",)
    layout = partial(_layout, near, local, area, fill)
    return sites.Site(recording, place, extent, layout, traffic_origin_m=centre, assumptions=assumptions)


def _driving_side(design: SceneDesign, network: RoadNetwork, place_deg: tuple[float, float] | None) -> str:
    """Sentence on the side of the road that traffic keeps to; refuse a key that differs from the network."""
    side, other = ("left", "right") if network.left_hand else ("right", "left")
    if design.left_hand not in (None, network.left_hand):
        raise ValueError(
            f"`scene.left_hand` must be that of the network, whose traffic keeps {side}; got the other. "
            "Build it by netconvert with --lefthand or without."
        )
    if design.city == "osm":
        return f"traffic keeps {side}, as in the country (scene.left_hand)"
    differs = place_deg is not None and keeps_left(*place_deg) != network.left_hand
    return f"traffic keeps {side}, as the network says" + f", although {other} in the country" * differs


def busiest_place(network: RoadNetwork, width_m: float, height_m: float) -> tuple[float, float]:
    """Centre of the window with the greatest length of lanes for cars, in whole cells of 30 m. [m]"""
    cell = 30.0
    lanes = unary_union([lane.line.segmentize(cell / 2) for lane in network.of_kind("car")])
    points = shapely.get_coordinates(lanes)
    low = points.min(axis=0)
    index = ((points - low) / cell).astype(int)
    size = index.max(axis=0) + 1
    count = np.zeros(size + 1)
    np.add.at(count, (index[:, 0] + 1, index[:, 1] + 1), 1.0)
    total = count.cumsum(axis=0).cumsum(axis=1)
    wide, high = (max(min(round(m / cell), n), 1) for m, n in zip((width_m, height_m), size, strict=True))
    covered = total[wide:, high:] - total[:-wide, high:] - total[wide:, :-high] + total[:-wide, :-high]
    i, j = np.unravel_index(np.argmax(covered), covered.shape)
    east, north = low + cell * (np.array([i, j]) + np.array([wide, high]) / 2)
    return round(float(east), 1), round(float(north), 1)


def _traffic(
    design: SceneDesign,
    net_path: Path,
    network: RoadNetwork,
    near: RoadNetwork,
    centre: tuple[float, float],
    place: sites.SceneOrigin | None,
) -> tuple[Recording, tuple[str, ...]]:
    west, south, east, north = design.extent_m
    window = (centre[0] + west, centre[1] + south, centre[0] + east, centre[1] + north)
    kept = expand_extent(window, sites.VEHICLE_MARGIN_M)
    if design.traffic_file:
        reach = expand_extent(design.extent_m, sites.VEHICLE_MARGIN_M)
        return Recording(near, sites.read_traffic(design, reach, place, centre)), ()
    crop = expand_extent(window, _CROP_MARGIN_M)
    driven = sum(lane.line.length for lane in network.within(box(*crop)).of_kind("car"))
    period = design.traffic_insertion_period_s
    said: tuple[str, ...] = ()
    if period is None:
        period = round(float(np.clip(0.6 * _LANES_PER_PERIOD_M / max(driven, 1.0), 0.1, 6.0)), 2)
        said = (f"one vehicle enters each {period:g} s, for {driven / 1000:.1f} km of driven lanes",)
    signals: tuple[str, ...] = ()
    stand = count_standing_signals(net_path)
    if stand:
        signals = "--tls.rebuild", "--tls.default-type", "actuated"
        said += (f"{stand} signals never change by themselves: all get SUMO's actuated programs",)
    run = SumoRun(
        inputs=(net_path,),
        netconvert=(
            *("-s", net_path.name, "--offset.disable-normalization", "--keep-edges.in-boundary"),
            *(",".join(f"{c:.1f}" for c in crop), "--keep-edges.components", "1"),
            *signals,
        ),
        extent_m=kept,
        origin_m=centre,
        duration_s=design.traffic_duration_s,
        insertion_period_s=period,
        seed=TRIPS_SEED + design.seed,
        mix=FULL_MIX,
    )
    return replace(load_or_simulate(run), network=near), said


def streets_through_buildings(network: RoadNetwork, found: Polygons) -> list[str]:
    """Find streets that run through a building, by their ids, OpenStreetMap's own where it has one."""
    lanes = network.of_kind("car")
    outlines = [footprint.shape for footprint in found.footprints]
    lane, building = shapely.STRtree(outlines).query([one.line for one in lanes], predicate="intersects")
    inside = [
        lanes[k].line.intersection(outlines[b]).length > _PASSAGE_M
        for k, b in zip(lane, building, strict=True)
    ]
    # netconvert puts a sign for the direction before a way's id, and the number of its piece behind
    ids = (lanes[k].edge_id.removeprefix("-").partition("#")[0] for k in lane[inside])
    return list(dict.fromkeys(ids))


def _guesses(found: Polygons, through: list[str], fill: bool) -> list[str]:
    """Sentences on streets through buildings, and on the parts that are drawn by rule."""
    said = []
    if through:
        one, more = len(through) == 1, ", …" if len(through) > _NAMED_STREETS else ""
        said.append(
            f"{len(through)} street{' runs' if one else 's run'} through buildings, which are cut open along "
            f"{'it' if one else 'them'}, without a roof above: {', '.join(through[:_NAMED_STREETS])}{more}"
        )
    count = len(found.footprints)
    unknown = sum(f.height_m is None for f in found.footprints)
    if unknown:
        said.append(f"{unknown} of {count} building heights are unknown: drawn by area, 2.8 to 12 m")
    if count:
        said.append(f"roofs, walls and windows of {count} buildings are drawn by rule")
    if fill:
        said.append("blocks without buildings are filled with houses, shops and parks by rule")
    return [*said, "trees, gardens and parked vehicles are drawn by rule"]


def _layout(
    network: RoadNetwork, found: Polygons, area: Polygon, fill: bool, rng: np.random.Generator
) -> Layout:
    streets = road_areas(network, area)
    building_rng, ground_rng, tree_rng, parking_rng, fill_rng = rng.spawn(5)
    buildings = lots.buildings_by_rule(found.footprints, area, streets.carriageway, building_rng)
    built = unary_union([b.footprint for b in buildings])
    patches, parked, wood = _grounds(found, streets.all, built, ground_rng)
    covered = unary_union([shape for kind, shape in found.grounds if kind != "lawn"])
    if fill:
        taken = unary_union([built.buffer(3), covered, _motorway_strip(network)])
        free = area.difference(taken) if not taken.is_empty else area
        hood = neighbourhood(network, streets, free, use_by_size, fill_rng)
        return Layout(
            streets,
            (*patches, *hood.patches),
            (*buildings, *hood.buildings),
            (*wood, *hood.trees),
            (*parked, *hood.parked),
            hedges=hood.hedges,
        )
    patches += lots.yards(blocks(streets, area), built, ground_rng)
    home = unary_union([built.buffer(_GARDEN_REACH_M), streets.pavement.buffer(6)]).intersection(area)
    grown = lots.garden_trees(network, unary_union([streets.all, covered]), built, home, tree_rng)
    open_land = area.difference(unary_union([home, covered, streets.all.buffer(4)]))
    for piece in cut_into_tiles(open_land, 120.0):
        for x, y in lots.scatter(piece, spacing_m=9.0, count=int(piece.area / 1500), rng=tree_rng):
            grown.append(draw_tree(x, y, tree_rng, (5.0, 13.0)))
    parked += lots.pavement_parking(network, streets.carriageway, built, area, parking_rng)
    return Layout(streets, tuple(patches), buildings, (*wood, *grown), tuple(parked))


def _motorway_strip(network: RoadNetwork) -> BaseGeometry:
    """Land along motorways and their ramps on which nothing is built."""
    lanes = (lane for lane in network.lanes if lane.is_motorway)
    return unary_union([lane.line.buffer(_MOTORWAY_CLEARANCE_M + lane.width_m / 2) for lane in lanes])


def _grounds(
    found: Polygons, streets: BaseGeometry, built: BaseGeometry, rng: np.random.Generator
) -> tuple[list[GroundPatch], list, list[Tree]]:
    """Patches of the file's grounds, cars in its car parks, and trees in its woods."""
    patches, parked, wood = [], [], []
    solid = unary_union([streets.buffer(1.5), built.buffer(3)])
    ranks = list(_GROUND_MATERIAL)
    # the smaller lie on the larger: a pond in a park, a car park in a wood
    for kind, shape in sorted(found.grounds, key=lambda g: (ranks.index(g[0]) // 3, g[1].area)):
        material, height = _GROUND_MATERIAL[kind]
        if kind == "parking":
            for piece in polygons(shape.difference(solid)):
                if piece.area > 150:
                    lines, cars = lots.parking_rows(piece, rng, occupancy=0.36, aisles_outside=True)
                    patches.append(GroundPatch("road_paint", lines, height))
                    parked += cars
        if kind == "forest":
            for piece in cut_into_tiles(shape.difference(solid), 80.0):
                for x, y in lots.scatter(piece, spacing_m=4.5, count=int(piece.area / 55), rng=rng):
                    wood.append(draw_tree(x, y, rng, (9.0, 18.0)))
        patches.append(GroundPatch(material, shape, height))
    return patches, parked, wood
