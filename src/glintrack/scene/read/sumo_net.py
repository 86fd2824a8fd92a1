"""Reader of SUMO's network files (``.net.xml``, plain or gzipped)."""

import math
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError

import defusedxml.ElementTree
import numpy as np
from defusedxml import DefusedXmlException
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.io.untrusted import FARTHEST_M, read_bytes
from glintrack.scene.objects.surfaces import Lane, LaneKind, RoadNetwork

_LONGEST_PHASE_S = 600.0
_WIDEST_M = 100.0  # of a lane; walking areas are outlines
DEFAULT_LANE_WIDTH_M = 3.2  # SUMO's own default
_MOTOR = frozenset({"passenger", "delivery", "bus", "taxi", "private", "truck", "coach"})
_RAIL = frozenset({"tram", "rail", "rail_urban", "rail_electric", "rail_fast", "subway", "cable_car"})


@dataclass(frozen=True)
class NetLocation:
    """Where a network lies.

    Parameters
    ----------
    offset_m
        Coordinates in the projection are the network's minus this. [m]
    projection
        PROJ string or None where the network has none.
    """

    offset_m: tuple[float, float] = (0.0, 0.0)
    projection: str | None = None


def read_sumo_net(path: Path) -> tuple[RoadNetwork, NetLocation]:
    """Read lanes, crossings and junction areas.

    Parameters
    ----------
    path
        ``.net.xml`` or ``.net.xml.gz`` of SUMO's netconvert.

    Returns
    -------
    The network in the file's own coordinates [m], and where that is.

    Raises
    ------
    ValueError
        If the file is no SUMO network, is hostile XML, or has no lanes.
    """
    root = read_xml(path)
    if root.tag != "net":
        raise ValueError(f"`{path.name}` must be a SUMO network (root element net), got {root.tag!r}")
    signalled = {c.get("from") for c in root.iter("connection") if c.get("tl")}
    lanes = tuple(
        lane for edge in root.iter("edge") for lane in _lanes(path, edge, edge.get("id") in signalled)
    )
    if not lanes:
        raise ValueError(f"`{path.name}` must hold at least one lane with a shape, got none")
    motor_lanes = {
        lane.get("id") for edge in root.iter("edge") for lane in edge if _kind(edge, lane) == "car"
    }
    junctions = tuple(
        shape_points(path, junction.get("shape", ""))
        for junction in root.iter("junction")
        if junction.get("type") != "internal"
        and len(junction.get("shape", "").split()) > 2
        and motor_lanes.intersection(junction.get("incLanes", "").split())
    )
    return RoadNetwork(lanes, junctions), _location(path, root)


def standing_signals(path: Path) -> int:
    """How many signal programs of a network hold one phase for over ten minutes, as if switched by hand."""
    root = read_xml(path)
    phases = (
        [_number(path, p, "duration", 0.0) for p in logic.iter("phase")] for logic in root.iter("tlLogic")
    )
    return sum(len(durations) > 1 and max(durations) > _LONGEST_PHASE_S for durations in phases)


def read_xml(path: Path) -> Element:
    """Root of an XML file, plain or gzipped; entity definitions and broken files are refused."""
    content = read_bytes(path, path.name)
    try:
        return defusedxml.ElementTree.fromstring(content, forbid_dtd=True)
    except DefusedXmlException as error:
        raise ValueError(
            f"`{path.name}` must be plain XML without DTD or entities, got {type(error).__name__}"
        ) from error
    except (ParseError, ValueError, LookupError) as error:  # the last two: of its declared encoding
        raise ValueError(f"`{path.name}` must be whole, well-formed XML, got {error}") from error


def _location(path: Path, root: Element) -> NetLocation:
    location = root.find("location")
    if location is None:
        return NetLocation()
    offsets = shape_points(path, location.get("netOffset", "0,0"))
    if len(offsets) != 1:
        raise ValueError(f"`{path.name}` must give one netOffset, got {location.get('netOffset')!r:.60}")
    offset = offsets[0]
    projection = location.get("projParameter", "!").strip()
    return NetLocation(
        (float(offset[0]), float(offset[1])), projection if projection not in ("!", "-", ".", "") else None
    )


def _lanes(path: Path, edge: Element, signalled: bool) -> list[Lane]:
    lanes = []
    for element in edge.iter("lane"):
        kind = _kind(edge, element)
        points = shape_points(path, element.get("shape", ""))
        if kind is None or len(points) < (3 if kind == "walking_area" else 2):
            continue
        width_m = _number(path, element, "width", DEFAULT_LANE_WIDTH_M)
        if not 0 < width_m <= _WIDEST_M:
            raise ValueError(
                f"`{path.name}` must give lanes a width of 0 to {_WIDEST_M:g} m, got {width_m:g} for lane "
                f"{element.get('id', '')!r}"
            )
        lanes.append(
            Lane(
                edge_id=edge.get("id", ""),
                index=round(_number(path, element, "index", 0)),
                kind=kind,
                points=points,
                width_m=width_m,
                signalled=signalled and kind == "car",
                street_type=edge.get("type", ""),
            )
        )
    return lanes


def _number(path: Path, element: Element, name: str, default: float) -> float:
    text = element.get(name)
    try:
        value = default if text is None else float(text)
        if not math.isfinite(value):
            raise ValueError(text)
    except ValueError as error:
        raise ValueError(
            f"`{path.name}` must give {name} of a {element.tag} as a finite number, got {text!r:.60}"
        ) from error
    return value


def _kind(edge: Element, lane: Element) -> LaneKind | None:
    allow, disallow = set(lane.get("allow", "").split()), set(lane.get("disallow", "").split())
    motor = bool(allow & _MOTOR) if allow else not disallow & {"all", "passenger"}
    match edge.get("function", "normal"):
        case "internal":
            return "internal" if motor else None
        case "crossing":
            return "crossing"
        case "walkingarea":
            return "walking_area"
    if "all" in disallow:
        return "parking"
    if allow and allow <= _RAIL:
        return "rail"
    return "car" if motor else "walk"


def shape_points(path: Path, shape: str) -> Float[Array, "point 2"]:
    """Plan points of a ``shape`` attribute, ``x,y x,y …``. [m]."""
    try:
        points = np.array([[float(v) for v in p.split(",")[:2]] for p in shape.split()]).reshape(-1, 2)
    except ValueError as error:
        raise ValueError(f"`{path.name}` must give shapes as 'x,y x,y …', got {shape[:40]!r}") from error
    if not (np.abs(points) <= FARTHEST_M).all():
        raise ValueError(
            f"`{path.name}` must give coordinates in metres within ±{FARTHEST_M:g}, got {shape[:40]!r}"
        )
    return points
