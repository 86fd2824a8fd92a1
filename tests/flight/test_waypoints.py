"""Waypoint files: CSV in metres or degrees, KML lines and tracks."""

import math

import numpy as np
import pyproj
import pytest

from glintrack.flight import FlightDesign, build_flight
from glintrack.flight.paths import check_waypoints

MILLIMETRE = 1e-3
CRS, ORIGIN = "EPSG:32632", (604000.0, 5792000.0)
KML = """<?xml version="1.0"?>
<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2">
<Document><Placemark>{}</Placemark></Document></kml>"""
MODE = "<altitudeMode>absolute</altitudeMode>"


def flown(tmp_path, name, text, **keys):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    keys = {"frames": 3, "rate_hz": 1.0, "speed_m_s": 100.0, **keys}
    design = FlightDesign(kind="waypoints", waypoint_file=name, **keys).resolve_files(tmp_path)
    return build_flight(design, 1.0, CRS, ORIGIN)


def degrees_of(east, north):
    to = pyproj.Transformer.from_crs(CRS, "EPSG:4326", always_xy=True)
    return to.transform(ORIGIN[0] + east, ORIGIN[1] + north)


def test_metres_without_times_are_flown_at_the_designs_speed(tmp_path):
    text = "# a square corner\neast_m, north_m, up_m\n0,0,2000\n0,300,2000\n400,300,2000\n"
    flight = flown(tmp_path, "way.csv", text, frames=7)
    np.testing.assert_allclose(flight.pose(1.5).position, [0, 150, 2000], atol=MILLIMETRE)
    np.testing.assert_allclose(flight.pose(5.0).position, [200, 300, 2000], atol=MILLIMETRE)
    assert flight.pose(1.5).heading_rad == pytest.approx(0)
    assert flight.pose(5.0).heading_rad == pytest.approx(math.pi / 2)
    assert flight.mean_altitude_m == pytest.approx(2000)


def test_times_and_attitude_are_taken_from_the_file(tmp_path):
    text = (
        "time_s,east_m,north_m,up_m,heading_deg,roll_deg,pitch_deg,order\n"
        "0,0,0,1000,350,0,2,heading-roll-pitch\n2,0,80,1100,10,4,2,heading-roll-pitch\n"
    )
    pose = flown(tmp_path, "way.csv", text).pose(1.0)
    np.testing.assert_allclose(pose.position, [0, 40, 1050], atol=MILLIMETRE)
    assert math.degrees(math.remainder(pose.heading_rad, 2 * math.pi)) == pytest.approx(0, abs=1e-9)
    assert (math.degrees(pose.roll_rad), math.degrees(pose.pitch_rad)) == pytest.approx((2, 2))


def test_angles_without_an_order_are_refused_where_it_matters(tmp_path):
    head = "east_m,north_m,up_m,heading_deg,roll_deg,pitch_deg"
    with pytest.raises(ValueError, match="`waypoint_file` must have a column `order`"):
        flown(tmp_path, "way.csv", f"{head}\n0,0,1000,30,10,10\n0,800,1000,30,10,10\n")
    level = flown(tmp_path, "level.csv", f"{head}\n0,0,1000,30,0,10\n0,800,1000,30,0,10\n")
    assert math.degrees(level.pose(0.5).pitch_rad) == pytest.approx(10)  # without roll both are the same
    rows = "0,0,1000,30,10,10,yaw-pitch-roll\n0,800,1000,30,10,10,yaw-pitch-roll\n"
    pose = flown(tmp_path, "ins.csv", f"{head},order\n{rows}").pose(0.5)
    angle = math.radians(10)  # wing and nose point equally far below and above the horizon in both orders
    roll_rad = math.asin(math.sin(angle) * math.cos(angle))
    assert pose.roll_rad == pytest.approx(roll_rad)
    assert pose.pitch_rad == pytest.approx(math.asin(math.sin(angle) / math.cos(roll_rad)))


def line_of(*east_m):
    """LineString of a KML along east."""
    places = " ".join(f"{x:.9f},{y:.9f},1000" for x, y in (degrees_of(e, 0) for e in east_m))
    mode = "<altitudeMode>relativeToGround</altitudeMode>"
    return f"<LineString>{mode}<coordinates>{places}</coordinates></LineString>"


def test_lines_of_a_kml_that_go_on_are_one_path(tmp_path):
    parts = "</Placemark><Placemark>".join([line_of(0, 100), line_of(100, 200), line_of(200, 300)])
    flight = flown(tmp_path, "way.kml", KML.format(parts))
    np.testing.assert_allclose(flight.pose(2.5).position, [250, 0, 1000], atol=2 * MILLIMETRE)
    apart = "</Placemark><Placemark>".join([line_of(0, 100), line_of(180, 200)])
    with pytest.raises(ValueError, match=r"got 2 parts in apart\.kml: LineString of 2 points"):
        flown(tmp_path, "apart.kml", KML.format(apart))


def test_degrees_come_to_their_place_in_the_scene(tmp_path):
    places = [(*degrees_of(100, 200), 1070.0), (*degrees_of(100, 500), 1070.0)]
    rows = "\n".join(f"{x:.9f},{y:.9f},{z}" for x, y, z in places)
    flight = flown(
        tmp_path, "way.csv", f"longitude_deg,latitude_deg,altitude_m\n{rows}\n", waypoint_datum_m=70.0
    )
    np.testing.assert_allclose(flight.pose(1.0).position, [100, 300, 1000], atol=2 * MILLIMETRE)


@pytest.mark.parametrize(("longitude", "latitude"), [(-104.99, 39.74), (139.7, 35.7), (25.0, 68.0)])
def test_a_file_is_checked_wherever_it_lies(tmp_path, longitude, latitude):
    rows = f"{longitude},{latitude},1900\n{longitude + 0.01},{latitude},1900\n"
    (tmp_path / "way.csv").write_text("longitude_deg,latitude_deg,altitude_m\n" + rows)
    design = FlightDesign(kind="waypoints", waypoint_file="way.csv").resolve_files(tmp_path)
    check_waypoints(design)


@pytest.mark.parametrize(("mode", "up_m"), [("absolute", 930.0), ("relativeToGround", 1000.0)])
def test_a_kml_line(tmp_path, mode, up_m):
    places = " ".join(f"{x:.9f},{y:.9f},1000" for x, y in (degrees_of(0, 0), degrees_of(300, 0)))
    line = f"<LineString><altitudeMode>{mode}</altitudeMode><coordinates>{places}</coordinates></LineString>"
    flight = flown(tmp_path, "way.kml", KML.format(line), waypoint_datum_m=70.0)
    np.testing.assert_allclose(flight.pose(1.5).position, [150, 0, up_m], atol=2 * MILLIMETRE)


def test_a_kml_track_has_times(tmp_path):
    whens = "".join(f"<when>2010-07-15T13:00:0{s}Z</when>" for s in (0, 4))
    coords = "".join(
        f"<gx:coord>{x:.9f} {y:.9f} 1000</gx:coord>" for x, y in (degrees_of(0, 0), degrees_of(0, 200))
    )
    track = f"<gx:Track>{MODE}{whens}{coords}</gx:Track>"
    flight = flown(tmp_path, "way.kml", KML.format(track), start_s=10.0)
    np.testing.assert_allclose(flight.pose(12.0).position, [0, 100, 1000], atol=2 * MILLIMETRE)


def test_tracks_of_a_kml_have_the_altitude_mode_of_their_multitrack(tmp_path):
    places = "".join(
        f"<gx:coord>{x:.9f} {y:.9f} 1000</gx:coord>" for x, y in map(degrees_of, (0, 0), (0, 200))
    )
    whens = "".join(f"<when>2010-07-15T13:00:0{s}Z</when>" for s in (0, 4))
    track = f"<gx:MultiTrack>{MODE}<gx:Track>{whens}{places}</gx:Track></gx:MultiTrack>"
    flight = flown(tmp_path, "way.kml", KML.format(track))
    np.testing.assert_allclose(flight.pose(2.0).position, [0, 100, 1000], atol=2 * MILLIMETRE)


BOMB = '<!DOCTYPE k [<!ENTITY a "x">]><kml><LineString/></kml>'
HEADER = "east_m,north_m,up_m\n"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("way.gpx", "", r"must end in .csv or .kml"),
        ("way.csv", "", r"must have a header row"),
        ("way.csv", "east,north,up\n0,0,0\n", r"must have the columns .* got east, north, up"),
        ("way.csv", HEADER + "0,0,x\n1,1,1\n", r"must hold numbers"),
        ("way.csv", HEADER + "0,0,nan\n1,1,1\n", r"must hold numbers; got .nan."),
        ("way.csv", HEADER + "0,0,inf\n1,1,1\n", r"finite"),
        ("way.csv", HEADER + "0,0,1000\n", r"two waypoints or more; got 1"),
        ("way.csv", HEADER + "0,0,9\n0,0,9\n", r"same place twice"),
        ("way.csv", HEADER + "0,0,9\n50,0,9\n", r"must cover the frames, 0 to 2 s; got 0 to 0.5 s"),
        ("way.csv", "time_s," + HEADER + "1,0,0,9\n0,9,0,9\n", r"rising times; got 0 s after 1 s"),
        ("way.csv", "heading_deg," + HEADER + "1,0,0,9\n0,9,0,9\n", r"all of heading_deg"),
        ("way.kml", "no xml", r"plain KML"),
        ("way.kml", BOMB, r"plain KML"),
        ("way.kml", "<kml/>", r"LineString or a gx:Track"),
        (
            "way.kml",
            "<kml><LineString><coordinates>0,0 1,1</coordinates></LineString></kml>",
            r"altitudeMode absolute or relativeToGround; got clampToGround",
        ),
        (
            "way.kml",
            f"<kml><LineString>{MODE}<coordinates>0,0 1,1</coordinates></LineString></kml>",
            r"altitude",
        ),
        ("way.kml", f"<kml><Track>{MODE}<when>noon</when><coord>0 0 0</coord></Track></kml>", r"ISO 8601"),
        ("way.kml", f"<kml><Track>{MODE}<when>2010-01-01</when></Track></kml>", r"altitude|time for each"),
    ],
)
def test_bad_files_are_refused_in_a_sentence(tmp_path, name, text, message):
    with pytest.raises(ValueError, match=message) as caught:
        flown(tmp_path, name, text)
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_a_scene_without_crs(tmp_path):
    design = FlightDesign(kind="waypoints", waypoint_file=str(tmp_path / "none.csv"))
    with pytest.raises(ValueError, match="must be a readable file"):
        build_flight(design, 0.0)
    path = tmp_path / "way.csv"
    path.write_text("longitude_deg,latitude_deg,altitude_m\n10,52,1000\n10.1,52,1000\n")
    with pytest.raises(ValueError, match="without a CRS"):
        build_flight(design.model_copy(update={"waypoint_file": str(path)}), 0.0)
