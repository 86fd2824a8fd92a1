"""OpenStreetMap extracts: their areas as the tags and rings say, and every form of a file read or refused."""

import bz2
import gzip
import importlib.util
import json

import numpy as np
import pytest

from glintrack.io.readings import collect_readings
from glintrack.scene.read.osm import keeps_left, read_osm

# importing sumo would set where PROJ seeks its database, for all tests after these
needs_sumo = pytest.mark.skipif(importlib.util.find_spec("sumo") is None, reason="needs the extra `traffic`")

HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n<osm version="0.6">'
NODES = [
    f'<node id="{4 * r + c}" lat="{52.27 + 0.0015 * r}" lon="{10.53 + 0.0025 * c}"/>'
    for r in range(4)
    for c in range(4)
]
STREETS = [
    *([4 * r + c for c in range(4)] for r in range(4)),
    *([4 * r + c for r in range(4)] for c in range(4)),
]
WAYS = [
    f'<way id="{100 + k}">{"".join(f"<nd ref={chr(34)}{n}{chr(34)}/>" for n in nodes)}'
    '<tag k="highway" v="residential"/></way>'
    for k, nodes in enumerate(STREETS)
]
RELATION = (
    '<relation id="900"><member type="way" ref="100" role="from"/><member type="node" ref="1" role="via"/>'
    '<member type="way" ref="105" role="to"/><tag k="type" v="restriction"/>'
    '<tag k="restriction" v="no_left_turn"/></relation>'
)


@needs_sumo
@pytest.mark.parametrize(
    "parts",
    [
        [*NODES, *WAYS[:-1], RELATION, WAYS[-1]],
        [*NODES[:-1], *WAYS, RELATION, NODES[-1]],
        [*WAYS, RELATION, *NODES],
    ],
    ids=["a way last", "a node last", "nodes last"],
)
def test_what_comes_after_a_relation_is_built_too(tmp_path, parts):
    nets = []
    for name, ordered in (("in_order", [*NODES, *WAYS, RELATION]), ("mixed", parts)):
        path = tmp_path / f"{name}.osm"
        path.write_text("\n".join([HEAD, *ordered, "</osm>"]), encoding="utf-8")
        network, _, _ = read_osm(path, tmp_path / f"{name}.net.xml")
        nets.append(network)
    whole, mixed = (len(network.of_kind("car")) for network in nets)
    assert mixed == whole >= 24


class _Areas:
    """Areas beside the streets, by corners in metres east and north of the south-west crossing."""

    def __init__(self):
        self.nodes, self.ways, self.relations, self.count = [], [], [], 1000

    def points(self, *corners):
        first, self.count = self.count, self.count + len(corners)
        for k, (x, y) in enumerate(corners):
            longitude, latitude = 10.53 + x / 68_230, 52.27 + y / 111_270
            self.nodes.append(f'<node id="{first + k}" lat="{latitude:.8f}" lon="{longitude:.8f}"/>')
        return list(range(first, self.count))

    def way(self, refs, **tags):
        self.count += 1
        inside = "".join(f'<nd ref="{r}"/>' for r in refs) + _tagged(tags)
        self.ways.append(f'<way id="{self.count}">{inside}</way>')
        return self.count

    def box(self, x, y, wide, high, **tags):
        refs = self.points((x, y), (x + wide, y), (x + wide, y + high), (x, y + high))
        return self.way([*refs, refs[0]], **tags)

    def split(self, x, y, wide, high, **tags):
        a, b, c, d = self.points((x, y), (x + wide, y), (x + wide, y + high), (x, y + high))
        return self.way([a, b, c], **tags), self.way([c, d, a])

    def relation(self, *members, **tags):
        inside = "".join(f'<member type="way" ref="{w}" role="{role}"/>' for w, role in members)
        self.count += 1
        self.relations.append(
            f'<relation id="{self.count}">{inside}{_tagged({"type": "multipolygon"} | tags)}</relation>'
        )

    def text(self):
        return "\n".join([HEAD, *NODES, *self.nodes, *WAYS, *self.ways, *self.relations, "</osm>"])

    def read(self, folder):
        """Area of each building by its height, areas of the grounds by kind, and what was left out."""
        (folder / "a.osm").write_text(self.text(), encoding="utf-8")
        with collect_readings() as readings:
            _, _, found = read_osm(folder / "a.osm", folder / "a.net.xml")
        (areas,) = [reading for reading in readings if reading.content == "buildings and grounds"]
        buildings = {f.height_m: f.shape.area for f in found.footprints}
        grounds = {}
        for kind, shape in found.grounds:
            grounds[kind] = grounds.get(kind, 0) + shape.area
        return buildings, grounds, dict(areas.left_out)


def _tagged(tags):
    return "".join(f'<tag k="{k.replace("__", ":")}" v="{v}"/>' for k, v in tags.items())


@needs_sumo
def test_what_does_not_stand_is_left_out_with_its_reason(tmp_path):
    town = _Areas()
    town.box(20, 20, 30, 20, building="yes", height="12")
    town.box(60, 20, 30, 20, building="no")
    town.box(25, 25, 10, 10, building__part="yes", height="40")
    town.box(20, 60, 30, 20, building="yes", location="underground", building__levels="2")
    town.box(60, 60, 30, 20, building="garage", layer="-1")
    town.box(20, 100, 30, 20, building="proposed")
    town.box(60, 100, 30, 20, building="yes", demolished="yes")
    town.box(60, 130, 30, 20, demolished__building="house")
    town.box(100, 100, 9, 9, amenity="parking", parking="underground")
    town.box(100, 120, 9, 9, natural="water", tunnel="culvert")
    town.box(100, 60, 30, 20, building="yes", tunnel="building_passage", height="9")
    town.way(town.points((0, 0), (5, 0), (5, 5), (0, 5)), building="yes")
    buildings, grounds, left_out = town.read(tmp_path)
    assert buildings == pytest.approx({12.0: 600, 9.0: 600}, rel=0.01) and grounds == {}
    assert left_out == {
        "building=no": 1,
        "building:part: the outline of its building is used": 1,
        "under ground": 4,
        "demolished or proposed": 3,
        "rings that do not close": 1,
    }


@needs_sumo
def test_multipolygons_of_several_ways_old_style_and_with_islands(tmp_path):
    town = _Areas()
    first, second = town.split(20, 20, 40, 40)
    town.relation((first, "outer"), (second, "outer"), building="yes", height="25")
    old = town.box(20, 80, 40, 40, building="yes", height="11")
    town.relation((old, "outer"), (town.box(30, 90, 20, 20), "inner"))
    new = town.box(80, 80, 40, 40, building="yes", height="7")  # its tags are the relation's too
    court = town.box(90, 90, 20, 20, building="yes")
    town.relation((new, "outer"), (court, "inner"), building="yes", height="7")
    lake, shore = town.split(200, 20, 90, 90)
    hole, island = town.box(220, 40, 50, 50), town.box(240, 60, 10, 10)
    roles = ((lake, "outer"), (shore, "outer"), (hole, "inner"), (island, "outer"))
    town.relation(*roles, natural="water")
    half, _ = town.split(320, 20, 40, 40)
    town.relation((half, "outer"), (77_777, "outer"), building="yes", height="40")
    buildings, grounds, left_out = town.read(tmp_path)
    assert buildings == pytest.approx({25.0: 1600, 11.0: 1200, 7.0: 1200}, rel=0.01)
    assert grounds == pytest.approx({"water": 90**2 - 50**2 + 10**2}, rel=0.01)
    assert left_out == {"parts of them are not in the file": 1}


@needs_sumo
def test_bridges_are_counted_and_their_place_is_stated(tmp_path):
    text = _Areas().text().replace('<tag k="highway"', '<tag k="bridge" v="yes"/><tag k="highway"', 2)
    (tmp_path / "b.osm").write_text(text, encoding="utf-8")
    with collect_readings() as readings:
        read_osm(tmp_path / "b.osm", tmp_path / "n.net.xml")
    assert readings[0].notes == ("2 of them are bridges, which lie on the ground",)


@needs_sumo
def test_streets_in_tunnels_are_none_on_the_ground(tmp_path):
    text = _Areas().text()
    texts = text, text.replace('<tag k="highway"', '<tag k="tunnel" v="yes"/><tag k="highway"', 1)
    lengths = []
    for name, content in zip("ab", texts, strict=True):
        (tmp_path / f"{name}.osm").write_text(content, encoding="utf-8")
        with collect_readings() as readings:
            network, _, _ = read_osm(tmp_path / f"{name}.osm", tmp_path / "n.net.xml")
        lengths.append(sum(lane.line.length for lane in network.of_kind("car")))
    assert readings[0].left_out == (("in a tunnel", 1),) and not readings[0].notes
    assert lengths[1] == pytest.approx(lengths[0] * 7 / 8, rel=0.1)


@needs_sumo
@pytest.mark.parametrize(("left_hand", "side"), [(None, -1), (True, 1)])
def test_oncoming_lanes_lie_on_the_other_side(tmp_path, left_hand, side):
    """In Braunschweig by default left of one's own, in SUMO's own network."""
    (tmp_path / "a.osm").write_text(_Areas().text(), encoding="utf-8")
    network, _, _ = read_osm(tmp_path / "a.osm", tmp_path / "n.net.xml", left_hand)
    assert network.left_hand == (side == 1)
    cars = {lane.edge_id: lane for lane in network.of_kind("car")}
    pairs = [(lane, cars[f"-{name}"]) for name, lane in cars.items() if f"-{name}" in cars]
    assert len(pairs) >= 12
    for lane, oncoming in pairs:
        ahead, across = (
            lane.points[-1] - lane.points[0],
            oncoming.points.mean(axis=0) - lane.points.mean(axis=0),
        )
        assert np.sign(ahead[0] * across[1] - ahead[1] * across[0]) == -side


@needs_sumo
def test_archives_are_read(tmp_path):
    text = _Areas().text().encode()
    for name, content in (("a.osm.gz", gzip.compress(text)), ("a.osm.bz2", bz2.compress(text))):
        (tmp_path / name).write_bytes(content)
        network, _, _ = read_osm(tmp_path / name, tmp_path / "n.net.xml")
        assert len(network.of_kind("car")) >= 24


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"\x00\x00\x00\x0d\n\tOSMHeader\x18", r"got PBF \(osmium cat a.x -o a.osm\)"),
        (json.dumps({"version": 0.6, "elements": []}).encode(), r"got JSON \(download it as XML"),
        (b"<osmChange/>", "must be OpenStreetMap XML .root element osm.; got 'osmChange'"),
    ],
)
def test_other_formats_are_refused_with_what_converts_them(tmp_path, content, sentence):
    (tmp_path / "a.x").write_bytes(content)
    with pytest.raises(ValueError, match=sentence):
        read_osm(tmp_path / "a.x", tmp_path / "n.net.xml")


@pytest.mark.parametrize(
    ("place", "longitude_deg", "latitude_deg", "left"),
    [
        *(("Dover", 1.31, 51.13, True), ("Calais", 1.85, 50.95, False), ("Hong Kong", 114.17, 22.3, True)),
        *(
            ("Nong Khai", 102.74, 17.88, True),
            ("Vientiane", 102.6, 17.97, False),
            ("Valletta", 14.51, 35.9, True),
        ),
        *(
            ("Bridgetown", -59.6, 13.1, True),
            ("Fort-de-France", -61.07, 14.6, False),
            ("Suva", 178.4, -18.1, True),
        ),
        *(("Goma", 29.22, -1.68, False), ("Kampala", 32.58, 0.32, True), ("Rochester", -77.6, 43.2, False)),
    ],
)
def test_side_of_the_road_by_country(place, longitude_deg, latitude_deg, left):
    assert keeps_left(longitude_deg, latitude_deg) == left, place


@needs_sumo
def test_an_inner_way_with_its_own_tags_is_a_building_of_its_own(tmp_path):
    town = _Areas()
    outer, inner = town.box(20, 20, 70, 70), town.box(40, 40, 30, 30, building="roof", height="5")
    town.relation((outer, "outer"), (inner, "inner"), building="yes", height="20")
    buildings, _, _ = town.read(tmp_path)
    assert buildings == pytest.approx({20.0: 70**2 - 30**2, 5.0: 30**2}, rel=0.01)
