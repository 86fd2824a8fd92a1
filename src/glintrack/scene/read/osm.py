"""Read OpenStreetMap extracts: streets by SUMO's netconvert (extra ``traffic``), areas by their own outlines.

Areas are closed ways and multipolygons, whose rings may consist of several ways. The tags of an old-style
multipolygon are on its outer ways (https://wiki.openstreetmap.org/wiki/Relation:multipolygon).
"""

import re
import tempfile
from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from xml.etree.ElementTree import Element

import defusedxml.ElementTree
import numpy as np
import pyproj
import shapely
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from glintrack.core.installation import data_file
from glintrack.io.readings import collect_readings, report_reading
from glintrack.io.untrusted import check_file, read_bytes
from glintrack.scene.objects.surfaces import RoadNetwork
from glintrack.scene.read import polygons
from glintrack.scene.read.sumo import NETCONVERT, NetLocation, call_sumo, read_sumo_net, read_xml, sumo_home

_KINDS = {"node": 0, "way": 1, "relation": 2}
_OPEN, _INCOMPLETE = "rings that do not close", "parts of them are not in the file"
_ROLES = {"outer": False, "inner": True}  # others by the rings around
_MAX_NAME = 30
_TUNNELS = ("no", "building_passage")  # that are none, or that are seen


@dataclass
class _Extract:
    """Places of nodes, nodes and tags of ways, and tags and roles of multipolygons."""

    places: dict[str, tuple[float, float]] = field(default_factory=dict)
    ways: dict[str, tuple[list[str], dict[str, str]]] = field(default_factory=dict)
    relations: list[tuple[dict[str, str], list[tuple[str, str]]]] = field(default_factory=list)


def read_osm(
    path: Path, net_path: Path, left_hand: bool | None = None
) -> tuple[RoadNetwork, NetLocation, polygons.Polygons]:
    """Read streets, buildings and grounds of an extract.

    Parameters
    ----------
    path
        ``.osm`` or ``.osm.xml``, plain, or in a gzip or bzip2 archive.
    net_path
        Path for the SUMO network, for the traffic.
    left_hand
        True if traffic keeps left; None for the side of the country.

    Raises
    ------
    ValueError
        If the file is damaged or hostile, of another format, or holds no street for motor vehicles.
    """
    _check_format(path)
    root = read_xml(path)  # SUMO reads half a file without complaint, and follows entities
    if root.tag != "osm":
        raise ValueError(f"`{path.name}` must be OpenStreetMap XML (root element osm); got {root.tag!r}.")
    if not any(tag.get("k") == "highway" for way in root.iter("way") for tag in way.iter("tag")):
        raise ValueError(f"`{path.name}` must hold at least one way with a highway tag; got none.")
    home = sumo_home()
    typemap = home / "data" / "typemap"
    typemaps = [typemap / f"osmNetconvert{kind}.typ.xml" for kind in ("", "UrbanDe")]
    content = _prepare(path, root, {t.get("id", "") for t in read_xml(typemaps[0]).iter("type")})
    extract = _parse(path, root)
    if left_hand is None and extract.places:
        longitude, latitude = np.array(list(extract.places.values()), float).T
        beyond = (longitude - longitude[0] + 180) % 360 - 180  # across the antimeridian too
        middle = (longitude[0] + beyond.mean() + 180) % 360 - 180
        left_hand = keeps_left(float(middle), float(latitude.mean()))
    with tempfile.TemporaryDirectory(prefix="glintrack-osm-") as scratch:
        folder = Path(scratch)
        (folder / "m.osm").write_bytes(content)
        netconvert = [str(home / "bin" / "netconvert"), "--osm-files", "m.osm", "-o", "m.net.xml"]
        netconvert += ["--type-files", ",".join(map(str, typemaps)), *NETCONVERT["osm"]]
        call_sumo(home, folder, [*netconvert, *(["--lefthand"] if left_hand else [])])
        with collect_readings():  # a file of our own
            network, location = read_sumo_net(folder / "m.net.xml")
        # without its comments, which hold the date: the same extract is the same network, byte for byte
        text = (folder / "m.net.xml").read_text(encoding="utf-8")
        net_path.write_text(re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL), encoding="utf-8")
    return network, location, _areas(path, _project(extract, location))


def _check_format(path: Path) -> None:
    """Refuse the formats of OpenStreetMap that are not XML, with the command that converts them."""
    with check_file(path, path.name).open("rb") as file:
        head = file.read(64)
    other = ""
    if b"OSMHeader" in head:
        other = f"PBF (osmium cat {path.name} -o {path.name.partition('.')[0]}.osm)"
    elif head[:4] == b"\xff\xe0\x04\x00" or path.name.endswith(".o5m"):
        other = f"o5m (osmconvert {path.name} -o={path.name.partition('.')[0]}.osm)"
    elif head.lstrip()[:1] == b"{":
        other = "JSON (download it as XML, with Overpass by [out:xml])"
    if other:
        raise ValueError(f"`{path.name}` must be OpenStreetMap XML; got {other}.")


def _tags(element: Element) -> dict[str, str]:
    return {tag.get("k", ""): tag.get("v", "") for tag in element.iter("tag")}


def _prepare(path: Path, root: Element, types: set[str]) -> bytes:
    """Remove ways in tunnels and deleted elements, sort the rest for SUMO, and return the file's text.

    SUMO ignores a node after the ways, and a way after the relations.
    """
    gone: Counter[str] = Counter()
    streets, bridges, elements = 0, 0, list(root)
    for element in elements:
        tags = _tags(element) if element.tag == "way" else {}
        value = tags.get("highway")
        streets += value is not None
        bridges += value is not None and tags.get("bridge", "no") != "no"
        deleted = element.get("action") == "delete" or element.get("visible") == "false"
        hidden = tags.get("tunnel", "no") not in _TUNNELS and ("railway" in tags or value is not None)
        if deleted or hidden:
            root.remove(element)
            gone.update(["in a tunnel" if hidden else "deleted"] if value else [])
        elif value and (f"highway.{value}" not in types or value == "construction"):
            gone.update([f"no street for SUMO: highway={value[:_MAX_NAME]}"])
    notes = [f"{bridges} of them are bridges, which lie on the ground"] if bridges else []
    report_reading(path, "streets", streets, streets - gone.total(), gone, notes)
    found = [_KINDS.get(element.tag, -1) for element in root]
    if found == sorted(found) and len(root) == len(elements):
        return read_bytes(path, path.name)
    root[:] = sorted(root, key=lambda element: _KINDS.get(element.tag, -1))
    return defusedxml.ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)


def _parse(path: Path, root: Element) -> _Extract:
    """Collect nodes in degrees, ways, and multipolygons."""
    extract = _Extract()
    try:
        for element in root:
            name, tags = element.get("id", ""), _tags(element)
            if element.tag == "node":
                extract.places[name] = float(element.get("lon", "")), float(element.get("lat", ""))
            elif element.tag == "way":
                extract.ways[name] = [nd.get("ref", "") for nd in element.iter("nd")], tags
            elif element.tag == "relation" and tags.pop("type", "") == "multipolygon":
                ways = [member for member in element.iter("member") if member.get("type") == "way"]
                extract.relations.append((tags, [(m.get("ref", ""), m.get("role", "")) for m in ways]))
    except ValueError as error:
        raise ValueError(f"`{path.name}` must give each node lon and lat in degrees; got {error}.") from error
    return extract


def _project(extract: _Extract, location: NetLocation) -> _Extract:
    """Project nodes as netconvert did. [m]"""
    transformer = pyproj.Transformer.from_crs(4326, location.projection, always_xy=True)
    x, y = transformer.transform(*np.array(list(extract.places.values())).T)
    places = zip((x + location.offset_m[0]).tolist(), (y + location.offset_m[1]).tolist(), strict=True)
    return replace(extract, places=dict(zip(extract.places, places, strict=True)))


def _areas(path: Path, extract: _Extract) -> polygons.Polygons:
    """Assemble buildings and grounds of an extract with projected places."""
    footprints: list[polygons.Footprint] = []
    grounds: list[tuple[str, BaseGeometry]] = []
    tagged: list[dict[str, str]] = []
    gone: Counter[str] = Counter()
    consumed: set[str] = set()
    used = 0

    def add(tags: dict[str, str], members: list[tuple[str, str]]) -> bool:
        """Add an area; return True if nothing is left to do about its ways."""
        nonlocal used
        kind, reason = polygons.area_kind(tags)
        shape = reason or (_outline(extract, members) if kind else "")
        if kind is None or isinstance(shape, str):
            gone[str(shape)] += bool(shape)
            return bool(reason)
        parts = polygons.area_parts(shape)
        gone.update([] if parts else [polygons.TOO_SMALL])
        used += bool(parts)
        if kind == "building":
            tagged.append(tags)
            footprints.extend(polygons.Footprint(part, *polygons.height_of(tags)) for part in parts)
        else:
            grounds.extend((kind, part) for part in parts)
        return True

    for tags, members in extract.relations:
        ways = {ref: extract.ways[ref][1] for ref, _ in members if ref in extract.ways}
        if polygons.area_kind(tags)[0] is None:  # old style
            outer = [ways[ref] for ref, role in members if role != "inner" and ref in ways]
            tags = next((own for own in outer if polygons.area_kind(own)[0]), tags)
        if add(tags, members):
            kind = polygons.area_kind(tags)[0]
            consumed |= {
                ref
                for ref, role in members
                # an inner way with tags of its own is an area of its own
                if polygons.area_kind(ways.get(ref, {}))[0] == kind
                and (role != "inner" or ways[ref].items() <= tags.items())
            }
    for ref, (_, tags) in extract.ways.items():
        if ref not in consumed:
            add(tags, [(ref, "outer")])
    count = used + gone.total()
    report_reading(path, "buildings and grounds", count, used, gone, polygons.unread_heights(tagged))
    return polygons.Polygons(tuple(footprints), tuple(grounds))


def _outline(extract: _Extract, members: list[tuple[str, str]]) -> BaseGeometry | str:
    """Area of a closed way or a multipolygon, or the reason why it has none.

    Ways of a ring are joined. Rings are added and cut out from the largest to the smallest, so that an island
    in a lake remains.
    """
    rings: list[tuple[BaseGeometry, bool | None]] = []
    for is_inner in (False, True, None):
        lines = []
        for refs in (
            extract.ways.get(ref, ((),))[0] for ref, role in members if _ROLES.get(role) is is_inner
        ):
            if not refs or any(node not in extract.places for node in refs):
                return _INCOMPLETE
            points = [extract.places[node] for node in refs]
            if len(refs) > 3 and refs[0] == refs[-1]:
                rings.append((shapely.make_valid(Polygon(points)), is_inner))
            elif len(refs) > 1:
                lines.append(shapely.LineString(points))
        joined, _, dangles, invalid = shapely.polygonize_full(lines)
        if dangles.length + invalid.length > 0:
            return _OPEN
        rings += [(Polygon(ring.exterior), is_inner) for ring in shapely.get_parts(joined)]
    area: BaseGeometry = Polygon()
    for ring, is_inner in sorted(rings, key=lambda ring: -ring[0].area):
        cut = area.contains(ring.representative_point()) if is_inner is None else is_inner
        area = area.difference(ring) if cut else area.union(ring) if area else ring
    return area if rings else _OPEN


def keeps_left(longitude_deg: float, latitude_deg: float) -> bool:
    """Return True if traffic keeps left at a place, by the country it lies in. [deg]"""
    return bool(shapely.contains_xy(_left_hand_area(), longitude_deg, latitude_deg))


@cache
def _left_hand_area() -> BaseGeometry:
    """Area of left-hand traffic in degrees, of Natural Earth's countries; good to about 3 km."""
    area = shapely.from_geojson(data_file("traffic", "left_hand.geojson").read_text(encoding="utf-8"))
    shapely.prepare(area)
    return area
