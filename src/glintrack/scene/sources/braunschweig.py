"""Braunschweig: a real road network with real building outlines, from the installed SUMO wheel.

The network and the 3DS model of the buildings are in ``sumo/tools/game/bs3d`` and derive from OpenStreetMap
(ODbL); they are read from there and not copied. Streets, lanes, rails and footprints are real. The data lack
the rest, which is drawn by rule: heights (the model's 7.5 m means "unknown": drawn by footprint area), roofs
(gable or hip on nearly rectangular footprints under 650 m², mansard on other small ones, flat on the rest),
walls, windows, gardens, trees and parked vehicles. SUMO simulates the traffic on signals rebuilt by
netconvert, since the bundled game signals gridlock the network.
"""

import struct
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import shapely
from jaxtyping import Float, Int
from shapely.geometry import Polygon
from shapely.ops import unary_union

from glintrack.core.arrays import Array
from glintrack.core.installation import install_line
from glintrack.scene.design import SceneDesign
from glintrack.scene.objects.geometry import polygons
from glintrack.scene.objects.layout import MARGIN_M, Layout, area_with_margin, expand_extent
from glintrack.scene.objects.surfaces import RoadNetwork, blocks, road_areas
from glintrack.scene.read.polygons import Footprint
from glintrack.scene.read.sumo import NETCONVERT, TRIPS_SEED, SumoRun, load_or_simulate, sumo_home
from glintrack.scene.sources.lots import buildings_by_rule, garden_trees, pavement_parking, yards
from glintrack.scene.sources.site import VEHICLE_MARGIN_M, SceneOrigin, Site

CENTRE_M = (660.0, 640.0)  # of the window, in network coordinates
# netOffset of the bundled network: UTM zone 32 minus network coordinates
_UTM_OFFSET_M = (604099.60, 5792153.74)
# Placement of the 3DS model in the network, fitted so that footprints leave the lanes free:
# model axes are e = x, n = −z, h = y.
_MODEL_TO_NETWORK = np.array([[0.97430, -0.02153, 661.007], [0.02077, 1.01144, 678.675]])
_ROOF_MATERIAL = "Material - 20"  # the flat tops of the model's buildings
_UNKNOWN_HEIGHT_M = 7.5
_PERIOD_S = 0.6  # between two vehicles that enter


def braunschweig_site(design: SceneDesign) -> Site:
    """Streets, traffic and layout rule of a design with city ``braunschweig``."""
    folder = _data_folder()
    west, south, east, north = expand_extent(design.extent_m, VEHICLE_MARGIN_M)
    run = SumoRun(
        inputs=(folder / "bsplain.nod.xml", folder / "bsplain.edg.xml"),
        netconvert=NETCONVERT["braunschweig"],
        extent_m=(CENTRE_M[0] + west, CENTRE_M[1] + south, CENTRE_M[0] + east, CENTRE_M[1] + north),
        origin_m=CENTRE_M,
        duration_s=design.traffic_duration_s,
        insertion_period_s=design.traffic_insertion_period_s or _PERIOD_S,
        seed=TRIPS_SEED + design.seed,
    )
    recording = load_or_simulate(run)
    place = SceneOrigin("EPSG:32632", *(CENTRE_M[i] + _UTM_OFFSET_M[i] for i in range(2)))
    return Site(recording, place, design.extent_m, partial(_layout, recording.network, design.extent_m))


def _layout(
    network: RoadNetwork, extent_m: tuple[float, float, float, float], rng: np.random.Generator
) -> Layout:
    area = area_with_margin(extent_m)
    network = network.within(area.buffer(MARGIN_M))
    streets = road_areas(network, area)
    building_rng, ground_rng, tree_rng, parking_rng = rng.spawn(4)
    outlines = [
        Footprint(shape, None if height_m == _UNKNOWN_HEIGHT_M else height_m)
        for shape, height_m in footprints()
        if area.contains(shape.centroid)
    ]
    buildings = buildings_by_rule(outlines, area, streets.carriageway, building_rng)
    built = unary_union([b.footprint for b in buildings])
    parked = pavement_parking(network, streets.carriageway, built, area, parking_rng)
    return Layout(
        streets,
        tuple(yards(blocks(streets, area), built, ground_rng)),
        buildings,
        tuple(garden_trees(network, streets.all, built, area, tree_rng)),
        tuple(parked),
    )


def footprints() -> list[tuple[Polygon, float]]:
    """Read building outlines in ENU about the window's centre, with the model's height. [m]"""
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
            "`traffic` must be the eclipse-sumo wheel with its game networks; got one without bs3d. "
            f"Run: {install_line('traffic')}"
        )
    return folder


_CONTAINERS = (0x4D4D, 0x3D3D, 0x4100)  # main, editor, triangle mesh: chunks of chunks only
_OBJECT, _VERTICES, _FACES, _FACE_MATERIAL = 0x4000, 0x4110, 0x4120, 0x4130


@dataclass
class Object3ds:
    """One object of a 3DS file in its own axes and unit; indices into ``faces`` by material name."""

    name: str
    vertices: Float[Array, "vertex 3"]
    faces: Int[Array, "face 3"]
    material_faces: dict[str, Int[Array, "face"]]


def read_3ds(path: Path) -> tuple[Object3ds, ...]:
    """Read the objects of a 3DS file that have faces.

    Raises
    ------
    ValueError
        If a chunk or an array reaches beyond its end.
    """
    data, objects = path.read_bytes(), []

    def text(start: int) -> tuple[str, int]:
        end = data.index(b"\0", start)
        return data[start:end].decode("latin-1"), end + 1

    def table(start: int, dtype: str, width: int) -> Array:
        (count,) = struct.unpack_from("<H", data, start)
        return np.frombuffer(data, dtype, count * width, start + 2).reshape(count, width)

    def walk(start: int, stop: int) -> None:
        while start < stop:
            kind, length = struct.unpack_from("<HI", data, start)
            if length < 6:
                raise ValueError(f"a chunk of {length} bytes")
            body, start = start + 6, start + length
            if kind in _CONTAINERS:
                walk(body, start)
            elif kind == _OBJECT:
                name, body = text(body)
                objects.append(Object3ds(name, np.zeros((0, 3)), np.zeros((0, 3), int), {}))
                walk(body, start)
            elif kind == _VERTICES:
                objects[-1].vertices = table(body, "<f4", 3).astype(float)
            elif kind == _FACES:
                edges = table(body, "<u2", 4)  # the fourth number is edge flags
                objects[-1].faces = edges[:, :3].astype(int)
                walk(body + 2 + edges.nbytes, start)
            elif kind == _FACE_MATERIAL:
                name, body = text(body)
                objects[-1].material_faces[name] = table(body, "<u2", 1)[:, 0].astype(int)

    try:
        if not data.startswith(b"MM"):
            raise ValueError("no main chunk")
        walk(0, len(data))
    except (struct.error, ValueError, IndexError) as error:
        raise ValueError(f"`{path.name}` must be a whole 3DS file; got {error}.") from error
    return tuple(thing for thing in objects if len(thing.faces))
