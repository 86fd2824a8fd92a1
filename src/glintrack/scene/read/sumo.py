"""Read SUMO's networks, and run SUMO's programs with the result in the user's cache.

The installed ``eclipse-sumo`` wheel (extra ``traffic``) has netconvert, randomTrips and sumo; nothing of it
is copied into glintrack.
"""

import importlib.metadata
import importlib.util
import math
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError

import defusedxml.ElementTree
import numpy as np
from defusedxml import DefusedXmlException
from jaxtyping import Float
from pydantic import TypeAdapter

from glintrack.core.arrays import Array
from glintrack.core.installation import MissingExtraError, missing_extra, read_data
from glintrack.core.progress import step
from glintrack.io import cache
from glintrack.io.atomic import content_hash
from glintrack.io.readings import collect_readings, report_reading
from glintrack.io.untrusted import MAX_COORDINATE_M, read_bytes
from glintrack.scene.objects.surfaces import Lane, LaneKind, RoadNetwork
from glintrack.scene.read.fcd import read_fcd
from glintrack.scene.traffic import FORMAT, Recording, read_recording, write_recording
from glintrack.scene.vehicles import load_vehicles

_MAX_PHASE_S = 600.0
_MIN_MOTORWAY_SPEED_M_S = 25.0  # of an edge without a type: more than 90 km/h
_MIN_HEIGHT_RANGE_M = 0.5  # below which a network is flat
_MAX_LANE_WIDTH_M = 100.0  # walking areas are outlines
_MOTOR = frozenset({"passenger", "delivery", "bus", "taxi", "private", "truck", "coach"})
_ON_FOOT = frozenset({"pedestrian", "wheelchair", "bicycle", "scooter"})
_NO_ROAD = frozenset({"ship", "container", "drone", "aircraft"})
_RAIL = frozenset({"tram", "rail", "rail_urban", "rail_electric", "rail_fast", "subway", "cable_car"})


@dataclass(frozen=True)
class NetLocation:
    """Position of a network.

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
        raise ValueError(f"`{path.name}` must be a SUMO network (root element net); got {root.tag!r}.")
    signalled = {c.get("from") for c in root.iter("connection") if c.get("tl")}
    edges = list(root.iter("edge"))
    kinds = {edge.get("id"): edge.get("type", "") for edge in edges}
    for link in root.iter("connection"):  # a lane within a junction is of the street that leads there
        inner = link.get("via", "").rpartition("_")[0]
        kinds[inner] = kinds.get(inner) or kinds.get(link.get("from"), "")
    lanes = tuple(
        lane
        for edge in edges
        for lane in _lanes(path, edge, edge.get("id") in signalled, kinds[edge.get("id")])
    )
    if not lanes:
        raise ValueError(f"`{path.name}` must hold at least one lane with a shape; got none.")
    count = sum(1 for edge in edges for _ in edge.iter("lane"))
    gone = {"no road, rail, pavement or crossing": count - len(lanes)}
    report_reading(path, "lanes", count, len(lanes), gone, _height_notes(path, edges))
    motor_lanes = {lane.get("id") for edge in edges for lane in edge if _kind(edge, lane) == "car"}
    junctions = tuple(
        shape_points(path, junction.get("shape", ""))
        for junction in root.iter("junction")
        if junction.get("type") != "internal"
        and len(junction.get("shape", "").split()) > 2
        and motor_lanes.intersection(junction.get("incLanes", "").split())
    )
    network = RoadNetwork(lanes, junctions, root.get("lefthand", "false").lower() in ("true", "1"))
    return network, read_location(path, root) or NetLocation()


def read_location(path: Path, root: Element) -> NetLocation | None:
    """Read the position of a network, or of what was converted with one; None without it."""
    location = root.find("location")
    if location is None:
        return None
    offsets = shape_points(path, location.get("netOffset", "0,0"))
    if len(offsets) != 1:
        raise ValueError(f"`{path.name}` must give one netOffset; got {location.get('netOffset')!r:.60}.")
    east, north = offsets[0].tolist()
    projection = location.get("projParameter", "!").strip()
    known = projection if projection not in ("!", "-", ".", "") else None
    return NetLocation((east, north), known)


def count_standing_signals(path: Path) -> int:
    """Count the signal programs of a network with a phase of over ten minutes, as if switched by hand."""
    programs = read_xml(path).iter("tlLogic")
    phases = ([_number(path, p, "duration", 0.0) for p in program.iter("phase")] for program in programs)
    return sum(len(durations) > 1 and max(durations) > _MAX_PHASE_S for durations in phases)


def read_xml(path: Path) -> Element:
    """Read an XML file, plain or gzipped, and refuse entity definitions and broken files."""
    content = read_bytes(path, path.name)
    try:
        return defusedxml.ElementTree.fromstring(content, forbid_dtd=True)
    except DefusedXmlException as error:
        raise ValueError(
            f"`{path.name}` must be plain XML without DTD or entities; got {type(error).__name__}."
        ) from error
    except (ParseError, ValueError, LookupError) as error:  # the last two: of its declared encoding
        raise ValueError(f"`{path.name}` must be whole, well-formed XML; got {error}.") from error


def _lanes(path: Path, edge: Element, signalled: bool, street_type: str) -> list[Lane]:
    lanes = []
    for element in edge.iter("lane"):
        kind = _kind(edge, element)
        points = shape_points(path, element.get("shape", ""))
        if kind is None or len(points) < (3 if kind == "walking_area" else 2):
            continue
        width_m = _number(path, element, "width", 3.2)  # SUMO's own default
        if not 0 < width_m <= _MAX_LANE_WIDTH_M:
            raise ValueError(
                f"`{path.name}` must give lanes a width of 0 to {_MAX_LANE_WIDTH_M:g} m; got {width_m:g} for "
                f"lane {element.get('id', '')!r}."
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
                is_motorway=_is_motorway(path, street_type, element),
            )
        )
    return lanes


def _height_notes(path: Path, edges: list[Element]) -> list[str]:
    """Phrase on the heights of lanes, which are not used; none if the network is flat."""
    points = (p for edge in edges for lane in edge.iter("lane") for p in lane.get("shape", "").split())
    texts = [text for point in points for text in point.split(",")[2:3]]
    try:
        heights = np.array(texts, float)
    except ValueError as error:
        raise ValueError(f"`{path.name}` must give heights of lanes as numbers; got {error}.") from error
    if not len(heights) or not np.ptp(heights) >= _MIN_HEIGHT_RANGE_M:
        return []
    span = f"{heights.min():.0f} to {heights.max():.0f} m"
    return [f"heights of {span} are not used: bridges and ramps lie on the ground"]


def _number(path: Path, element: Element, name: str, default: float) -> float:
    text = element.get(name)
    try:
        value = default if text is None else float(text)
        if not math.isfinite(value):
            raise ValueError(text)
    except ValueError as error:
        raise ValueError(
            f"`{path.name}` must give {name} of a {element.tag} as a finite number; got {text!r:.60}."
        ) from error
    return value


def _is_motorway(path: Path, street_type: str, lane: Element) -> bool:
    """Return True for a motorway or its ramp by its type, or without a type by its speed limit."""
    if street_type:
        return "motorway" in street_type
    return _number(path, lane, "speed", 0.0) >= _MIN_MOTORWAY_SPEED_M_S


def _kind(edge: Element, lane: Element) -> LaneKind | None:
    allow, disallow = set(lane.get("allow", "").split()), set(lane.get("disallow", "").split())
    if "all" in allow:
        allow = set()
    motor = bool(allow - _ON_FOOT - _RAIL - _NO_ROAD) if allow else bool(_MOTOR - disallow)
    motor = motor and "all" not in disallow
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
    if allow and allow <= _NO_ROAD:
        return None
    return "car" if motor else "walk"


def shape_points(path: Path, shape: str) -> Float[Array, "point 2"]:
    """Plan points of a ``shape`` attribute, ``x,y x,y …``. [m]"""
    try:
        points = np.array([[float(v) for v in p.split(",")[:2]] for p in shape.split()]).reshape(-1, 2)
    except ValueError as error:
        raise ValueError(f"`{path.name}` must give shapes as 'x,y x,y …'; got {shape[:40]!r}.") from error
    if not (np.abs(points) <= MAX_COORDINATE_M).all():
        raise ValueError(
            f"`{path.name}` must give coordinates in metres within ±{MAX_COORDINATE_M:g}; got {shape[:40]!r}."
        )
    return points


_DEBIAN_PACKAGES = "libx11-6 libxext6 libxrender1 libgl1 libexpat1 libatomic1"
# model, vClass and share in the traffic
Mix = tuple[tuple[str, str, float], ...]
TRIPS_SEED = 41  # plus the scene's seed
_SEEDS = 2**31  # of SUMO
_DATA = read_data("traffic", "sumo.toml")
FIRST_MIX, FULL_MIX = (TypeAdapter(Mix).validate_python(mix) for mix in _DATA["mixes"].values())
NETCONVERT: Mapping[str, tuple[str, ...]] = {k: tuple(v.split()) for k, v in _DATA["netconvert"].items()}


@dataclass(frozen=True)
class SumoRun:
    """One traffic simulation, from network files to floating-car data.

    Parameters
    ----------
    inputs
        Files for netconvert, copied into a scratch folder under their own names.
    netconvert
        Arguments of netconvert without the output.
    extent_m
        West, south, east, north of the recorded traffic in network coordinates. [m]
    origin_m
        Network coordinates that become (0, 0). [m]
    duration_s
        Length of the recording. [s]
    insertion_period_s
        Interval between departures. [s]
    seed
        Seed of the trips.
    warmup_s
        SUMO time before the recording starts. [s]
    mix
        Model, vClass and share of the vehicles.
    """

    inputs: tuple[Path, ...]
    netconvert: tuple[str, ...]
    extent_m: tuple[float, float, float, float]
    origin_m: tuple[float, float]
    duration_s: float
    insertion_period_s: float
    seed: int
    warmup_s: float = 300.0  # after which the traffic in a window of the default size is steady
    mix: Mix = FIRST_MIX


def sumo_home() -> Path:
    """Folder of the installed ``sumo`` package.

    Raises
    ------
    MissingExtraError
        If the extra ``traffic`` is not installed.
    """
    spec = importlib.util.find_spec("sumo")
    if spec is None or not spec.submodule_search_locations:
        raise MissingExtraError(missing_extra("sumo", "traffic", "run SUMO"))
    return Path(next(iter(spec.submodule_search_locations)))


def load_or_simulate(run: SumoRun) -> Recording:
    """Load the recording of a run from the cache, or simulate and cache it.

    The file's name has the content hash of the run and the digest of the file; a file that does not match its
    name is rebuilt.
    """
    try:
        version = importlib.metadata.version("eclipse-sumo")
    except importlib.metadata.PackageNotFoundError:
        version = "unknown"
    settings = {name: value for name, value in vars(run).items() if name != "inputs"}
    said = repr((FORMAT, version, vehicle_types_xml(run.mix), sorted(settings.items())))
    key = content_hash([*(path.read_bytes() for path in run.inputs), said], 24)
    folder = cache.cache_folder("traffic")
    if path := cache.find(key, ".nc", folder):
        return read_recording(path)
    with tempfile.TemporaryDirectory(prefix="glintrack-traffic-") as scratch:
        fresh = Path(scratch) / "recording.nc"
        attributes = {"title": "glintrack traffic cache", "source": "Eclipse SUMO"}
        with step("running SUMO"):
            write_recording(fresh, simulate_traffic(run), attributes)
        cache.store(key, ".nc", folder, fresh.read_bytes())
        return read_recording(fresh)  # rounded to millimetres, as in later runs


def simulate_traffic(run: SumoRun) -> Recording:
    """Build the network, draw trips, run SUMO and read its output, in ENU about ``run.origin_m``."""
    home, seed = sumo_home(), run.seed % _SEEDS
    end_s = run.warmup_s + run.duration_s
    with tempfile.TemporaryDirectory(prefix="glintrack-sumo-") as scratch:
        folder = Path(scratch)
        for path in run.inputs:
            shutil.copyfile(path, folder / path.name)
        (folder / "vtypes.add.xml").write_text(vehicle_types_xml(run.mix), encoding="utf-8")
        call_sumo(home, folder, [str(home / "bin" / "netconvert"), *run.netconvert, "-o", "city.net.xml"])
        trips = (
            f"-n city.net.xml -o trips.xml -r routes.xml -b 0 -e {end_s:g} -p {run.insertion_period_s:g} "
            f"--fringe-factor 5 --min-distance 200 --seed {seed} --edge-permission passenger --validate "
            "--additional-files vtypes.add.xml --trip-attributes"
        )
        attributes = 'type="mix" departLane="best" departSpeed="max"'
        random_trips = str(home / "tools" / "randomTrips.py")
        call_sumo(home, folder, [sys.executable, random_trips, *trips.split(), attributes])
        sumo = (
            f"-n city.net.xml -r routes.xml --end {end_s + 0.1:g} --step-length 0.1 --precision 3 "
            "--lanechange.duration 2.5 --time-to-teleport 300 --fcd-output fcd.csv --device.fcd.period 0.1 "
            f"--device.fcd.begin {run.warmup_s:g} --no-step-log --seed {seed}"
        )
        call_sumo(home, folder, [str(home / "bin" / "sumo"), *sumo.split()])
        with collect_readings():  # files of our own
            network, _ = read_sumo_net(folder / "city.net.xml")
        with (folder / "fcd.csv").open(encoding="utf-8") as rows:
            if "vehicle_id" not in rows.readline():  # SUMO writes no header without a vehicle
                raise ValueError(
                    "`scene.traffic_insertion_period_s` must let a vehicle drive while traffic is recorded; "
                    f"got none in {run.duration_s:g} s by {run.insertion_period_s:g} s. Choose less."
                )
        with collect_readings():
            traffic = read_fcd(folder / "fcd.csv", run.extent_m, run.warmup_s, returning=False)
    east, north = run.origin_m
    return Recording(network, traffic).shift(-east, -north)


def vehicle_types_xml(mix: Mix = FIRST_MIX) -> str:
    """SUMO's description of the vehicle mix, with the dimensions of the vehicle models."""
    lines = ['<additional><vTypeDistribution id="mix">']
    for name, vehicle_class, share in mix:
        design = load_vehicles()[name]
        lines.append(
            f'<vType id="{name}" vClass="{vehicle_class}" length="{design.length_m}" '
            f'width="{design.width_m}" height="{design.height_m}" probability="{share}"/>'
        )
    return "\n".join([*lines, "</vTypeDistribution></additional>"])


def call_sumo(home: Path, folder: Path, command: list[str]) -> None:
    """Run one of SUMO's programs in a folder.

    Raises
    ------
    MissingExtraError
        If the program or one of its system libraries is missing.
    ValueError
        If the program fails; the message has its last lines.
    """
    env = {**os.environ, "SUMO_HOME": str(home), "PROJ_LIB": str(home / "data" / "proj")}
    env.pop("PROJ_DATA", None)  # SUMO's own PROJ reads PROJ_LIB and stumbles over a newer PROJ_DATA
    program = Path(command[1] if command[0] == sys.executable else command[0]).name
    try:
        done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)
    except OSError as error:
        raise MissingExtraError(f"`{program}` of SUMO must be runnable; got {error}.") from error
    if done.returncode == 0:
        return
    output = f"{done.stdout}\n{done.stderr}"
    if "shared libraries" in output or "cannot open shared object" in output:
        library = next((word for word in output.split() if ".so" in word), "a library").rstrip(":")
        raise MissingExtraError(
            f"`{program}` of SUMO must find its system libraries; got none for {library}. "
            f"On Debian or Ubuntu, run `apt-get install {_DEBIAN_PACKAGES}`."
        )
    errors = [line for line in output.splitlines() if "rror" in line] or output.strip().splitlines()
    raise ValueError(
        f"`{program}` of SUMO must succeed; got exit {done.returncode}: {' '.join(errors[-2:])[:300]}."
    )
