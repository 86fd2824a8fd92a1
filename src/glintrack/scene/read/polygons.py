"""Read buildings and ground: SUMO's polygons (``.poly.xml``, from polyconvert) and OpenStreetMap extracts.

A building has a type ``building…``, and its height as the attribute ``height`` or as OpenStreetMap's
``building:levels``. polyconvert writes courtyards of multipolygons as buildings: a ring inside another is a
courtyard, and a ring inside a courtyard is a building. SUMO's netconvert and polyconvert (extra ``traffic``)
convert extracts.
"""

import re
import tempfile
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import defusedxml.ElementTree
import numpy as np
import shapely
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from glintrack.io.untrusted import read_bytes
from glintrack.scene.objects.geometry import polygons
from glintrack.scene.objects.surfaces import RoadNetwork
from glintrack.scene.read.sumo import NetLocation, call_sumo, read_sumo_net, read_xml, shape_points, sumo_home

STOREY_M, PLINTH_M = 2.9, 0.4
_MIN_FOOTPRINT_M2 = 8.0
_FOOT_M = 0.3048
_HEIGHT = re.compile(r"^\s*(\d+(?:\.\d+)?)\s*(m|ft|')?\s*$")
_MAX_HEIGHT_M = 900.0
# kind of ground, and words in a polygon's type; the first match counts
_GROUNDS = (
    ("water", ("natural.water", "waterway", "landuse.basin", "landuse.reservoir", "swimming_pool")),
    ("forest", ("landuse.forest", "natural.wood")),
    ("parking", ("amenity.parking",)),
    ("soil", ("natural.sand", "natural.beach", "landuse.farmland", "landuse.construction", "landuse.quarry")),
    ("dry", ("natural.scrub", "natural.heath", "landuse.meadow", "landuse.brownfield")),
    ("lawn", tuple(f"leisure.{name}" for name in ("park", "garden", "pitch"))),
    ("lawn", tuple(f"landuse.{name}" for name in ("grass", "cemetery", "village"))),
)
_CHUNK = 256  # shapes of one query
_MAX_MEAN_NEAR, _MAX_NEAR = 50, 100_000  # touching boxes per building on average, and in a small file
_NOT_GROUND = ("bicycle_parking", "parking_entrance", "parking_space")


@dataclass(frozen=True)
class Footprint:
    """A building's outline, and its height if known. [m]"""

    shape: Polygon
    height_m: float | None


@dataclass(frozen=True)
class Polygons:
    """Buildings and grounds of a file of polygons.

    Parameters
    ----------
    footprints
        Buildings without their courtyards.
    grounds
        (kind, shape) with kinds ``water``, ``forest``, ``parking``, ``soil``, ``dry``, ``lawn``.
    courtyards
        Number of courtyards.
    """

    footprints: tuple[Footprint, ...] = ()
    grounds: tuple[tuple[str, BaseGeometry], ...] = ()
    courtyards: int = 0


def read_polygons(path: Path) -> Polygons:
    """Read building outlines and grounds, in the file's own coordinates.

    Raises
    ------
    ValueError
        If the file is damaged or hostile, or its coordinates are not numbers.
    """
    root = read_xml(path)
    if root.tag != "additional":
        raise ValueError(f"`{path.name}` must be SUMO polygons (root element additional), got {root.tag!r}")
    buildings: list[Footprint] = []
    grounds: list[tuple[str, BaseGeometry]] = []
    for element in root.iter("poly"):
        name = element.get("type", "")
        kinds = (kind for kind, words in _GROUNDS if any(word in name for word in words))
        kind = "building" if name.startswith("building") else next(kinds, None)
        points = shape_points(path, element.get("shape", ""))
        shape = shapely.make_valid(Polygon(points)) if len(points) > 3 else Polygon()
        parts = [p for p in polygons(shape) if p.area > _MIN_FOOTPRINT_M2]
        if kind == "building":
            buildings += [Footprint(part, _height(element)) for part in parts]
        elif kind is not None and not any(word in name for word in _NOT_GROUND):
            grounds += [(kind, part) for part in parts]
    whole, courtyards = _cut_courtyards(buildings, path.name)
    return Polygons(tuple(whole), tuple(grounds), courtyards)


def _height(element: Element) -> float | None:
    """Height of a building, by its own tag, else by its storeys; None if neither can be read. [m]"""
    tags = {p.get("key", ""): p.get("value", "") for p in element.iter("param")}
    given = _HEIGHT.match(element.get("height") or tags.get("height", ""))
    if given:
        height = float(given[1]) * (_FOOT_M if given[2] in ("ft", "'") else 1.0)
        return height if 0 < height <= _MAX_HEIGHT_M else None
    levels = _HEIGHT.match(tags.get("building:levels", ""))
    if levels and 0 < float(levels[1]) * STOREY_M <= _MAX_HEIGHT_M:
        return float(levels[1]) * STOREY_M + PLINTH_M
    return None


def _cut_courtyards(buildings: list[Footprint], name: str) -> tuple[list[Footprint], int]:
    """Cut rings at odd depth, which are courtyards, out of the buildings; and count them."""
    shapes = np.array([b.shape for b in buildings], dtype=object)
    tree = shapely.STRtree(shapes)
    near = 0
    for k in range(0, len(shapes), _CHUNK):
        near += tree.query(shapes[k : k + _CHUNK]).shape[1]
        if near > _MAX_MEAN_NEAR * len(shapes) + _MAX_NEAR:
            raise ValueError(f"`{name}` must hold buildings side by side, got {len(shapes)} over each other")
    inside, outside = tree.query(shapes, predicate="within")
    true = (inside != outside) & (shapely.area(shapes[inside]) < shapely.area(shapes[outside]))
    depth = np.bincount(inside[true], minlength=len(shapes))
    within: dict[int, list[Polygon]] = {}
    for i, o in zip(inside[true].tolist(), outside[true].tolist(), strict=True):
        if depth[i] % 2:
            within.setdefault(o, []).append(buildings[i].shape)
    found = []
    for k in np.flatnonzero(depth % 2 == 0).tolist():
        shape = shapes[k].difference(shapely.union_all(within[k])) if k in within else shapes[k]
        found += [Footprint(part, buildings[k].height_m) for part in polygons(shape)]
    return found, int((depth % 2 == 1).sum())


_NETCONVERT = (
    *("--geometry.remove", "--ramps.guess", "--junctions.join", "--tls.guess-signals"),
    *("--tls.discard-simple", "--tls.join", "--sidewalks.guess", "--crossings.guess"),
    *("--junctions.corner-detail", "5"),
)


def read_osm(path: Path, net_path: Path) -> tuple[RoadNetwork, NetLocation, Polygons]:
    """Read streets, buildings and grounds of an extract.

    Parameters
    ----------
    path
        ``.osm`` or ``.osm.xml``, plain or gzipped.
    net_path
        Path for the SUMO network, for the traffic.

    Raises
    ------
    ValueError
        If the file is damaged or hostile, or holds no street for motor vehicles.
    """
    root = read_xml(path)  # SUMO reads half a file without complaint, and follows entities
    if root.tag != "osm":
        raise ValueError(f"`{path.name}` must be OpenStreetMap XML (root element osm), got {root.tag!r}")
    if not any(tag.get("k") == "highway" for way in root.iter("way") for tag in way.iter("tag")):
        raise ValueError(f"`{path.name}` must hold at least one way with a highway tag, got none")
    home = sumo_home()
    typemap = home / "data" / "typemap"
    types = ",".join(str(typemap / f"osmNetconvert{kind}.typ.xml") for kind in ("", "UrbanDe"))
    with tempfile.TemporaryDirectory(prefix="glintrack-osm-") as scratch:
        folder = Path(scratch)
        (folder / "m.osm").write_bytes(_sort_elements(root) or read_bytes(path, path.name))
        netconvert = [str(home / "bin" / "netconvert"), "--osm-files", "m.osm", "-o", "m.net.xml"]
        call_sumo(home, folder, [*netconvert, "--type-files", types, *_NETCONVERT])
        polyconvert = [str(home / "bin" / "polyconvert"), "-n", "m.net.xml", "--osm-files", "m.osm"]
        polyconvert += ["--type-file", str(typemap / "osmPolyconvert.typ.xml"), "--osm.keep-full-type"]
        call_sumo(home, folder, [*polyconvert, "--all-attributes", "-o", "m.poly.xml"])
        network, location = read_sumo_net(folder / "m.net.xml")
        found = read_polygons(folder / "m.poly.xml")
        # without its comments, which hold the date: the same extract is the same network, byte for byte
        text = (folder / "m.net.xml").read_text(encoding="utf-8")
        net_path.write_text(re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL), encoding="utf-8")
    return network, location, found


def _sort_elements(root: Element) -> bytes | None:
    """Sort nodes before ways before relations, because SUMO ignores others; None if they are in order."""
    kinds = {"node": 0, "way": 1, "relation": 2}
    found = [kinds.get(element.tag, -1) for element in root]
    if found == sorted(found):
        return None
    root[:] = sorted(root, key=lambda element: kinds.get(element.tag, -1))
    return defusedxml.ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
