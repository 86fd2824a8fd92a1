"""The order in which an extract has its parts says nothing of the town."""

import importlib.util

import pytest

from glintrack.scene.read.polygons import read_osm

# importing sumo would set where PROJ seeks its database, for all tests after these
pytestmark = pytest.mark.skipif(importlib.util.find_spec("sumo") is None, reason="needs the extra `traffic`")

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
