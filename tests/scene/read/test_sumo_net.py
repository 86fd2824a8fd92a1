"""The network reader on a hand-written network, and on files that mean harm."""

import gzip

import numpy as np
import pytest

from glintrack.scene.read.sumo import count_standing_signals, read_sumo_net

NET = """<?xml version="1.0"?>
<net version="1.20">
  <location netOffset="-100.00,50.00" convBoundary="0,0,1,1" projParameter="!"/>
  <edge id=":b_0" function="internal">
    <lane id=":b_0_0" index="0" speed="5" length="1" shape="100,0 104,0"/>
    <lane id=":b_0_1" index="1" allow="bicycle" speed="5" length="1" shape="100,1 104,1"/>
  </edge>
  <edge id=":b_c0" function="crossing">
    <lane id=":b_c0_0" index="0" allow="pedestrian" speed="1" length="4" width="4.00" shape="99,-4 99,4"/>
  </edge>
  <edge id=":b_w0" function="walkingarea">
    <lane id=":b_w0_0" index="0" allow="pedestrian" speed="1" length="4" width="2"
          shape="99,4 101,4 101,6"/>
  </edge>
  <edge id="ab" from="a" to="b" type="highway.residential">
    <lane id="ab_0" index="0" allow="pedestrian" speed="13" length="100" width="2.00" shape="0,-5 100,-5"/>
    <lane id="ab_1" index="1" disallow="all" speed="13" length="100" width="2.20" shape="0,-3.6 100,-3.6"/>
    <lane id="ab_2" index="2" disallow="pedestrian" speed="13" length="100" shape="0,-1.6,0 100,-1.6,0"/>
  </edge>
  <edge id="t" from="a" to="b">
    <lane id="t_0" index="0" allow="tram" speed="9" length="9" shape="0,9 9,9"/>
  </edge>
  <edge id="bus" from="a" to="b">
    <lane id="bus_0" index="0" disallow="passenger" speed="9" length="9" shape="0,19 9,19"/>
  </edge>
  <edge id="river" from="a" to="b">
    <lane id="river_0" index="0" allow="ship" speed="9" length="9" shape="0,29 9,29"/>
  </edge>
  <junction id="b" type="traffic_light" x="102" y="0" incLanes="ab_2" intLanes=":b_0_0"
            shape="100,-3 104,-3 104,3"/>
  <junction id="p" type="priority" x="0" y="0" incLanes="ab_0" intLanes="" shape="0,0 1,0 1,1"/>
  <connection from="ab" to="cd" fromLane="2" toLane="0" tl="b" linkIndex="0"/>
</net>
"""


def test_tiny_network(tmp_path):
    path = tmp_path / "n.net.xml"
    path.write_text(NET)
    network, location = read_sumo_net(path)
    assert location.offset_m == (-100, 50) and location.projection is None
    kinds = {(lane.edge_id, lane.index): lane.kind for lane in network.lanes}
    assert kinds == {
        (":b_0", 0): "internal",
        (":b_c0", 0): "crossing",
        (":b_w0", 0): "walking_area",
        ("ab", 0): "walk",
        ("ab", 1): "parking",
        ("ab", 2): "car",
        ("t", 0): "rail",
        ("bus", 0): "car",
    }
    car, _ = network.of_kind("car")
    assert car.width_m == 3.2 and car.signalled and car.street_type == "highway.residential"
    np.testing.assert_array_equal(car.points, [[0, -1.6], [100, -1.6]])
    assert len(network.junctions) == 1  # the other is entered by pedestrians only
    moved = network.shift(10, 1)
    np.testing.assert_allclose(moved.of_kind("car")[0].points, [[10, -0.6], [110, -0.6]])


def test_lanes_within_a_junction_are_of_the_street_that_leads_there(tmp_path):
    """Without a type a fast lane is a motorway's; a fast residential street's junction is not."""
    fast = NET.replace('speed="5" length="1" shape="100,0', 'speed="28" length="1" shape="100,0')
    linked = fast.replace('tl="b" linkIndex="0"', 'via=":b_0_0" tl="b" linkIndex="0"')
    for text, is_motorway in ((fast, True), (linked, False)):
        (tmp_path / "n.net.xml").write_text(text)
        (inner,) = read_sumo_net(tmp_path / "n.net.xml")[0].of_kind("internal")
        assert inner.is_motorway == is_motorway


def test_gzipped_network(tmp_path):
    path = tmp_path / "n.net.xml.gz"
    path.write_bytes(gzip.compress(NET.encode()))
    assert len(read_sumo_net(path)[0].lanes) == 8


BOMB = '<?xml version="1.0"?><!DOCTYPE b [<!ENTITY a "aaaa"><!ENTITY c "&a;&a;&a;">]><net>&c;</net>'


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (BOMB, "must be plain XML without DTD or entities"),
        (NET[:900], "must be whole, well-formed XML"),
        ("<osm/>", "must be a SUMO network"),
        ("<net/>", "must hold at least one lane"),
        (NET.replace("0,-5 100,-5", "0,nan 100,-5"), "must give coordinates in metres within"),
        (NET.replace("0,-5 100,-5", "zero"), "must give shapes as"),
        (NET.replace("100,-1.6,0", "100,-1.6,up"), "must give heights of lanes as numbers"),
    ],
    ids=["entity bomb", "truncated", "other root", "no lanes", "not a number", "not a shape", "not a height"],
)
def test_bad_files_are_refused_in_one_sentence(tmp_path, content, words):
    path = tmp_path / "n.net.xml"
    path.write_text(content)
    with pytest.raises(ValueError, match=words) as caught:
        read_sumo_net(path)
    assert "`n.net.xml`" in str(caught.value) and "\n" not in str(caught.value)


def test_truncated_gzip_is_refused(tmp_path):
    path = tmp_path / "n.net.xml.gz"
    path.write_bytes(gzip.compress(NET.encode())[:200])
    with pytest.raises(ValueError, match="must be a whole gzip or bzip2 file"):
        read_sumo_net(path)


def test_signals_that_wait_for_a_hand_are_counted(tmp_path):
    path = tmp_path / "n.net.xml"
    program = '<tlLogic id="{}"><phase duration="{}" state="Gr"/><phase duration="4" state="yr"/></tlLogic>'
    path.write_text(NET.replace("</net>", program.format("a", 42) + program.format("b", 10000) + "</net>"))
    assert count_standing_signals(path) == 1


@pytest.mark.parametrize(
    ("allow", "kind"),
    [
        ("hov", "car"),
        ("vip", "car"),
        ("all", "car"),
        ("motorcycle moped", "car"),
        ("bicycle pedestrian", "walk"),
    ],
)
def test_a_lane_of_motor_vehicles_is_no_pavement(tmp_path, allow, kind):
    (tmp_path / "n.net.xml").write_text(
        NET.replace('id="ab_0" index="0" allow="pedestrian"', f'id="ab_0" index="0" allow="{allow}"')
    )
    network, _ = read_sumo_net(tmp_path / "n.net.xml")
    assert {lane.kind for lane in network.lanes if (lane.edge_id, lane.index) == ("ab", 0)} == {kind}
