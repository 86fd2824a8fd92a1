"""Braunschweig: a real road network with real building outlines, from the installed SUMO wheel.

The network and the 3DS model of the buildings lie in ``sumo/tools/game/bs3d`` and derive from OpenStreetMap
(ODbL); they are read from there and not copied. Real are streets, lanes, rails and footprints. By rule,
because the data do not have it: heights (the model's 7.5 m stands for "unknown": drawn then by footprint
area), roofs (gable or hip on nearly rectangular footprints under 650 m², mansard on other small ones, flat on
the rest), walls, windows, gardens, trees and parked vehicles. The traffic is SUMO's, on signals rebuilt by
netconvert, since the bundled game signals gridlock the network.
"""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from jaxtyping import Float, Int
from shapely.geometry import Polygon
from shapely.ops import unary_union

from glintrack.core.arrays import Array
from glintrack.core.installation import install_line
from glintrack.scene.objects.geometry import polygons
from glintrack.scene.objects.layout import MARGIN_M, Layout, covered_area
from glintrack.scene.objects.surfaces import RoadNetwork, blocks, road_areas
from glintrack.scene.read.sumo import SumoRun, recorded, sumo_home
from glintrack.scene.sources.lots import building_by_rule, garden_trees, parked_on_pavements, yards
from glintrack.scene.traffic import Recording

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
    duration_s
        Length of the recording. [s]
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


_MAIN, _EDITOR, _OBJECT, _TRIMESH = 0x4D4D, 0x3D3D, 0x4000, 0x4100
_VERTICES, _FACES, _FACE_MATERIAL = 0x4110, 0x4120, 0x4130
_HEADER_BYTES = 6


@dataclass(frozen=True)
class Object3ds:
    """One object of the file.

    Parameters
    ----------
    name
        As stored.
    vertices
        In the file's own axes and unit.
    faces
        Vertex indices.
    material_faces
        Indices into ``faces`` by material name.
    """

    name: str
    vertices: Float[Array, "vertex 3"]
    faces: Int[Array, "face 3"]
    material_faces: dict[str, Int[Array, "face"]]


def read_3ds(path: Path) -> tuple[Object3ds, ...]:
    """Objects of a 3DS file that have faces.

    Raises
    ------
    ValueError
        If a chunk or an array reaches beyond its end, or a face names a vertex that is not there.
    """
    data = path.read_bytes()
    if len(data) < _HEADER_BYTES or struct.unpack_from("<H", data)[0] != _MAIN:
        raise ValueError(f"`{path.name}` must start with a 3DS main chunk, got {data[:2].hex() or 'nothing'}")
    objects = []
    for main, start, stop in _chunks(path, data, 0, len(data)):
        if main != _MAIN:
            continue
        for editor, a, b in _chunks(path, data, start, stop):
            if editor != _EDITOR:
                continue
            objects += [
                _object(path, data, c, d) for kind, c, d in _chunks(path, data, a, b) if kind == _OBJECT
            ]
    return tuple(o for o in objects if len(o.faces))


def _chunks(path: Path, data: bytes, start: int, stop: int) -> list[tuple[int, int, int]]:
    """(kind, first byte, one past the last byte) of the chunks between two places."""
    found = []
    while start + _HEADER_BYTES <= stop:
        kind, length = struct.unpack_from("<HI", data, start)
        if length < _HEADER_BYTES or start + length > stop:
            raise ValueError(
                f"`{path.name}` must hold whole chunks, got one of {length} bytes with {stop - start} left"
            )
        found.append((kind, start + _HEADER_BYTES, start + length))
        start += length
    return found


def _name(path: Path, data: bytes, start: int, stop: int) -> tuple[str, int]:
    end = data.find(b"\0", start, stop)
    if end < 0:
        raise ValueError(f"`{path.name}` must end its names with a zero byte, got none")
    return data[start:end].decode("latin-1"), end + 1


def _array(path: Path, data: bytes, start: int, stop: int, dtype: str, width: int) -> tuple[Array, int]:
    """A counted array at a place, and the place behind it."""
    if start + 2 > stop:
        raise ValueError(f"`{path.name}` must give a count before an array, got {stop - start} bytes")
    (count,) = struct.unpack_from("<H", data, start)
    end = start + 2 + count * width * np.dtype(dtype).itemsize
    if end > stop:
        raise ValueError(f"`{path.name}` must hold {count} entries of an array, got {stop - start - 2} bytes")
    values = np.frombuffer(data, dtype, count * width, start + 2).reshape(count, width)
    return values, end


def _object(path: Path, data: bytes, start: int, stop: int) -> Object3ds:
    name, start = _name(path, data, start, stop)
    vertices, faces = np.zeros((0, 3)), np.zeros((0, 3), dtype=int)
    materials: dict[str, Array] = {}
    for mesh, a, b in _chunks(path, data, start, stop):
        if mesh != _TRIMESH:
            continue
        for kind, c, d in _chunks(path, data, a, b):
            if kind == _VERTICES:
                vertices = _array(path, data, c, d, "<f4", 3)[0].astype(float)
            elif kind == _FACES:
                table, behind = _array(path, data, c, d, "<u2", 4)  # the fourth number is edge flags
                faces = table[:, :3].astype(int)
                for part, e, f in _chunks(path, data, behind, d):
                    if part == _FACE_MATERIAL:
                        material, e = _name(path, data, e, f)
                        materials[material] = _array(path, data, e, f, "<u2", 1)[0][:, 0].astype(int)
    if len(faces) and faces.max() >= len(vertices):
        raise ValueError(f"`{path.name}` must name one of {len(vertices)} vertices, got {faces.max()}")
    if any(len(m) and m.max() >= len(faces) for m in materials.values()):
        raise ValueError(f"`{path.name}` must give materials to its {len(faces)} faces, got one beyond")
    return Object3ds(name, vertices, faces, materials)
