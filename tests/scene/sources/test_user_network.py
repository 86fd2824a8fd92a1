"""Cities from files a user brings: what the files say is there, what they do not say is stated."""

from dataclasses import replace

import numpy as np
import pyproj
import pytest
import shapely
import shapely.affinity
from pydantic import ValidationError
from shapely.geometry import Polygon

from glintrack.core import schema
from glintrack.core.installation import MissingExtraError
from glintrack.io.readings import collect_readings
from glintrack.scene import SceneDesign, build_scene, record_traffic
from glintrack.scene.objects.buildings import rise_m
from glintrack.scene.objects.surfaces import Lane, RoadNetwork, road_areas
from glintrack.scene.read.polygons import Footprint, Polygons
from glintrack.scene.read.sumo import NetLocation, sumo_home
from glintrack.scene.sources import lots, user_network
from glintrack.scene.sources.lots import pavement_parking
from glintrack.scene.sources.site import place_of
from glintrack.scene.sources.user_network import busiest_place, streets_through_buildings
from tests.scene.read.test_sumo_net import NET
from tests.scene.town_osm import town_osm

FCD = (
    '<fcd-export><timestep time="0"><vehicle id="a" x="10" y="-1.6" angle="90" type="car"/></timestep>'
    '<timestep time="1"><vehicle id="a" x="20" y="-1.6" angle="90" type="car"/></timestep></fcd-export>'
)


def need_sumo():
    try:
        sumo_home()
    except MissingExtraError:
        pytest.skip("needs the extra traffic")


@pytest.fixture
def files(tmp_path):
    (tmp_path / "n.net.xml").write_text(NET)
    (tmp_path / "f.xml").write_text(FCD)
    return tmp_path


def tiny(files, **keys):
    names = {"net_file": str(files / "n.net.xml"), "traffic_file": str(files / "f.xml"), **keys}
    return SceneDesign(city="net", width_m=120, height_m=80, centre_m=(50.0, 0.0), **names)


def test_a_network_with_its_own_traffic_needs_no_sumo(files, monkeypatch):
    city = build_scene(tiny(files))
    truth = city.truth(0.5)
    schema.check(truth, "truth")
    # bumper at 15 m of the network's 50 m centre, half a car of 4.5 m behind it
    assert float(truth["east_m"][0]) == pytest.approx(15 - 50 - 2.25)
    assert float(truth["east_speed_m_s"][0]) == pytest.approx(10)
    assert any("no projection" in sentence for sentence in city.assumptions)
    monkeypatch.setenv("XDG_CACHE_HOME", str(files))  # built anew, not read
    again = build_scene(tiny(files))
    assert again.static.vertices.tobytes() == city.static.vertices.tobytes()


def test_each_seed_of_the_scene_has_traffic_of_its_own(files, monkeypatch):
    seeds = []

    def stop(run):
        seeds.append(run.seed)
        raise KeyboardInterrupt

    monkeypatch.setattr(user_network, "load_or_simulate", stop)
    for seed in (1, 2, 7):
        with pytest.raises(KeyboardInterrupt):
            record_traffic(tiny(files, traffic_file=None, seed=seed))
    assert seeds == [42, 43, 48]


def test_traffic_in_degrees_is_projected_where_the_city_has_a_place(files):
    east, north = 604_000.0, 5_790_000.0  # of the window's centre, (50, 0) in the network
    to_degrees = pyproj.Transformer.from_crs("EPSG:32632", 4326, always_xy=True)
    rows = [(t, *to_degrees.transform(east - 35 + 10 * t, north - 1.6)) for t in range(4)]
    head = "timestep_time;vehicle_id;vehicle_x;vehicle_y\n"
    (files / "g.csv").write_text(head + "\n".join(f"{t};a;{x:.8f};{y:.8f}" for t, x, y in rows))
    keys = {"traffic_file": str(files / "g.csv")}
    traffic = record_traffic(tiny(files, crs="EPSG:32632", origin_m=(east, north), **keys)).traffic
    assert traffic.bumper_east.tolist() == pytest.approx([15, 25, 35, 45], abs=0.01)
    assert np.degrees(traffic.angle) == pytest.approx(90, abs=0.01)
    with pytest.raises(ValueError, match="look like degrees"):
        record_traffic(tiny(files, **keys))
    (files / "far.xml").write_text(FCD.replace('y="-1.6', 'y="9000'))
    with pytest.raises(ValueError, match=r"`far.xml` must have a vehicle in the window"):
        record_traffic(tiny(files, traffic_file=str(files / "far.xml")))


def test_polygons_become_buildings(files):
    ring = "20,10 40,10 40,30 20,30 20,10"
    (files / "p.xml").write_text(
        f'<additional><poly id="a" type="building" height="21" shape="{ring}"/></additional>'
    )
    city = build_scene(tiny(files, polygons_file=str(files / "p.xml"), trees=False))
    inside = np.abs(city.static.vertices[:, :2] - [-20, 20]).max(axis=1) < 10.5
    assert 21 <= city.static.vertices[inside, 2].max() < 35  # walls to 21 m, then a roof


def test_polygons_elsewhere_are_refused(files):
    ring = "9020,10 9040,10 9040,30 9020,30 9020,10"
    (files / "p.xml").write_text(f'<additional><poly id="a" type="building" shape="{ring}"/></additional>')
    with pytest.raises(ValueError, match=r"`scene.polygons_file` must have a building in the window; got 1"):
        build_scene(tiny(files, polygons_file=str(files / "p.xml")))


def lefthand(text):
    return (
        text.replace("<net ", '<net lefthand="true" ', 1)
        if "<net " in text
        else text.replace("<net>", '<net lefthand="true">')
    )


def test_left_hand_traffic_has_its_kerb_and_its_markings_on_the_left(files):
    """The mirror image of a network that keeps right is one that keeps left, to its parked cars and paint."""
    right = Lane("ab", 0, "car", np.array([[0.0, 0.0], [90.0, 0.0]]), 3.2, street_type="highway.residential")
    fast = Lane("ab", 1, "car", right.points + [0, 3.2], 3.2, street_type="highway.residential")
    mirrored = [replace(lane, points=lane.points * [1, -1]) for lane in (right, fast)]
    area = shapely.box(-20, -60, 120, 60)
    there = RoadNetwork((right, fast), ())
    here = RoadNetwork(tuple(mirrored), (), left_hand=True)
    paint, mirror = (road_areas(network, area).markings for network in (there, here))
    assert paint.area > 5
    assert paint.symmetric_difference(shapely.affinity.scale(mirror, 1, -1, origin=(0, 0))).area < 0.01
    parked, other = (
        pavement_parking(network, Polygon(), Polygon(), area, np.random.default_rng(3))
        for network in (there, here)
    )
    assert len(parked) > 4
    assert [p.north_m for p in parked] == pytest.approx([-p.north_m for p in other])
    assert (here.shift(1, 1).left_hand, here.within(area).left_hand) == (True, True)


def test_the_side_of_the_road_is_the_networks_and_is_told(files):
    (files / "l.net.xml").write_text(lefthand(NET))
    left = build_scene(tiny(files, net_file=str(files / "l.net.xml")))
    assert "traffic keeps left, as the network says" in left.assumptions
    assert "traffic keeps right, as the network says" in build_scene(tiny(files)).assumptions
    with pytest.raises(
        ValueError, match=r"`scene.left_hand` must be that of the network, whose traffic keeps right"
    ):
        build_scene(tiny(files, left_hand=True))


def test_no_houses_are_built_where_blocks_are_not_filled(files, monkeypatch):
    def refuse(*arguments):
        raise AssertionError("houses by rule")

    assert any("filled" in sentence for sentence in build_scene(tiny(files)).assumptions)
    monkeypatch.setattr("glintrack.scene.sources.user_network.neighbourhood", refuse)
    plain = build_scene(tiny(files, fill_blocks=False))
    assert not any("filled" in sentence for sentence in plain.assumptions)
    with pytest.raises(AssertionError, match="houses by rule"):
        build_scene(tiny(files, seed=2))


def two_roads(path, kind, speed):
    """A road through the window's middle, of a class or a speed limit, and a street that crosses it."""
    edge = '<edge id="{0}" from="a" to="b" type="{1}">{2}</edge>'
    lane = '<lane id="{0}_0" index="0" speed="{1}" length="400" width="3.2" shape="{2}"/>'
    fast = edge.format("fast", kind, lane.format("fast", speed, "-300,0,6 400,0,0"))
    slow = edge.format("slow", "highway.residential", lane.format("slow", 13, "50,-300 50,300"))
    path.write_text(f"<net>{fast}{slow}</net>")
    return str(path)


@pytest.mark.parametrize(
    ("kind", "speed", "is_clear"),
    [
        ("highway.motorway", 20, True),
        ("highway.motorway_link", 20, True),
        ("", 33, True),
        ("", 13, False),
        ("highway.primary", 33, False),
    ],
)
def test_no_house_is_built_along_a_motorway(files, kind, speed, is_clear):
    path = two_roads(files / "m.net.xml", kind, speed)
    design = SceneDesign(
        city="net", net_file=path, traffic_file=str(files / "f.xml"), centre_m=(50.0, 0.0),
        width_m=300, height_m=240, trees=False,
    )  # fmt: skip
    with collect_readings() as readings:
        city = build_scene(design)
    east, north, up = city.static.vertices.T
    houses = np.abs(north[(up > 2.0) & (np.abs(east) < 150)])
    assert houses.size and (houses.min() > 40) == is_clear
    assert any("within 40 m of motorways" in sentence for sentence in city.assumptions) == is_clear
    (lanes,) = (reading for reading in readings if reading.content == "lanes")
    assert lanes.notes == ("heights of 0 to 6 m are not used: bridges and ramps lie on the ground",)


def test_streets_through_buildings_are_told(files):
    """A house over the street's middle; one beside it, and one that a lane grazes, are no passage."""
    over, beside, grazed = "60,-12 72,-12 72,12 60,12 60,-12", "20,10 40,10 40,30 20,30", "98.5,-9 99,-9 99,9"
    polygon = '<poly id="{}" type="building" height="9" shape="{} {}"/>'
    shapes = [polygon.format(k, ring, ring.split()[0]) for k, ring in enumerate((over, beside, grazed))]
    (files / "p.xml").write_text(f"<additional>{''.join(shapes)}</additional>")
    sentences = [
        a for a in build_scene(tiny(files, polygons_file=str(files / "p.xml"))).assumptions if "cut" in a
    ]
    assert sentences == [
        "1 street runs through buildings, which are cut open along it, without a roof above: ab"
    ]
    assert not any("cut open" in a for a in build_scene(tiny(files)).assumptions)


def test_pieces_and_directions_of_a_way_are_one_street():
    house = Polygons((Footprint(shapely.box(0, 0, 20, 90), None),))
    ways = [f"{sign}{100 + k}#{piece}" for k in range(7) for sign in ("", "-") for piece in (0, 1)]
    lanes = [
        Lane(way, 0, "car", np.array([[-9.0, 3.0 * k], [30.0, 3.0 * k]]), 3.0) for k, way in enumerate(ways)
    ]
    found = streets_through_buildings(RoadNetwork(tuple(lanes), ()), house)
    assert found == [str(100 + k) for k in range(7)]


def test_the_window_goes_where_the_lanes_are():
    dense = [Lane(f"d{k}", 0, "car", np.array([[1000.0, 20.0 * k], [1200, 20.0 * k]]), 3.2) for k in range(9)]
    far = Lane("far", 0, "car", np.array([[0.0, 900.0], [400, 900]]), 3.2)
    east, north = busiest_place(RoadNetwork((*dense, far), ()), 220, 180)
    assert abs(east - 1100) < 45 and abs(north - 80) < 45


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"city": "net"}, "`scene.net_file` must be given with city = 'net'; got none"),
        ({"net_file": "a"}, "`scene.net_file` must be given with city = 'net' only; got city = 'embedded'"),
        ({"width_m": 5000, "height_m": 5000}, "must be at most 4 km²; got 25 km²"),
        ({"crs": "EPSG:32632", "city": "mesh", "mesh_file": "m.glb"}, "must be given together"),
        ({"city": "braunschweig", "width_m": 500}, "must be 660 and 420 for city = 'braunschweig'"),
    ],
)
def test_keys_that_do_not_belong_together(keys, sentence):
    with pytest.raises(ValidationError) as error:
        SceneDesign(**keys)
    assert sentence in str(error.value)


def test_a_window_beside_the_streets_is_refused(files):
    design = tiny(files).model_copy(update={"centre_m": (9000.0, 0.0)})
    with pytest.raises(ValueError, match=r"`scene.centre_m` must put streets into the window; got 0 m"):
        build_scene(design)


@pytest.mark.parametrize("centre", [(-77.61, 43.16), (43.2, -77.6)])
def test_a_middle_in_the_towns_degrees_is_refused(files, centre):
    with pytest.raises(ValueError, match=r"`scene.centre_m` must be in the network's own coordinates, in m"):
        build_scene(tiny(files).model_copy(update={"centre_m": centre}))


def test_a_network_for_pedestrians_only_is_refused(files):
    lane = '<lane id="p_0" index="0" allow="pedestrian" shape="0,0 9,0"/>'
    (files / "p.net.xml").write_text(f'<net><edge id="p">{lane}</edge></net>')
    with pytest.raises(ValueError, match=r"`p.net.xml` must have a lane for motor vehicles; got none"):
        build_scene(tiny(files, net_file=str(files / "p.net.xml")))


BOMB = '<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><osm>&b;</osm>'


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (town_osm()[:900], "`m.osm` must be whole, well-formed XML"),
        (BOMB, "`m.osm` must be plain XML without DTD or entities"),
        ("<osm></osm>", "`m.osm` must hold at least one way with a highway tag"),
        ("<net/>", "`m.osm` must be OpenStreetMap XML"),
    ],
)
def test_bad_extracts_get_one_sentence(tmp_path, text, sentence):
    (tmp_path / "m.osm").write_text(text)
    with pytest.raises(ValueError, match=sentence):
        build_scene(SceneDesign(city="osm", osm_file=str(tmp_path / "m.osm")))


def bodies(truth):
    c, s = np.cos(truth["heading_rad"].values), np.sin(truth["heading_rad"].values)
    forward, right = np.stack([s, c], axis=1), np.stack([c, -s], axis=1)
    centre = np.stack([truth["east_m"].values, truth["north_m"].values], axis=1)
    half = truth["length_m"].values[:, None] / 2, truth["width_m"].values[:, None] / 2
    corners = [
        centre + a * half[0] * forward + b * half[1] * right for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))
    ]
    return np.array([Polygon(p) for p in np.stack(corners, axis=1)])


@pytest.mark.sumo
@pytest.mark.slow
def test_a_town_of_openstreetmap_stands_and_is_driven_in(tmp_path, monkeypatch):
    need_sumo()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path = tmp_path / "town.osm"
    path.write_text(town_osm())
    design = SceneDesign(city="osm", osm_file=str(path), width_m=330, height_m=330)
    city = build_scene(design)
    assert city.crs == "EPSG:32632"
    assert (city.latitude_deg, city.longitude_deg) == pytest.approx((50.0, 8.0), abs=2e-3)
    assert city.truth(60.0).sizes["vehicle"] > 0
    sentences = " ".join(city.assumptions)
    assert (
        "2 of 4 building heights are unknown" in sentences
        and "traffic keeps right, as in the country" in sentences
    )
    # the same extract finds its traffic in the cache: netconvert's dated comments do not count
    build_scene(design)
    assert len(list((tmp_path / "cache" / "glintrack" / "traffic").iterdir())) == 1


@pytest.mark.sumo
@pytest.mark.slow
@pytest.mark.parametrize(
    ("net", "polygons", "centre"),
    [
        ("DRT/osm.net.xml", None, (1710.0, 900.0)),
        ("A10KW/osm.net.xml", "A10KW/osm.poly.xml", None),
    ],
)
def test_bundled_real_networks(tmp_path, monkeypatch, net, polygons, centre):
    need_sumo()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    prefix = "sumo:tools/game/"
    design = SceneDesign(
        city="net",
        net_file=prefix + net,
        polygons_file=prefix + polygons if polygons else None,
        centre_m=centre,
        traffic_duration_s=20,
    )
    city = build_scene(design)
    assert city.crs == "EPSG:32633" and 52.3 < city.latitude_deg < 52.5
    assert 20_000 < len(city.static.faces) < 1_000_000  # houses and ground; trees are instances
    truth = city.truth(10.0)
    assert truth.sizes["vehicle"] > 30
    shapes = bodies(truth)
    i, j = shapely.STRtree(shapes).query(shapes, predicate="intersects")
    overlap = [shapes[a].intersection(shapes[b]).area for a, b in zip(i, j, strict=True) if a < b]
    # an overlap of over a metre square would be a crash; ramps that cross at two levels are flattened
    crossing = 2
    assert sum(area > 1.0 for area in overlap) <= crossing


@pytest.mark.parametrize("size_m", [(10, 12), (15, 20), (12, 40), (25, 30), (6, 7)])
@pytest.mark.parametrize("height_m", [3.0, 9.0, 18.0])
def test_a_known_height_is_that_of_the_top_of_the_roof(size_m, height_m):
    """OpenStreetMap's height; by its storeys the walls have it. Chimneys and plant may be higher."""
    shape = shapely.box(0, 0, *size_m)
    for seed in range(8):
        for of_walls in (False, True):
            rng = np.random.default_rng(seed)
            given = [Footprint(shape, height_m, of_walls)]
            (building,) = lots.buildings_by_rule(given, shape.buffer(50), Polygon(), rng)
            top_m = building.eaves_m + rise_m(building)
            assert top_m > height_m if of_walls else top_m == pytest.approx(height_m)


@pytest.mark.parametrize(
    "projection",
    [
        "+proj=tmerc +lat_0=0 +lon_0=9 +k=0.9996 +x_0=-177308 +y_0=-5425923 +datum=WGS84 +units=m +no_defs",
        "+proj=tmerc +lat_0=0 +lon_0=9 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs",
        "+proj=utm +zone=33 +ellps=bessel +units=m +no_defs",
        "+proj=utm +zone=32 +ellps=WGS84 +datum=WGS84 +units=m +no_defs",
    ],
)
def test_a_network_keeps_its_place_whatever_its_projection(projection):
    """PROJ finds EPSG codes for projections that are merely similar, with other origins."""
    longitude, latitude = (9.1, 50.0) if "33" not in projection else (15.1, 50.0)
    east, north = pyproj.Transformer.from_crs(4326, projection, always_xy=True).transform(longitude, latitude)
    location = NetLocation((100.0, 200.0), projection)
    place, _ = place_of(SceneDesign(), location, (east + 100.0, north + 200.0), "network")
    np.testing.assert_allclose(place.longitude_latitude_deg, (longitude, latitude), atol=2e-5)


@pytest.mark.parametrize("crs", ["EPSG:2263", "EPSG:3857"])
def test_a_scene_in_feet_or_stretched_metres_is_refused(crs):
    east, north = pyproj.Transformer.from_crs(4326, crs, always_xy=True).transform(-73.98, 40.75)
    design = SceneDesign(
        city="net", net_file="n.net.xml", traffic_file="f.xml", crs=crs, origin_m=(east, north)
    )
    with pytest.raises(ValueError, match="`crs` must"):
        place_of(design, None, (0.0, 0.0), "network")
