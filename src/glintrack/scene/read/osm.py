"""Read OpenStreetMap extracts: streets by SUMO's netconvert, buildings and grounds by their own outlines.

Areas are closed ways and multipolygons, whose rings may consist of several ways. The tags of an old-style
multipolygon are on its outer ways. SUMO (extra ``traffic``) converts the streets.

References
----------
https://wiki.openstreetmap.org/wiki/Relation:multipolygon
"""

import re
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from xml.etree.ElementTree import Element

import defusedxml.ElementTree
import numpy as np
import pyproj
import shapely
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from glintrack.io.readings import collect_readings, report_reading
from glintrack.io.untrusted import check_file, read_bytes
from glintrack.scene.objects.surfaces import RoadNetwork
from glintrack.scene.read.driving_side import keeps_left
from glintrack.scene.read.polygons import (
    TOO_SMALL,
    Footprint,
    Polygons,
    area_kind,
    area_parts,
    height_of,
    unread_heights,
)
from glintrack.scene.read.sumo import NetLocation, call_sumo, read_sumo_net, read_xml, sumo_home

_NETCONVERT = (
    *("--geometry.remove", "--ramps.guess", "--junctions.join", "--tls.guess-signals"),
    *("--tls.discard-simple", "--tls.join", "--sidewalks.guess", "--crossings.guess"),
    *("--junctions.corner-detail", "5"),
)
_KINDS = {"node": 0, "way": 1, "relation": 2}
_OPEN, _INCOMPLETE = "rings that do not close", "parts of them are not in the file"
_MAX_NAME = 30
_TUNNELS = ("no", "building_passage")  # that are none, or that are seen


@dataclass
class _Way:
    refs: list[str]
    tags: dict[str, str]


@dataclass
class _Extract:
    """Elements of an extract that areas are made of."""

    nodes: dict[str, tuple[float, float]] = field(default_factory=dict)
    ways: dict[str, _Way] = field(default_factory=dict)
    relations: list[tuple[dict[str, str], list[tuple[str, str]]]] = field(default_factory=list)


def read_osm(
    path: Path, net_path: Path, left_hand: bool | None = None
) -> tuple[RoadNetwork, NetLocation, Polygons]:
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
        raise ValueError(f"`{path.name}` must be OpenStreetMap XML (root element osm), got {root.tag!r}")
    if not any(tag.get("k") == "highway" for way in root.iter("way") for tag in way.iter("tag")):
        raise ValueError(f"`{path.name}` must hold at least one way with a highway tag, got none")
    home = sumo_home()
    typemap = home / "data" / "typemap"
    typemaps = [typemap / f"osmNetconvert{kind}.typ.xml" for kind in ("", "UrbanDe")]
    content = _prepare(path, root, {t.get("id", "") for t in read_xml(typemaps[0]).iter("type")})
    extract = _parse(path, root)
    if left_hand is None and extract.nodes:
        left_hand = keeps_left(*np.mean(list(extract.nodes.values()), axis=0).tolist())
    with tempfile.TemporaryDirectory(prefix="glintrack-osm-") as scratch:
        folder = Path(scratch)
        (folder / "m.osm").write_bytes(content)
        netconvert = [str(home / "bin" / "netconvert"), "--osm-files", "m.osm", "-o", "m.net.xml"]
        netconvert += ["--type-files", ",".join(map(str, typemaps)), *_NETCONVERT]
        call_sumo(home, folder, [*netconvert, *(["--lefthand"] if left_hand else [])])
        with collect_readings():  # a file of our own
            network, location = read_sumo_net(folder / "m.net.xml")
        # without its comments, which hold the date: the same extract is the same network, byte for byte
        text = (folder / "m.net.xml").read_text(encoding="utf-8")
        net_path.write_text(re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL), encoding="utf-8")
    return network, location, _areas(path, extract, location)


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
        raise ValueError(f"`{path.name}` must be OpenStreetMap XML, got {other}")


def _tags(element: Element) -> dict[str, str]:
    return {tag.get("k", ""): tag.get("v", "") for tag in element.iter("tag")}


def _prepare(path: Path, root: Element, types: set[str]) -> bytes:
    """Remove ways in tunnels and deleted elements, sort the rest for SUMO, and return the file's text.

    SUMO ignores a node after the ways, and a way after the relations.
    """
    gone: Counter[str] = Counter()
    streets, elements = 0, list(root)
    for element in elements:
        tags = _tags(element) if element.tag == "way" else {}
        value = tags.get("highway")
        streets += value is not None
        deleted = element.get("action") == "delete" or element.get("visible") == "false"
        hidden = tags.get("tunnel", "no") not in _TUNNELS and ("railway" in tags or value is not None)
        if deleted or hidden:
            root.remove(element)
            gone.update(["in a tunnel" if hidden else "deleted"] if value else [])
        elif value and (f"highway.{value}" not in types or value == "construction"):
            gone.update([f"no street for SUMO: highway={value[:_MAX_NAME]}"])
    report_reading(path, "streets", streets, streets - gone.total(), gone)
    found = [_KINDS.get(element.tag, -1) for element in root]
    if found == sorted(found) and len(root) == len(elements):
        return read_bytes(path, path.name)
    root[:] = sorted(root, key=lambda element: _KINDS.get(element.tag, -1))
    return defusedxml.ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)


def _parse(path: Path, root: Element) -> _Extract:
    extract = _Extract()
    try:
        for element in root:
            name = element.get("id", "")
            if element.tag == "node":
                extract.nodes[name] = float(element.get("lon", "")), float(element.get("lat", ""))
            elif element.tag == "way":
                refs = [nd.get("ref", "") for nd in element.iter("nd")]
                extract.ways[name] = _Way(refs, _tags(element))
            elif element.tag == "relation":
                tags = _tags(element)
                members = [m for m in element.iter("member") if m.get("type") == "way"]
                if tags.pop("type", "") == "multipolygon":
                    roles = [(m.get("ref", ""), m.get("role", "")) for m in members]
                    extract.relations.append((tags, roles))
    except ValueError as error:
        raise ValueError(f"`{path.name}` must give each node lon and lat in degrees, got {error}") from error
    return extract


def _areas(path: Path, extract: _Extract, location: NetLocation) -> Polygons:
    """Assemble buildings and grounds of an extract, in the coordinates of its network."""
    places = _project(extract.nodes, location)
    found: list[tuple[str, dict[str, str], BaseGeometry]] = []
    gone: Counter[str] = Counter()
    consumed: set[str] = set()

    def add(tags: dict[str, str], outline: Callable[[], BaseGeometry | str]) -> bool:
        kind, reason = area_kind(tags)
        shape = reason or (outline() if kind else "")
        if not isinstance(shape, str):
            found.append((str(kind), tags, shape))
        elif shape:
            gone.update([shape])
        return bool(reason) or not isinstance(shape, str)

    for tags, members in extract.relations:
        outer = [extract.ways[ref] for ref, role in members if role != "inner" and ref in extract.ways]
        if area_kind(tags) == (None, ""):  # old style
            tags = next((way.tags for way in outer if area_kind(way.tags)[0]), tags)
        if area_kind(tags) == (None, ""):
            continue
        kind, known = area_kind(tags)[0], {ref for ref, _ in members} & extract.ways.keys()
        if add(tags, partial(_multipolygon, extract, places, members)):
            consumed |= {ref for ref in known if area_kind(extract.ways[ref].tags)[0] == kind}
    for ref, way in extract.ways.items():
        if ref not in consumed:
            add(way.tags, partial(_closed_way, way, places))
    footprints: list[Footprint] = []
    grounds: list[tuple[str, BaseGeometry]] = []
    for kind, tags, shape in found:
        parts = area_parts(shape)
        gone.update([] if parts else [TOO_SMALL])
        if kind == "building":
            footprints += [Footprint(part, height_of(tags)) for part in parts]
        else:
            grounds += [(kind, part) for part in parts]
    total = len(found) + gone.total() - gone[TOO_SMALL]
    used = len(found) - gone[TOO_SMALL]
    heights = unread_heights(tags for kind, tags, _ in found if kind == "building")
    report_reading(path, "buildings and grounds", total, used, gone, heights)
    return Polygons(tuple(footprints), tuple(grounds))


def _project(nodes: dict[str, tuple[float, float]], location: NetLocation) -> dict[str, tuple[float, float]]:
    """Project nodes as netconvert did. [m]"""
    if not nodes or location.projection is None:
        return {}
    transformer = pyproj.Transformer.from_crs(4326, location.projection, always_xy=True)
    x, y = transformer.transform(*np.array(list(nodes.values())).T)
    east, north = location.offset_m
    return dict(zip(nodes, zip((x + east).tolist(), (y + north).tolist(), strict=True), strict=True))


def _closed_way(way: _Way, places: dict[str, tuple[float, float]]) -> BaseGeometry | str:
    """Area of a closed way, or the reason why it has none."""
    if len(way.refs) < 4 or way.refs[0] != way.refs[-1]:
        return _OPEN
    if any(ref not in places for ref in way.refs):
        return _INCOMPLETE
    return shapely.make_valid(Polygon([places[ref] for ref in way.refs]))


def _multipolygon(
    extract: _Extract, places: dict[str, tuple[float, float]], members: list[tuple[str, str]]
) -> BaseGeometry | str:
    """Area of a multipolygon, or the reason why it has none.

    Rings of several ways are joined. Rings are added and cut out from the largest to the smallest, so that an
    island in a lake remains.
    """
    rings: list[tuple[Polygon, bool | None]] = []
    for roles, is_inner in ((("outer",), False), (("inner",), True), (("",), None)):
        lines = []
        for ref, role in members:
            way = extract.ways.get(ref)
            if role not in roles and not (role not in ("outer", "inner") and roles == ("",)):
                continue
            if way is None or any(node not in places for node in way.refs):
                return _INCOMPLETE
            if len(way.refs) > 1:
                lines.append(shapely.LineString([places[node] for node in way.refs]))
        polygons, _, dangles, invalid = shapely.polygonize_full(lines)
        if dangles.length + invalid.length > 0:
            return _OPEN
        rings += [(ring, is_inner) for ring in shapely.get_parts(polygons)]
    area: BaseGeometry = Polygon()
    for ring, is_inner in sorted(rings, key=lambda ring: -ring[0].area):
        cut = area.contains(ring.representative_point()) if is_inner is None else is_inner
        ring = shapely.make_valid(Polygon(ring.exterior))
        area = area.difference(ring) if cut else area.union(ring)
    return area
