"""Building outlines: heights in every spelling, courtyards, and files that are no polygons."""

import pytest

from glintrack.io.readings import collect_readings
from glintrack.scene.read.polygons import read_polygons
from glintrack.scene.read.sumo import NetLocation

FOOT_M = 0.3048


def polygon(ident, west, south, size, kind="building.yes", attributes="", **tags):
    ring = ((west, south), (west + size, south), (west + size, south + size), (west, south + size))
    shape = " ".join(f"{x},{y}" for x, y in (*ring, ring[0]))
    inside = "".join(f'<param key="{k.replace("__", ":")}" value="{v}"/>' for k, v in tags.items())
    return f'<poly id="{ident}" type="{kind}" {attributes} shape="{shape}">{inside}</poly>'


def read(tmp_path, *parts):
    path = tmp_path / "m.poly.xml"
    path.write_text(f"<additional>{''.join(parts)}</additional>")
    return read_polygons(path)


@pytest.mark.parametrize(
    ("attributes", "tags", "height_m"),
    [
        ('height="15.00"', {}, 15.0),
        ("", {"height": "15 m"}, 15.0),
        ("", {"height": "50 ft"}, 50 * FOOT_M),
        ("", {"height": "24&apos;6&quot;"}, 24.5 * FOOT_M),
        ("", {"height": "7 ft 6 in"}, 7.5 * FOOT_M),
        ("", {"height": "12,5 m"}, 12.5),
        ("", {"height": "~9 metres"}, 9.0),
        ("", {"height": "9;12"}, 12.0),
        ("", {"building__levels": "3;4"}, 4 * 2.9 + 0.4),
        ("", {"building__levels": "0,1,2"}, 3 * 2.9 + 0.4),
        ("", {"building__levels": "-1;0;1"}, 2 * 2.9 + 0.4),
        ("", {"building__levels": "2-3"}, 3 * 2.9 + 0.4),
        ("", {"building__levels": "2,3"}, 3 * 2.9 + 0.4),
        ("", {"est_height": "8"}, 8.0),
        ("", {"height": "574'"}, 574 * FOOT_M),
        ("", {"building__levels": "1,5"}, 1.5 * 2.9 + 0.4),
        ("", {"building__levels": "many"}, None),
        ("", {"building__levels": "4"}, 4 * 2.9 + 0.4),
        ('height="9"', {"building__levels": "4"}, 9.0),
        ("", {"height": "tall", "building__levels": "2"}, 2 * 2.9 + 0.4),
        ("", {"height": "-3"}, None),
        ("", {"height": "0", "building__levels": "4"}, 4 * 2.9 + 0.4),
        ("", {"height": "1e9"}, None),
        ("", {}, None),
    ],
)
def test_height_of_a_building(tmp_path, attributes, tags, height_m):
    (found,) = read(tmp_path, polygon("a", 0, 0, 10, attributes=attributes, **tags)).footprints
    assert found.height_m == (pytest.approx(height_m) if height_m else None)


def test_polygons_in_degrees_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"must give polygons in metres; got longitudes and latitudes"):
        read(tmp_path, polygon("a", 0, 0, 10, attributes='geo="true"'))


def test_polygons_of_another_offset_are_moved_to_the_network(tmp_path):
    """Coordinates of either file are the projection's plus its offset."""
    path = tmp_path / "m.poly.xml"
    where = '<location netOffset="-500.0,-700.0" projParameter="+proj=utm +zone=32"/>'
    path.write_text(f"<additional>{where}{polygon('a', 20, 30, 10)}</additional>")
    with collect_readings() as readings:
        (found,) = read_polygons(path, NetLocation((-400.0, -750.0), "+proj=utm +zone=32")).footprints
    assert found.shape.bounds == (120, -20, 130, -10)
    assert "moved by (100.00, -50.00) m into the network's coordinates" in readings[0].notes
    assert read_polygons(path).footprints[0].shape.bounds == (20, 30, 30, 40)
    with pytest.raises(ValueError, match=r"must be of a network in the projection '\+proj=utm \+zone=33'"):
        read_polygons(path, NetLocation((0.0, 0.0), "+proj=utm +zone=33"))


def test_rings_inside_are_courtyards_and_what_stands_in_those_stands_again(tmp_path):
    with collect_readings() as readings:
        found = read(tmp_path, polygon("a", 0, 0, 100), polygon("b", 20, 20, 60), polygon("c", 40, 40, 20))
    assert readings[0].notes == ("1 rings inside others are courtyards",)
    assert sorted(f.shape.area for f in found.footprints) == pytest.approx([20**2, 100**2 - 60**2])


def test_buildings_side_by_side_are_both_kept(tmp_path):
    found = read(tmp_path, polygon("a", 0, 0, 10), polygon("b", 10, 0, 10))
    assert len(found.footprints) == 2


def test_many_buildings_over_each_other_are_refused_before_all_pairs_are_tried(tmp_path):
    """2000 outlines in one place are 4 million pairs, of which each takes microseconds; 60 are let be."""
    assert len(read(tmp_path, *(polygon(f"a{k}", 0, 0, 10) for k in range(60))).footprints) == 60
    with pytest.raises(ValueError, match="must hold buildings side by side; got 2000 over each other"):
        read(tmp_path, *(polygon(f"a{k}", 0, 0, 10) for k in range(2000)))


def test_grounds_and_what_is_none(tmp_path):
    found = read(
        tmp_path,
        polygon("w", 0, 0, 30, "natural.water"),
        polygon("p", 40, 0, 30, "amenity.parking"),
        polygon("b", 80, 0, 30, "amenity.bicycle_parking"),
        polygon("s", 80, 40, 30, "shop.shoes"),
        '<poly id="d" type="building" shape="0,0 1,1"/>',
    )
    assert [kind for kind, _ in found.grounds] == ["water", "parking"]


BOMB = '<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><additional>&b;</additional>'


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("<net/>", "must be SUMO polygons"),
        ("<additional>", "must be whole, well-formed XML"),
        (BOMB, "must be plain XML without DTD or entities"),
        (
            '<additional><poly type="building" shape="0,0 nan,1 1,1 0,0"/></additional>',
            "coordinates in metres",
        ),
        ('<additional><poly type="building" shape="here"/></additional>', "must give shapes as"),
    ],
)
def test_bad_files_get_one_sentence(tmp_path, text, sentence):
    (tmp_path / "m.poly.xml").write_text(text)
    with pytest.raises(ValueError, match=sentence):
        read_polygons(tmp_path / "m.poly.xml")


def test_names_of_the_type_map_are_grounds_and_other_names_are_counted(tmp_path):
    """As polyconvert writes them without --osm.keep-full-type; a river may be a line of type water."""
    with collect_readings() as readings:
        found = read(
            tmp_path,
            polygon("a", 0, 0, 10, kind="water"),
            polygon("b", 20, 0, 10, kind="forest"),
            polygon("c", 40, 0, 10, kind="residential"),
            polygon("d", 60, 0, 10, kind="water", attributes='fill="0"'),
        )
    assert [kind for kind, _ in found.grounds] == ["water", "forest"]
    ((reason, count),) = readings[0].left_out
    assert "keep-full-type" in reason and count == 1


def test_coasts_and_rivers_without_an_outline_are_counted(tmp_path):
    with collect_readings() as readings:
        read(
            tmp_path,
            polygon("a", 0, 0, 10, kind="natural.coastline"),
            polygon("b", 20, 0, 10, kind="waterway.river"),
            polygon("c", 40, 0, 10, kind="natural.water", waterway="canal"),
        )
    assert (readings[0].found, readings[0].used) == (3, 1)
