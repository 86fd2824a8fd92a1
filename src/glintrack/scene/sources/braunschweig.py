"""Braunschweig: a real road network with real building outlines, from the installed SUMO wheel.

The network and the 3DS model of the buildings lie in ``sumo/tools/game/bs3d`` and derive from OpenStreetMap
(ODbL); they are read from there and not copied. Real are streets, lanes, rails and footprints. By rule,
because the data do not have it: heights (the model's 7.5 m stands for "unknown": drawn then by footprint
area), roofs (gable or hip on nearly rectangular footprints under 650 m², mansard on other small ones, flat on
the rest), walls, windows, gardens, trees and parked vehicles. The traffic is SUMO's, on signals rebuilt by
netconvert, since the bundled game signals gridlock the network.
"""

from pathlib import Path

import numpy as np
import shapely
from shapely.geometry import Polygon
from shapely.ops import unary_union

from glintrack.core.extras import install_line
from glintrack.scene.objects.geometry import polygons
from glintrack.scene.objects.layout import MARGIN_M, Layout, covered_area
from glintrack.scene.objects.surfaces import blocks, road_areas
from glintrack.scene.sources.braunschweig import read_3ds
from glintrack.scene.sources.lots import building_by_rule, garden_trees, parked_on_pavements, yards
from glintrack.scene.objects.surfaces import RoadNetwork
from glintrack.scene.traffic import Recording
from glintrack.scene.read.sumo import SumoRun, recorded, sumo_home

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
    network: RoadNetwork, extent_m: tuple[float, float, float, float], rng: np.random.Generator
) -> Layout:
    """Streets, footprints and what is added by rule.

    Parameters
    ----------
    network
        Streets in ENU.
    extent_m
        West, south, east, north of the window. [m]
    rng
        Draws what the data do not have.
    """
    area = covered_area(extent_m)
    network = network.within(area.buffer(MARGIN_M))
    streets = road_areas(network, area)
    building_rng, ground_rng, tree_rng, parking_rng = rng.spawn(4)
    clear = streets.carriageway.buffer(0.3)
    buildings = tuple(
        building_by_rule(part, None if height_m == _UNKNOWN_HEIGHT_M else height_m, building_rng)
        for footprint, height_m in footprints()
        if area.contains(footprint.centroid)
        for part in polygons(footprint.intersection(area).difference(clear))
        if part.area > 12
    )
    built = unary_union([b.footprint for b in buildings])
    parked = parked_on_pavements(network, streets.carriageway, built, area, parking_rng)
    return Layout(
        streets,
        tuple(yards(blocks(streets, area), built, ground_rng)),
        buildings,
        tuple(garden_trees(network, streets.all, built, area, tree_rng)),
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
            f"({install_line('traffic')})"
        )
    return folder
