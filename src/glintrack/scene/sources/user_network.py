"""A city from a network a user brings: SUMO's own format with polygons, or an OpenStreetMap extract.

What the files say is kept: streets, footprints, heights, kinds of ground. What they do not say is drawn by
rule and reported: heights and roofs, gardens and trees, and the buildings themselves where a file has none.
"""

import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import shapely
from shapely.affinity import translate
from shapely.geometry import Polygon, box
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from glintrack.scene.design import SceneDesign
from glintrack.scene.objects.geometry import polygons, tiled
from glintrack.scene.objects.layout import MARGIN_M, Layout, covered_area, grown
from glintrack.scene.objects.plants import Tree, draw_tree
from glintrack.scene.objects.surfaces import GroundPatch, RoadNetwork, blocks, road_areas
from glintrack.scene.read.fcd import read_fcd
from glintrack.scene.read.polygons import Polygons, read_osm, read_polygons
from glintrack.scene.read.sumo import (
    FULL_MIX,
    NetLocation,
    SumoRun,
    read_sumo_net,
    recorded,
    shifted,
    standing_signals,
)
from glintrack.scene.sources.lots import (
    building_by_rule,
    garden_trees,
    parked_on_pavements,
    parking_rows,
    scatter,
    yards,
)
from glintrack.scene.sources.neighbourhood import neighbourhood, use_by_size
from glintrack.scene.sources.site import VEHICLE_MARGIN_M, SceneOrigin, Site, network_place, resolve_file
from glintrack.scene.traffic import Recording

_CROP_MARGIN_M = 300.0  # streets kept beyond the window, so that traffic has somewhere to come from
_LANES_PER_PERIOD_M = 60_000.0  # driven lanes that one vehicle every 0.6 s keeps busy, not jammed
_GARDEN_REACH_M = 45.0
_PASSAGE_M = 2.0  # of a lane's middle within a building, beyond what outlines are out by
_FEW_STREETS = 5  # of them named
_NEAR_DEG = 1.0  # of the town's degrees, within which a middle is taken to be in them
_GROUND_MATERIAL = {
    "water": ("water", -0.05),
    "forest": ("grass", 0.04),
    "parking": ("asphalt_worn", 0.03),
    "soil": ("soil", 0.05),
    "dry": ("grass_dry", 0.05),
    "lawn": ("grass", 0.045),
}


def network_site(design: SceneDesign) -> Site:
    """Streets, buildings and traffic of a design with city ``net`` or ``osm``.

    Raises
    ------
    ValueError
        If a file is missing, damaged or empty, or the window has no street.
    """
    with tempfile.TemporaryDirectory(prefix="glintrack-city-") as scratch:
        if design.city == "osm":
            net_path = Path(scratch) / "osm.net.xml"
            network, location, found = read_osm(resolve_file(str(design.osm_file)), net_path)
        else:
            net_path = resolve_file(str(design.net_file))
            network, location = read_sumo_net(net_path)
            named = design.polygons_file
            found = read_polygons(resolve_file(named)) if named else Polygons()
        return _site(design, net_path, network, location, found)


def _site(
    design: SceneDesign, net_path: Path, network: RoadNetwork, location: NetLocation, found: Polygons
) -> Site:
    if not network.of_kind("car"):
        raise ValueError(f"`{net_path.name}` must have a lane for motor vehicles, got none")
    extent = design.extent_m
    assumptions: tuple[str, ...] = ()
    centre = design.centre_m
    if centre is None:
        centre = busiest_place(network, *design.size_m)
        assumptions += (
            f"the window is put where the network is densest, about ({centre[0]:g}, {centre[1]:g})",
        )
    place, more = network_place(design, location, centre)
    if design.centre_m is not None:
        _check_metres(centre, place)
    window = box(*extent)
    near = network.shifted(-centre[0], -centre[1]).within(covered_area(extent).buffer(MARGIN_M))
    driven = sum(lane.line.intersection(window).length for lane in near.of_kind("car"))
    if driven < 50:
        raise ValueError(
            f"`scene.centre_m` must put streets into the window, got {driven:.0f} m of lanes in "
            f"{design.size_m[0]:g} × {design.size_m[1]:g} m about ({centre[0]:g}, {centre[1]:g})"
        )
    recording, guessed = _traffic(design, net_path, network, near, centre)
    local = _moved(found, centre, covered_area(extent))
    fill = not local.footprints
    through = streets_through_buildings(near, local)
    assumptions += more + guessed + _cut_open(through) + _guesses(local, fill)
    return Site(
        recording,
        place,
        extent,
        partial(_layout, near, local, extent, fill),
        traffic_origin_m=centre,
        assumptions=assumptions,
    )


def _check_metres(centre_m: tuple[float, float], place: SceneOrigin) -> None:
    """Refuse the town's own longitude and latitude, which a small network has as metres too."""
    degrees = place.longitude_latitude_deg
    for pair in (degrees, degrees[::-1]):
        if all(abs(a - b) < _NEAR_DEG for a, b in zip(centre_m, pair, strict=True)):
            raise ValueError(
                f"`scene.centre_m` must be in the network's own coordinates, in m, got ({centre_m[0]:g}, "
                f"{centre_m[1]:g}), which are the town's degrees (leave it out for the densest place)"
            )


def busiest_place(network: RoadNetwork, width_m: float, height_m: float) -> tuple[float, float]:
    """Centre of the window that holds the greatest length of driven lanes, in whole cells of 30 m. [m]"""
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
    held = total[wide:, high:] - total[:-wide, high:] - total[wide:, :-high] + total[:-wide, :-high]
    i, j = np.unravel_index(np.argmax(held), held.shape)
    east, north = low + cell * (np.array([i, j]) + np.array([wide, high]) / 2)
    return round(float(east), 1), round(float(north), 1)


def _traffic(
    design: SceneDesign,
    net_path: Path,
    network: RoadNetwork,
    near: RoadNetwork,
    centre: tuple[float, float],
) -> tuple[Recording, tuple[str, ...]]:
    west, south, east, north = design.extent_m
    window = (centre[0] + west, centre[1] + south, centre[0] + east, centre[1] + north)
    kept = grown(window, VEHICLE_MARGIN_M)
    if design.traffic_file:
        traffic, odd = read_fcd(resolve_file(design.traffic_file), kept)
        recording = Recording(near, shifted(traffic, -centre[0], -centre[1]))
        return recording, odd.sentences()
    crop = grown(window, _CROP_MARGIN_M)
    driven = sum(lane.line.length for lane in network.within(box(*crop)).of_kind("car"))
    period = design.traffic_insertion_period_s
    said: tuple[str, ...] = ()
    if period is None:
        period = round(float(np.clip(0.6 * _LANES_PER_PERIOD_M / max(driven, 1.0), 0.1, 6.0)), 2)
        said = (f"one vehicle enters each {period:g} s, for {driven / 1000:.1f} km of driven lanes",)
    signals: tuple[str, ...] = ()
    stand = standing_signals(net_path)
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
        seed=42,
        mix=FULL_MIX,
    )
    return replace(recorded(run), network=near), said


def _moved(found: Polygons, centre: tuple[float, float], area: Polygon) -> Polygons:
    """Polygons in ENU, only what touches the area."""

    def here(shape):
        return translate(shape, -centre[0], -centre[1])

    footprints = (replace(f, shape=here(f.shape)) for f in found.footprints)
    grounds = ((kind, here(shape)) for kind, shape in found.grounds)
    return replace(
        found,
        footprints=tuple(f for f in footprints if area.contains(f.shape.centroid)),
        grounds=tuple((kind, shape.intersection(area)) for kind, shape in grounds if shape.intersects(area)),
    )


def streets_through_buildings(network: RoadNetwork, found: Polygons) -> list[str]:
    """Streets whose lanes run through a building, by their ids, OpenStreetMap's own where it has one."""
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


def _cut_open(streets: list[str]) -> tuple[str, ...]:
    """What to say of streets that run through buildings."""
    if not streets:
        return ()
    more = ", …" if len(streets) > _FEW_STREETS else ""
    one = len(streets) == 1
    return (
        f"{len(streets)} street{' runs' if one else 's run'} through buildings, which are cut open along "
        f"{'it' if one else 'them'}, without a roof above: {', '.join(streets[:_FEW_STREETS])}{more}",
    )


def _guesses(found: Polygons, fill: bool) -> tuple[str, ...]:
    said = []
    count = len(found.footprints)
    unknown = sum(f.height_m is None for f in found.footprints)
    if unknown:
        said.append(
            f"{unknown} of {count} building heights are unknown: drawn by footprint area, 2.8 to 12 m"
        )
    if count:
        said.append(f"roofs, walls and windows of {count} buildings are drawn by rule")
    if found.courtyards:
        said.append(f"{found.courtyards} rings inside others are taken for courtyards")
    if fill:
        said.append("blocks without buildings are filled with houses, shops and parks by rule")
    return (*said, "trees, gardens and parked vehicles are drawn by rule")


def _layout(
    network: RoadNetwork,
    found: Polygons,
    extent_m: tuple[float, float, float, float],
    fill: bool,
    rng: np.random.Generator,
) -> Layout:
    area = covered_area(extent_m)
    streets = road_areas(network, area)
    building_rng, ground_rng, tree_rng, parking_rng, fill_rng = rng.spawn(5)
    clear = streets.carriageway.buffer(0.3)
    buildings = tuple(
        building_by_rule(part, footprint.height_m, building_rng)
        for footprint in found.footprints
        for part in polygons(footprint.shape.intersection(area).difference(clear))
        if part.area > 12
    )
    built = unary_union([b.footprint for b in buildings])
    patches, parked, wood = _grounds(found, streets.all, built, ground_rng)
    covered = unary_union([shape for kind, shape in found.grounds if kind != "lawn"])
    if fill:
        taken = unary_union([built.buffer(3), covered])
        free = area.difference(taken) if not taken.is_empty else area
        hood = neighbourhood(network, streets, free, use_by_size, fill_rng)
        return Layout(
            streets,
            (*patches, *hood.patches),
            (*buildings, *hood.buildings),
            (*wood, *hood.trees),
            (*parked, *hood.parked),
        )
    patches += yards(blocks(streets, area), built, ground_rng)
    home = unary_union([built.buffer(_GARDEN_REACH_M), streets.pavement.buffer(6)]).intersection(area)
    grown = garden_trees(network, unary_union([streets.all, covered]), built, home, tree_rng)
    open_land = area.difference(unary_union([home, covered, streets.all.buffer(4)]))
    for piece in tiled(open_land, 120.0):
        for x, y in scatter(piece, spacing_m=9.0, count=int(piece.area / 1500), rng=tree_rng):
            grown.append(draw_tree(x, y, tree_rng, (5.0, 13.0)))
    parked += parked_on_pavements(network, streets.carriageway, built, area, parking_rng)
    return Layout(streets, tuple(patches), buildings, (*wood, *grown), tuple(parked))


def _grounds(
    found: Polygons, streets: BaseGeometry, built: BaseGeometry, rng: np.random.Generator
) -> tuple[list[GroundPatch], list, list[Tree]]:
    """Patches of the file's grounds, cars in its car parks, and the trees of its woods."""
    patches, parked, wood = [], [], []
    solid = unary_union([streets.buffer(1.5), built.buffer(3)])
    ranks = list(_GROUND_MATERIAL)
    # the smaller lie on the larger: a pond in a park, a car park in a wood
    for kind, shape in sorted(found.grounds, key=lambda g: (ranks.index(g[0]) // 3, g[1].area)):
        material, height = _GROUND_MATERIAL[kind]
        if kind == "parking":
            for piece in polygons(shape.difference(solid)):
                if piece.area > 150:
                    lines, cars = parking_rows(piece, rng, occupancy=0.36, aisles_outside=True)
                    patches.append(GroundPatch("road_paint", lines, height))
                    parked += cars
        if kind == "forest":
            for piece in tiled(shape.difference(solid), 80.0):
                for x, y in scatter(piece, spacing_m=4.5, count=int(piece.area / 55), rng=rng):
                    wood.append(draw_tree(x, y, rng, (9.0, 18.0)))
        patches.append(GroundPatch(material, shape, height))
    return patches, parked, wood
