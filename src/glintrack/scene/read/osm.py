"""Reader of OpenStreetMap extracts, through SUMO's netconvert and polyconvert (extra ``traffic``)."""

import re
import tempfile
from pathlib import Path
from xml.etree.ElementTree import Element

import defusedxml.ElementTree

from glintrack.io.untrusted import read_bytes
from glintrack.scene.read.polygons import Polygons, read_polygons
from glintrack.scene.read.sumo import NetLocation, read_sumo_net, read_xml
from glintrack.scene.objects.surfaces import RoadNetwork
from glintrack.scene.read.sumo import call_sumo, sumo_home

_NETCONVERT = (
    *(
        "--geometry.remove",
        "--ramps.guess",
        "--junctions.join",
        "--tls.guess-signals",
        "--tls.discard-simple",
    ),
    *("--tls.join", "--sidewalks.guess", "--crossings.guess", "--junctions.corner-detail", "5"),
)


def read_osm(path: Path, net_path: Path) -> tuple[RoadNetwork, NetLocation, Polygons]:
    """Streets, buildings and grounds of an extract.

    Parameters
    ----------
    path
        ``.osm`` or ``.osm.xml``, plain or gzipped.
    net_path
        Where to leave the SUMO network, for the traffic.

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
        (folder / "m.osm").write_bytes(_in_order(root) or read_bytes(path, path.name))
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


def _in_order(root: Element) -> bytes | None:
    """The extract with nodes first, then ways, then relations; None if they come so.

    SUMO stops to look for nodes and ways at the first relation, and drops those after it without a word.
    """
    kinds = {"node": 0, "way": 1, "relation": 2}
    found = [kinds.get(element.tag, -1) for element in root]
    if found == sorted(found):
        return None
    root[:] = sorted(root, key=lambda element: kinds.get(element.tag, -1))
    return defusedxml.ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
