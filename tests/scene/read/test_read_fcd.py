"""Floating-car data in every format, and files that are no such data."""

import gzip

import numpy as np
import pandas as pd
import pytest

from glintrack.io.readings import collect_readings
from glintrack.scene.objects.surfaces import RoadNetwork
from glintrack.scene.read.fcd import fcd_table, model_of, read_fcd
from glintrack.scene.traffic import Recording, write_recording
from glintrack.scene.vehicles import VEHICLE_CLASSES

CAR, HATCH = list(VEHICLE_CLASSES).index("car"), list(VEHICLE_CLASSES).index("hatch")
HEAD = "timestep_time;vehicle_angle;vehicle_id;vehicle_type;vehicle_x;vehicle_y\n"
WINDOW = (-50, -50, 50, 50)


def test_fcd_table_becomes_traffic(tmp_path):
    path = tmp_path / "f.csv"
    rows = [f"{300 + 0.1 * k:.2f};90.00;b;car;{k};0" for k in range(5)]
    rows += [f"{300 + 0.1 * k:.2f};0.00;a;hatch;0;{k}" for k in range(2, 5)]
    rows += [f"{300 + 0.1 * k:.2f};0.00;far;car;900;{k}" for k in range(5)]
    path.write_text(HEAD + "\n".join(rows))
    traffic = read_fcd(path, (-50, -50, 50, 50), start_s=300)
    assert traffic.steps == 5 and traffic.step_s == pytest.approx(0.1)
    assert traffic.first.tolist() == [0, 2] and traffic.count.tolist() == [5, 3]  # b came first; far never
    assert traffic.model.tolist() == [CAR, HATCH]
    assert traffic.bumper_east.tolist() == [0, 1, 2, 3, 4, 0, 0, 0]


def test_vehicle_that_vanishes_comes_back_as_another_or_not_at_all(tmp_path):
    path = tmp_path / "f.csv"
    rows = [f"{0.1 * k:.2f};90.00;a;car;{k};0" for k in (0, 1, 2, 6, 7)]
    rows += [f"{0.1 * k:.2f};90.00;b;car;{k};9" for k in range(8)]
    path.write_text(HEAD + "\n".join(rows))
    traffic = read_fcd(path, (-50, -50, 50, 50), start_s=0, returning=False)
    assert traffic.count.tolist() == [3, 8]
    assert traffic.bumper_east.tolist() == [0, 1, 2, *range(8)]
    with collect_readings() as readings:
        traffic = read_fcd(path, (-50, -50, 50, 50), start_s=0)
    assert "1 vehicles vanish and come back as others" in readings[0].notes
    assert traffic.count.tolist() == [3, 8, 2] and traffic.first.tolist() == [0, 0, 6]
    assert traffic.bumper_east.tolist() == [0, 1, 2, *range(8), 6, 7]


@pytest.mark.parametrize(("rate_hz", "decimals"), [(30.0, 3), (30.0, 9), (29.97, 3), (24.0, 3), (15.0, 2)])
def test_rounded_times_of_a_camera_are_even_steps(tmp_path, rate_hz, decimals):
    path = tmp_path / "f.csv"
    times = np.round(np.arange(9000) / rate_hz, decimals)
    path.write_text(HEAD + "".join(f"{t:.9g};90;a;car;{k % 40};0\n" for k, t in enumerate(times)))
    traffic = read_fcd(path, WINDOW, start_s=0)
    assert traffic.steps == 9000 and traffic.count.tolist() == [9000]
    assert traffic.step_s == pytest.approx(1 / rate_hz, rel=1e-5)


def test_vehicles_sampled_at_times_of_their_own_are_refused(tmp_path):
    """Twenty probes, each once a second at its own tenth of a second: none is there at two times running."""
    path = tmp_path / "f.csv"
    rows = sorted((k + v % 10 / 10, v) for v in range(20) for k in range(30))
    path.write_text(HEAD + "".join(f"{t:.1f};90;v{v};car;{t};{v}\n" for t, v in rows))
    with pytest.raises(ValueError, match=r"at every time step; got most of them every 10 time steps"):
        read_fcd(path, WINDOW, start_s=0)


@pytest.mark.parametrize(
    ("row", "sentence"),
    [
        ("oops;90;a;car;3;0", r"must give each row a time; got none in 1 of 11 rows, first in data row 11"),
        (";90;a;car;3;0", "must give each row a time"),
        ("0.30;90;;car;3;0", "must give each row a vehicle"),
        ("0.30;90;a;car;3;0", "must give each vehicle once a time step; got 'a' twice at 0.3 s"),
        ("0.34;90;b;car;3;0", "must be sampled every 0.1 s, as most of it is; got the time 0.34 s"),
        ("0.30;90;b;car;3,5;0;0", "must give each row the header's 6 columns; got 7 in data row 11"),
        ("0.30;90", "must give each row a vehicle"),
        ("0:0:x;90;a;car;3;0", "must give each row a time"),
        ("0.30;90;b;car;x;0", "must give finite x in metres"),
        ("9e9;90;b;car;3;0", "must span at most 1e\\+06 s"),
    ],
)
def test_one_bad_row_is_refused_not_the_end_of_a_drive(tmp_path, row, sentence):
    path = tmp_path / "f.csv"
    rows = [f"{0.1 * k:.2f};90.00;a;car;{k};0" for k in range(10)]
    path.write_text(HEAD + "\n".join([*rows, row]) + "\n")
    with pytest.raises(ValueError, match=sentence):
        read_fcd(path, (-50, -50, 50, 50))


def some_rows():
    """(time, id, type, x, y, angle) of three vehicles, one of a type that is not ours."""
    for k in range(12):
        yield 20 + 0.5 * k, "a", "car", -30 + 3.25 * k, 4.5, 90.0
        if k > 2:
            yield 20 + 0.5 * k, "b", "passenger/delivery_van", 2.0, 40 - 2.5 * k, 180.0
        if k < 8:
            yield 20 + 0.5 * k, "c", "", 10 + k, 20 + k, 45.0


def as_csv(separator):
    rows = [separator.join(str(v) for v in (t, a, i, kind, x, y)) for t, i, kind, x, y, a in some_rows()]
    return HEAD.replace(";", separator) + "\n".join(rows)


def as_xml():
    lines, last = ["<fcd-export>"], None
    for t, i, kind, x, y, a in some_rows():
        if t != last:
            lines += ([] if last is None else ["</timestep>"]) + [f'<timestep time="{t}">']
            last = t
        given = f'type="{kind}"' if kind else ""
        lines.append(
            f'<vehicle id="{i}" x="{x}" y="{y}" angle="{a}" speed="1" {given}/><person id="p" x="0"/>'
        )
    return "\n".join([*lines, "</timestep></fcd-export>"])


def test_every_format_gives_the_same_traffic_and_what_was_written(tmp_path):
    (tmp_path / "s.csv").write_text(as_csv(";"))
    (tmp_path / "c.csv").write_text(as_csv(","))
    (tmp_path / "f.xml").write_text(as_xml())
    (tmp_path / "f.xml.gz").write_bytes(gzip.compress(as_xml().encode()))
    written = sorted(some_rows(), key=lambda row: ({"a": 0, "c": 1, "b": 2}[row[1]], row[0]))
    for name in ("s.csv", "c.csv", "f.xml", "f.xml.gz"):
        with collect_readings() as readings:
            traffic = read_fcd(tmp_path / name, WINDOW)
        assert (traffic.step_s, traffic.steps) == (0.5, 12)
        assert traffic.first.tolist() == [0, 0, 3] and traffic.count.tolist() == [12, 8, 9]
        assert [list(VEHICLE_CLASSES)[m] for m in traffic.model] == ["car", "car", "van"]
        assert readings[0].left_out == ((("no road vehicles: 1 × person", 1),) if "xml" in name else ())
        change = readings[0].notes[-1]
        assert change.startswith("shown as the model their type suggests")
        assert {"1 × no type", "1 × passenger/delivery_van"} == set(change.partition(": ")[2].split(", "))
        np.testing.assert_allclose(traffic.bumper_east, [row[3] for row in written])
        np.testing.assert_allclose(traffic.bumper_north, [row[4] for row in written])
        np.testing.assert_allclose(np.degrees(traffic.angle), [row[5] for row in written])


def test_what_is_no_road_vehicle_is_told_and_keeps_the_clock(tmp_path):
    rows = ["0;90;a;car;0;0", "1;90;a;car;9;0", "2;0;t;tram;5;5", "3;90;a;car;27;0", "2;90;p;pedestrian;0;0"]
    (tmp_path / "f.csv").write_text(HEAD + "\n".join(rows))
    with collect_readings() as readings:
        traffic = read_fcd(tmp_path / "f.csv", WINDOW)
    assert (traffic.step_s, traffic.steps) == (1.0, 4)
    assert readings[0].left_out == (("no road vehicles: 1 × tram, 1 × pedestrian", 2),)


@pytest.mark.parametrize(
    ("rows", "sentence"),
    [
        (["0;0;t;tram;5;5", "1;0;t;tram;5;6"], "must hold road vehicles; got none among 2 rows"),
        (["0;90;a;car;0;0", "1;90;a;car;9;0", "9e9;0;t;tram;5;5"], "must span at most 1e\\+06 s"),
    ],
)
def test_what_is_left_out_leaves_no_nonsense(tmp_path, rows, sentence):
    (tmp_path / "f.csv").write_text(HEAD + "\n".join(rows))
    with pytest.raises(ValueError, match=sentence):
        read_fcd(tmp_path / "f.csv", WINDOW)


def test_parquet_reads_as_csv_does(tmp_path):
    (tmp_path / "s.csv").write_text(as_csv(";"))
    pd.read_csv(tmp_path / "s.csv", sep=";").to_parquet(tmp_path / "f.parquet")
    one, other = (read_fcd(tmp_path / name, WINDOW) for name in ("s.csv", "f.parquet"))
    np.testing.assert_array_equal(one.bumper_east, other.bumper_east)


def test_parquet_whose_names_are_no_text_is_refused(tmp_path):
    """Arrow reads bytes that are no UTF-8 without a word, and fails where they are looked at."""
    (tmp_path / "s.csv").write_text(as_csv(";").replace("passenger", "passengär"))
    pd.read_csv(tmp_path / "s.csv", sep=";").to_parquet(tmp_path / "f.parquet", compression=None)
    whole = (tmp_path / "f.parquet").read_bytes()
    assert "passengär".encode() in whole
    (tmp_path / "f.parquet").write_bytes(whole.replace("passengär".encode(), b"passeng\xff\xffr"))
    with pytest.raises(ValueError, match="must be a whole Parquet file"):
        read_fcd(tmp_path / "f.parquet", WINDOW)


@pytest.mark.parametrize(
    ("kind", "model"),
    [
        *(
            ("car", "car"),
            ("tank", "car"),
            ("CityBus", "bus"),
            ("truck_semitrailer", "truck"),
            ("veh_suv", "suv"),
        ),
        *(
            ("motorbike", "motorcycle"),
            ("trailer", "truck"),
            ("semitrailer_truck", "truck"),
            ("MotorBike2", "motorcycle"),
        ),
        *(
            ("DEFAULT_VEHTYPE", "car"),
            ("DEFAULT_BIKETYPE", None),
            ("DEFAULT_PEDTYPE", None),
            ("bike_bicycle", None),
        ),
        *(
            ("rail_electric", None),
            ("cable_car", None),
            ("wheelchair", None),
            ("e-scooter", None),
            ("trams", None),
        ),
        *(
            ("rail_replacement_bus", "bus"),
            ("delivery_truck", "truck"),
            ("passenger/van", "van"),
            ("relationship", "car"),
        ),
    ],
)
def test_types_are_shown_as_the_model_their_name_suggests(kind, model):
    assert model_of(kind) == model


BOMB = '<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><fcd-export>&b;</fcd-export>'


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("f.csv", "a;b\n1;2\n", "`f.csv` must be SUMO's floating-car data with the columns"),
        ("f.csv", "", "`f.csv` must have a header row"),
        ("f.csv", HEAD + "0.0;0;a;car;nan;0\n0.1;0;a;car;0;1\n", "must give finite x .* in 1 of 2 rows"),
        ("f.csv", HEAD + "0.0;0;a;car;1e9;0\n0.1;0;a;car;0;1\n", "must give finite x .*got 1e.09"),
        ("f.csv", HEAD + "0.0;0;a;car;0;0\n", "must hold at least two time steps; got 1"),
        ("f.xml", as_xml()[:300], "`f.xml` must be whole, well-formed XML"),
        ("f.xml", BOMB, "`f.xml` must be plain XML without DTD or entities"),
        ("f.xml", "<net/>", "the root element 'net', which is not fcd-export"),
        ("f.xml", "<fcd-export/>", "must hold at least two time steps; got 0"),
        ("f.xml.gz", "not gzip", "`f.xml.gz` must be"),
    ],
)
def test_bad_files_get_one_sentence(tmp_path, name, text, sentence):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=sentence) as error:
        read_fcd(tmp_path / name, WINDOW)
    assert "\n" not in str(error.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"`gone.csv` must be a readable file"):
        read_fcd(tmp_path / "gone.csv", WINDOW)


@pytest.mark.parametrize("ending", [".csv", ".parquet", ".nc"])
def test_traffic_makes_the_round_trip(tmp_path, ending):
    source, path = tmp_path / "f.csv", tmp_path / f"t{ending}"
    source.write_text(as_csv(";"))
    before = read_fcd(source, WINDOW)
    if ending == ".nc":
        write_recording(path, Recording(RoadNetwork((), ()), before), {"title": "t"})
    elif ending == ".csv":
        fcd_table(before).to_csv(path, sep=";", index=False)
    else:
        fcd_table(before).to_parquet(path, index=False)
    after = read_fcd(path, WINDOW)
    assert after.steps == before.steps and after.step_s == before.step_s
    for name in ("first", "count", "model"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    for name in ("bumper_east", "bumper_north"):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), atol=0.5e-3)
    np.testing.assert_allclose(after.angle, before.angle, atol=1e-4)


STEPS = {0.0: [], 0.5: [("p0", "walker", 0, -8, None)], 1.0: [("a.0", "moto", 5, -5, "e_1")]}
STEPS |= {1.5: [("a.0", "moto", 12, -5, "e_1"), ("p0", "walker", 1, -8, None)], 2.0: [], 2.5: []}


def as_sumo_csv(clock=str, first="person"):
    """The table SUMO writes: columns named after the first object, rows for empty time steps."""
    names = ("id", "x", "y", "angle", "type", "lane", "edge")
    lines = [";".join(["timestep_time", *(f"{first}_{name}" for name in names)])]
    for time_s, objects in STEPS.items():
        for i, kind, x, y, lane in objects:
            place = (lane, "") if lane else ("", "e")
            lines.append(";".join(map(str, (clock(time_s), i, x, y, 90, kind, *place))))
        if not objects:
            lines.append(clock(time_s) + ";" * len(names))
    return "\n".join(lines) + "\n"


def as_sumo_xml(clock=str, angle='angle="90"'):
    lines = ["<fcd-export>"]
    for time_s, objects in STEPS.items():
        lines.append(f'<timestep time="{clock(time_s)}">')
        for i, kind, x, y, lane in objects:
            tag, place = ("vehicle", f'lane="{lane}"') if lane else ("person", 'edge="e"')
            lines.append(f'<{tag} id="{i}" x="{x}" y="{y}" {angle} type="{kind}" {place}/>')
        lines.append("</timestep>")
    return "\n".join([*lines, "</fcd-export>"])


def clock_of_day(time_s):
    return f"00:00:{time_s:05.2f}"


def test_forms_of_one_simulation_are_one_recording(tmp_path):
    """Empty steps, a person first, archives, times of day, no angles: 0 to 2.5 s, the motorcycle from 1 s."""
    texts = {
        **{
            "f.xml": as_sumo_xml(),
            "day.xml": as_sumo_xml(clock_of_day),
            "no_angle.xml": as_sumo_xml(angle=""),
        },
        **{
            "f.csv": as_sumo_csv(),
            "day.csv": as_sumo_csv(clock_of_day),
            "v.csv": as_sumo_csv(first="vehicle"),
        },
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "f.csv.gz").write_bytes(gzip.compress(as_sumo_csv().encode()))
    pd.read_csv(tmp_path / "f.csv", sep=";").to_parquet(tmp_path / "f.parquet")
    pd.read_csv(tmp_path / "day.csv", sep=";").to_parquet(tmp_path / "day.parquet")
    for name in (*texts, "f.csv.gz", "f.parquet", "day.parquet"):
        with collect_readings() as readings:
            traffic = read_fcd(tmp_path / name, WINDOW)
        assert (traffic.step_s, traffic.steps, traffic.first.tolist()) == (0.5, 6, [2]), name
        assert traffic.bumper_east.tolist() == [5, 12] and traffic.model.tolist() == [
            list(VEHICLE_CLASSES).index("motorcycle")
        ]
        np.testing.assert_allclose(np.degrees(traffic.angle), 90)
        assert readings[0].left_out == (("no road vehicles: 1 × person", 1),)
        assert [(r.content, r.found, r.used) for r in readings] == [("vehicles", 2, 1)]
        assert "time zero is 0 s of the file" in readings[0].notes[0]


def test_persons_that_cannot_be_told_from_vehicles_are_refused(tmp_path):
    (tmp_path / "f.csv").write_text("timestep_time;person_id;person_x;person_y\n0;p;0;0\n1;p;1;0\n")
    with pytest.raises(ValueError, match="must tell persons from vehicles"):
        read_fcd(tmp_path / "f.csv", WINDOW)


def test_degrees_are_refused_or_projected(tmp_path):
    """Three cars in London that drive 7 m east in half a second, and the same in metres."""
    rows = [(0.5 * k, v, -0.0985 + 1e-4 * k, 51.501 + 6e-4 * v) for k in range(9) for v in range(3)]
    (tmp_path / "f.csv").write_text(HEAD + "\n".join(f"{t};90;{v};car;{x};{y}" for t, v, x, y in rows))
    with pytest.raises(ValueError, match=r"look like degrees, about \(-0.0981, 51.5016\)"):
        read_fcd(tmp_path / "f.csv", WINDOW)
    traffic = read_fcd(
        tmp_path / "f.csv",
        (-900, -900, 900, 900),
        project=lambda x, y: ((x + 0.0985) * 69_400, (y - 51.5) * 111_250),
    )
    assert traffic.bumper_east[:9].tolist() == pytest.approx([6.94 * k for k in range(9)])
    metres = [(t, v, 69_400 * (x + 0.0985), 9 * v) for t, v, x, y in rows]
    (tmp_path / "m.csv").write_text(HEAD + "\n".join(f"{t};90;{v};car;{x};{y}" for t, v, x, y in metres))
    assert read_fcd(tmp_path / "m.csv", (-99, -99, 99, 99)).count.tolist() == [9, 9, 9]


def test_angles_of_motion_follow_turns_and_hold_while_standing(tmp_path):
    path = [(0, 0), (10, 0), (10, 0), (10, 10), (10, 10)]
    lines = [f"{t};a;car;{x};{y}" for t, (x, y) in enumerate(path)]
    head = "timestep_time;vehicle_id;vehicle_type;vehicle_x;vehicle_y\n"
    (tmp_path / "f.csv").write_text(head + "\n".join(lines))
    assert np.degrees(read_fcd(tmp_path / "f.csv", WINDOW).angle).tolist() == [90, 90, 0, 0, 0]
    (tmp_path / "f.csv").write_text(head + "0;a;car;0;0\n1;a;car;0;0\n")
    with pytest.raises(ValueError, match="must give angles; got none, and 1 vehicles that never move"):
        read_fcd(tmp_path / "f.csv", WINDOW)
