"""``glintrack scene``: what it writes and what it says."""

import importlib.util
import json
import struct
import tomllib

import numpy as np
import pytest
from matplotlib.image import imread
from typer.testing import CliRunner

from glintrack.case.design import Case
from glintrack.cli import scene
from glintrack.cli.app import app
from glintrack.scene import SceneDesign, build_scene, glb
from glintrack.scene.read.fcd import read_fcd

run = CliRunner().invoke


@pytest.mark.slow
def test_preview_shows_green_land_and_grey_streets(tmp_path):
    path = tmp_path / "view.png"
    done = run(app, ["scene", "preview", "embedded", "-o", str(path), "--view", "plan", "--width", "330"])
    assert done.exit_code == 0, done.output
    picture = imread(path)[..., :3]
    assert picture.shape == (210, 330, 3)  # as the window's sides
    green = (picture[..., 1] > picture[..., 0]) & (picture[..., 1] > picture[..., 2])
    assert 0.2 < green.mean() < 0.7 and picture.std() > 0.1


def test_a_scene_moves_with_the_files_beside_it(tmp_path):
    given = {"osm_file": str(tmp_path / "data" / "town.osm"), "dem_file": "/elsewhere/dem.tif"}
    design = SceneDesign(city="osm", **given)
    written = design.with_relative_files(tmp_path)
    assert (written.osm_file, written.dem_file) == ("data/town.osm", "/elsewhere/dem.tif")
    assert written.resolve_files(tmp_path) == design


def test_build_writes_a_case_and_refuses_what_is_there(tmp_path):
    path = tmp_path / "scene.toml"
    small = ["--width", "120", "--height", "80", "--no-trees"]
    done = run(app, ["scene", "build", "--seed", "3", *small, "--no-sky", "-o", str(path)])
    assert done.exit_code == 0, done.output
    assert Case.from_toml(path).scene == SceneDesign(seed=3, trees=False, width_m=120, height_m=80)
    assert tomllib.loads(path.read_text())["scene"]["city"] == "embedded"
    assert "triangles" in done.output and f"wrote {path}" in done.output
    again = run(app, ["scene", "build", "-o", str(path)])
    assert "must be a new file" in str(again.exception)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["build", "--osm", "a.osm", "--mesh", "b.glb"], "must get one of --osm, --sumo-net, --mesh"),
        (["build", "--osm", "gone.osm"], "`gone.osm` must be a readable file"),
        (["build", "--sumo-net", "gone.net.xml"], "`gone.net.xml` must be a readable file"),
        (["build", "--mesh", "gone.glb"], "`mesh_file` must be a readable file"),
        (["build", "--width", "9000", "--height", "9000"], "must be at most 4 km²"),
        (["traffic", "-o", "t.txt"], "must end in .nc, .csv or .parquet"),
        (["traffic", "--fcd", "gone.csv", "-o", "t.nc"], "`gone.csv` must be a readable file"),
        (["build", "--dem", "gone.tif"], "`dem_file` must be a readable file; got"),
        (["preview", "embeded", "-o", "view.png"], "Did you mean `embedded`?"),
        (["preview", "embedded", "-o", "view.gif"], "must end in .png, .jpg or .jpeg"),
        (["preview", "gone.toml", "-o", "view.png"], "gone.toml"),
        (["export", "embedded", "scene.obj"], "must end in .glb"),
        (["build", "-o", "gone/scene.toml"], "must be a file in an existing folder; got gone/scene.toml"),
        (["preview", "embedded", "-o", "gone/a.png"], "must be a file in an existing folder"),
        (["export", "embedded", "gone/a.glb"], "must be a file in an existing folder"),
        (["traffic", "-o", "gone/t.nc"], "must be a file in an existing folder"),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_nothing(tmp_path, monkeypatch, arguments, sentence):
    monkeypatch.chdir(tmp_path)
    done = run(app, ["scene", *arguments])
    assert isinstance(done.exception, ValueError) and sentence in str(done.exception)
    assert "\n" not in str(done.exception)
    assert list(tmp_path.iterdir()) == []


def test_build_says_how_to_run_a_case_over_a_file_from_elsewhere(tmp_path):
    (tmp_path / "mine").mkdir()
    paint = tmp_path / "paint.toml"
    paint.write_text("", encoding="utf-8")
    for folder, said in ((tmp_path, False), (tmp_path / "mine", True)):
        made = folder / "scene.toml"
        small = ["--width", "120", "--height", "80", "--no-trees", "--no-sky"]
        done = run(app, ["scene", "build", *small, "--materials", str(paint), "-o", str(made)])
        assert done.exit_code == 0, done.output
        assert (f"`glintrack run {made} --allow-outside-paths`" in done.output) == said
        assert Case.from_toml(made, said).scene.materials_file


def test_build_solves_the_sky_that_runs_read(tmp_path, monkeypatch):
    city = build_scene(SceneDesign(width_m=120, height_m=80, trees=False))
    monkeypatch.setattr(scene, "build_scene", lambda design: city)
    solved = []

    def build(name, solve, is_solved, *words):
        monkeypatch.setattr(scene, "solve_tables", solve)
        monkeypatch.setattr(scene, "is_solved", lambda design: is_solved)
        done = run(app, ["scene", "build", *words, "-o", str(tmp_path / name)])
        assert done.exit_code == 0 and (tmp_path / name).is_file(), done.output
        return done.output

    def note(design, progress):
        solved.append(design)

    def refuse(design, progress):
        raise ValueError("`local_time_h` must put the sun higher.")

    assert "solved the sky in" in build("a.toml", note, False)
    assert "is solved already" in build("b.toml", note, True)
    assert "the sky" not in build("c.toml", note, False, "--no-sky")
    assert "warning: the sky is not solved: `local_time_h`" in build("d.toml", refuse, False)
    assert solved == [Case.from_toml(tmp_path / "a.toml").atmosphere]


@pytest.mark.parametrize("time_s", ["inf", "nan", "1e308"])
@pytest.mark.parametrize("words", [["preview", "embedded", "-o", "a.png"], ["export", "embedded", "a.glb"]])
def test_a_time_without_bounds_is_refused(tmp_path, monkeypatch, words, time_s):
    monkeypatch.chdir(tmp_path)
    done = run(app, ["scene", *words, "--time", time_s])
    assert done.exit_code == 2 and "--time" in done.output
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_glb_is_valid_and_lies_as_the_standard_says(tmp_path):
    city = build_scene(SceneDesign(trees=False))
    data = glb(city.at(1.0), city.materials)
    magic, version, length, text_length, kind = struct.unpack("<5I", data[:20])
    assert (magic, version, length, kind) == (0x46546C67, 2, len(data), 0x4E4F534A)
    document = json.loads(data[20 : 20 + text_length])
    assert len(document["nodes"]) == 2 + len(city.at(1.0).vehicle_id)  # the root, what stands, the vehicles
    turn = np.reshape(document["nodes"][0]["matrix"], (4, 4)).T
    np.testing.assert_array_equal(turn @ [1, 2, 3, 1], [1, 3, -2, 1])  # east x, up y, north into the screen
    for view in document["bufferViews"]:
        assert view["byteOffset"] % 4 == 0
    for accessor in document["accessors"]:
        size = 12 if accessor["type"] == "VEC3" else 4
        assert document["bufferViews"][accessor["bufferView"]]["byteLength"] == size * accessor["count"]
    trimesh = pytest.importorskip("trimesh")
    (tmp_path / "s.glb").write_bytes(data)
    scene = trimesh.load(tmp_path / "s.glb")
    faces = sum(len(scene.geometry[scene.graph[node][1]].faces) for node in scene.graph.nodes_geometry)
    snapshot = city.at(1.0)
    assert faces == len(snapshot.static.faces) + sum(len(snapshot.models[m].faces) for m in snapshot.model)


FCD = "timestep_time;vehicle_id;vehicle_type;vehicle_x;vehicle_y;vehicle_angle\n"


@pytest.mark.parametrize("ending", ["nc", "csv", "parquet"])
def test_converted_traffic_is_that_of_the_scenes_window(tmp_path, ending):
    ways = [(k, name, y) for k in range(30) for name, y in (("a", 3), ("b", 9))]
    rows = [f"{7 + 0.5 * k};{name};car;{5 * k - 60};{y};90" for k, name, y in ways]
    (tmp_path / "mine.csv").write_text(FCD + "\n".join(rows) + "\n7;far;car;5000;0;0")
    path = tmp_path / f"t.{ending}"
    done = run(app, ["scene", "traffic", "--fcd", str(tmp_path / "mine.csv"), "-o", str(path)])
    assert done.exit_code == 0, done.output
    assert "2 vehicles in 14.5 s" in done.output
    traffic = read_fcd(path, (-330, -210, 330, 210))
    _, states = traffic.at(4.0)  # eight steps on, from the bumper to the centre
    np.testing.assert_allclose(states[:, :2], [[-20 - 4.5 / 2, 3], [-20 - 4.5 / 2, 9]], atol=1e-3)
    assert {p.name for p in tmp_path.iterdir()} == {"mine.csv", path.name}


def test_traffic_without_end_is_refused(tmp_path):
    """SUMO was asked for a vehicle each 1e-300 s, which took 40 s of CPU."""
    asked = ["scene", "traffic", "-o", str(tmp_path / "t.nc"), "--insertion-period", "1e-300"]
    done = run(app, asked)
    assert done.exit_code and not list(tmp_path.iterdir())
    message = "`traffic_insertion_period_s` must be greater than or equal to 0.01 s; got 1e-300 s"
    assert message in str(done.exception)


@pytest.mark.sumo
@pytest.mark.slow
def test_sumo_drives_a_scene_as_long_as_asked(tmp_path, monkeypatch):
    if importlib.util.find_spec("sumo") is None:  # imported, it leaves its own PROJ to all later processes
        pytest.skip("needs the extra `traffic`")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path = tmp_path / "t.nc"
    asked = ["--duration", "6", "--insertion-period", "1"]
    done = run(app, ["scene", "traffic", "-o", str(path), *asked])
    assert done.exit_code == 0, done.output
    assert "in 6 s" in done.output
    traffic = read_fcd(path, (-330, -210, 330, 210))
    assert traffic.duration_s == pytest.approx(6.0) and traffic.count.size > 10
