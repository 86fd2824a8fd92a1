"""Read buildings and ground from SUMO's polygons (``.poly.xml``, from polyconvert), by OpenStreetMap's tags.

polyconvert's type is a key and a value, such as ``building.yes``, or a name of its type map, such as
``water``, without ``--osm.keep-full-type``. It writes courtyards of multipolygons as buildings: a ring inside
another is a courtyard, and a ring inside a courtyard is a building.
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from glintrack.core.installation import read_data
from glintrack.io.readings import report_reading
from glintrack.scene.objects.geometry import polygons
from glintrack.scene.read.sumo import NetLocation, read_location, read_xml, shape_points

STOREY_M, PLINTH_M = 2.9, 0.4
_MIN_FOOTPRINT_M2 = 8.0
_FOOT_M, _INCH_M = 0.3048, 0.0254
_NUMBER = r"(\d+(?:[.,]\d+)?|[.,]\d+)"
_METRES = re.compile(rf"^~?\s*{_NUMBER}\s*(?:m|m\.|met(?:er|re)s?)?$", re.IGNORECASE)
_FEET = re.compile(
    rf"^~?\s*{_NUMBER}\s*(?:ft\.?|feet|foot|'|′|\u2019)\s*(?:{_NUMBER}\s*(?:\"|''|″|\u201d|in\.?|inch(?:es)?)?)?$",
    re.IGNORECASE,
)
_MAX_HEIGHT_M = 900.0
TOO_SMALL = "smaller than 8 m²"
# names of osmPolyconvert.typ.xml that are one kind of ground
_TYPE_NAMES = {
    "water": "natural.water",
    "forest": "natural.wood",
    "parking": "amenity.parking",
    "park": "leisure.park",
    "farm": "landuse.farmland",
}
_NAME_ONLY = "types without a value: convert with polyconvert --osm.keep-full-type"
# kinds of ground, each with OpenStreetMap's keys and values
_GROUNDS: Mapping[str, Mapping[str, list[str]]] = read_data("traffic", "grounds.toml")
_GONE = ("demolished", "razed", "removed", "destroyed", "collapsed", "proposed", "planned")
_CHUNK = 256  # shapes of one query
_MAX_MEAN_NEAR, _MAX_NEAR = 50, 100_000  # touching boxes per building on average, and in a small file


@dataclass(frozen=True)
class Footprint:
    """A building's outline, and its height if known: to the top of the roof, or of its walls only. [m]"""

    shape: Polygon
    height_m: float | None
    of_walls: bool = False


@dataclass(frozen=True)
class Polygons:
    """Buildings and grounds of a file of polygons.

    Parameters
    ----------
    footprints
        Buildings without their courtyards.
    grounds
        (kind, shape) with kinds ``water``, ``forest``, ``parking``, ``soil``, ``dry``, ``lawn``.
    """

    footprints: tuple[Footprint, ...] = ()
    grounds: tuple[tuple[str, BaseGeometry], ...] = ()


def read_polygons(path: Path, network: NetLocation | None = None) -> Polygons:
    """Read building outlines and grounds.

    Parameters
    ----------
    path
        File of SUMO's polyconvert.
    network
        Location of the target network. Without it the coordinates of the file are returned.

    Raises
    ------
    ValueError
        If the file is damaged or hostile, its coordinates are not numbers, or its projection is not that of
        the network.
    """
    root = read_xml(path)
    if root.tag != "additional":
        raise ValueError(f"`{path.name}` must be SUMO polygons (root element additional); got {root.tag!r}.")
    shift, own = np.zeros(2), read_location(path, root)
    if own is not None and network is not None:
        if own.projection and network.projection and own.projection != network.projection:
            raise ValueError(
                f"`{path.name}` must be of a network in the projection {network.projection!r:.80}; got "
                f"{own.projection!r:.80}. Convert it with SUMO's polyconvert and the network."
            )
        shift = np.subtract(network.offset_m, own.offset_m)
    buildings: list[Footprint] = []
    grounds: list[tuple[str, BaseGeometry]] = []
    gone: Counter[str] = Counter()
    count, tagged = 0, []
    for element in root.iter("poly"):
        tags = {p.get("key", ""): p.get("value", "") for p in element.iter("param")}
        own_type = element.get("type", "")
        is_filled = element.get("fill", "1") in ("1", "true")  # a river may be a line of type water
        key, _, value = (_TYPE_NAMES.get(own_type, own_type) if is_filled else own_type).partition(".")
        tags |= {key: value or "yes"}
        tags |= {"height": element.get("height", "")} if element.get("height") else {}
        kind, reason = area_kind(tags)
        if kind is None and is_filled and key and not value:
            reason = _NAME_ONLY
        if element.get("geo") in ("true", "1"):
            raise ValueError(
                f"`{path.name}` must give polygons in metres; got longitudes and latitudes (geo). Convert "
                "them with SUMO's polyconvert and the network."
            )
        points = shape_points(path, element.get("shape", ""))
        points = points + shift if len(points) else points
        parts = area_parts(shapely.make_valid(Polygon(points)) if len(points) > 3 else Polygon())
        if kind and not reason and not parts:
            reason = TOO_SMALL
        count += bool(kind or reason)
        if reason:
            gone.update([reason])
        elif kind == "building":
            tagged.append(tags)
            buildings += [Footprint(part, *height_of(tags)) for part in parts]
        elif kind is not None:
            grounds += [(kind, part) for part in parts]
    whole, courtyards = _cut_courtyards(buildings, path.name)
    notes = [f"moved by ({shift[0]:.2f}, {shift[1]:.2f}) m into the network's coordinates"] * bool(
        shift.any()
    )
    notes += unread_heights(tagged) + [f"{courtyards} rings inside others are courtyards"] * (courtyards > 0)
    report_reading(path, "buildings and grounds", count, count - gone.total(), gone, notes)
    return Polygons(tuple(whole), tuple(grounds))


def area_parts(shape: BaseGeometry) -> list[Polygon]:
    """Polygons of a shape that are large enough to be drawn."""
    return [part for part in polygons(shape) if part.area > _MIN_FOOTPRINT_M2]


def area_kind(tags: Mapping[str, str]) -> tuple[str | None, str]:
    """Kind of an area by OpenStreetMap's tags, None if it is none, and why it is left out."""
    building = tags.get("building", "no")
    if any(f"{state}:building" in tags for state in _GONE) and building == "no":
        return "building", "demolished or proposed"
    if tags.get("building:part", "no") != "no" and building == "no":
        return "building", "building:part: the outline of its building is used"
    if "building" in tags:
        kind = "building"
    else:
        kind = next(
            (k for k, keys in _GROUNDS.items() if any(tags.get(key) in keys[key] for key in keys)), None
        )
    if kind is None and tags.get("natural") == "coastline":
        return "water", "coastlines: the sea is not drawn"
    if kind is None and tags.get("waterway") in ("river", "canal"):
        return "water", "rivers and canals without an outline"
    if kind is None:
        return None, ""
    if kind == "building" and building == "no":
        return kind, "building=no"
    if building in _GONE or any(tags.get(state, "no") != "no" for state in _GONE):
        return kind, "demolished or proposed"
    layer = _METRES.match(tags.get("layer", "").removeprefix("-"))
    sunk = kind == "building" and tags.get("layer", "").startswith("-") and layer is not None
    hidden = tags.get("location") in ("underground", "underwater") or tags.get("parking") == "underground"
    if sunk or hidden or tags.get("tunnel", "no") not in ("no", "building_passage"):
        return kind, "under ground"
    return kind, ""


def height_of(tags: Mapping[str, str]) -> tuple[float | None, bool]:
    """Height of a building, None if unknown, and whether it is that of its walls only. [m]

    OpenStreetMap's ``height`` includes the roof. ``building:levels``, used without it, does not.
    """
    given = tags.get("height") or tags.get("est_height", "")
    heights = [_length(text.strip()) for text in given.split(";")]
    if None not in heights:
        height = max(filter(None, heights), default=0.0)
        if 0 < height <= _MAX_HEIGHT_M:
            return height, False
    levels = _levels(tags.get("building:levels", ""))
    if levels and 0 < levels * STOREY_M <= _MAX_HEIGHT_M:
        return levels * STOREY_M + PLINTH_M, True
    return None, False


def unread_heights(buildings: Iterable[Mapping[str, str]]) -> list[str]:
    """Sentence on heights and storeys that cannot be read, as a list; empty if there are none."""
    given = [{key: tags[key]} for tags in buildings for key in ("height", "building:levels") if key in tags]
    unread = [text for tag in given if height_of(tag)[0] is None for text in tag.values()]
    return [f"{len(unread)} heights cannot be read, such as {unread[0][:20]!r}"] if unread else []


def _length(text: str) -> float | None:
    """Length in metres, or feet and inches; None if it is neither. [m]"""
    if found := _METRES.match(text):
        return float(found[1].replace(",", "."))
    if found := _FEET.match(text):
        feet, inches = (float((group or "0").replace(",", ".")) for group in found.groups())
        return feet * _FOOT_M + inches * _INCH_M
    return None


def _levels(text: str) -> float | None:
    """Highest of a number, a range, or a list of storeys; None for others.

    A list with 0 counts from the ground floor. A comma is a decimal one before a half or a quarter only.
    """
    decimal = re.fullmatch(r"\d*,(5|25|75)", text.strip())
    words = [text.replace(",", ".")] if decimal else re.split(r"[;,]|(?<=\d)\s*-\s*(?=\d)", text)
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return None
    return max(numbers) + (len(numbers) > 1 and 0 in numbers)


def _cut_courtyards(buildings: list[Footprint], name: str) -> tuple[list[Footprint], int]:
    """Cut rings at odd depth, which are courtyards, out of the buildings; and count them."""
    shapes = np.array([b.shape for b in buildings], dtype=object)
    tree = shapely.STRtree(shapes)
    near = 0
    for k in range(0, len(shapes), _CHUNK):
        near += tree.query(shapes[k : k + _CHUNK]).shape[1]
        if near > _MAX_MEAN_NEAR * len(shapes) + _MAX_NEAR:
            raise ValueError(f"`{name}` must hold buildings side by side; got {len(shapes)} over each other.")
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
