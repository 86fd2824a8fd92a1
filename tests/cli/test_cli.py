"""The program: what it writes, and what wrong input is told."""

import io
import json
import os
import signal
import sys
import tomllib
from contextlib import redirect_stdout
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pyproj
import pytest
import rasterio
import xarray as xr

from glintrack.case.design import Case
from glintrack.cli import app
from glintrack.cli.run import describe_progress
from glintrack.io.tracks import MATCH_COLUMNS, TRACK_COLUMNS, WRITERS
from glintrack.results import run as functions
from tests.conftest import put_three_cars

SMALL = """
name = "three cars"
channels = ["pan", "dolp"]
[flight]
off_nadir_deg = 0.0
altitude_m = 3000.0
frames = 9
[sensor]
rows = 240
columns = 320
oversampling = 1
polarizer = "ideal"
demosaic = "bilinear"
[output]
keep_frames = 2
"""


def program(monkeypatch, *arguments):
    """Exit code of one call."""
    monkeypatch.setattr(sys, "argv", ["glintrack", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        app.main()
    return stop.value.code or 0


@pytest.fixture
def case_file(tmp_path):
    return write_case(tmp_path)


def write_case(folder, text=SMALL):
    path = folder / "case.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """Folder that one call of ``glintrack run`` wrote; its parent holds the case alone."""
    parent = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as monkeypatch:
        put_three_cars(monkeypatch)
        with redirect_stdout(io.StringIO()) as out:
            assert program(monkeypatch, "run", write_case(parent), "-o", parent / "result") == 0
    assert "wrote" in out.getvalue()
    return parent / "result"


def test_a_run_writes_one_whole_folder(monkeypatch, result, tmp_path):
    folder = result
    assert sorted(p.name for p in folder.parent.iterdir()) == ["case.toml", "result"]
    assert Case.from_toml(folder / "case.toml") == Case.from_toml(folder.parent / "case.toml")
    provenance = tomllib.loads((folder / "provenance.toml").read_text())
    assert provenance["frames_done"] == 9 and provenance["versions"]["numpy"] == np.__version__
    tracks = pd.read_csv(folder / "tracks_pan.csv")
    assert list(tracks.columns) == [*TRACK_COLUMNS, *MATCH_COLUMNS]
    assert {p.name for p in folder.glob("tracks_pan*")} == {f"tracks_pan{ending}" for ending in WRITERS}
    truth, typed = pd.read_csv(folder / "truth.csv"), pd.read_parquet(folder / "truth.parquet")
    assert list(truth.columns) == list(typed.columns) and len(truth) == len(typed) > 0
    np.testing.assert_allclose(truth, typed.astype(float), rtol=1e-5)  # the CSV has six digits
    tree = xr.open_datatree(folder / "result.nc", engine="h5netcdf")
    for about in (tree.attrs, provenance):  # tables are in local coordinates, whose origin is stated
        assert about["crs"] == "EPSG:32618" and about["time_zero"] == "2010-07-15T20:00:00+00:00"
        assert (about["origin_easting_m"], about["origin_northing_m"]) == (288000.0, 4781000.0)
    assert len(tracks) == tree["pan/tracks"].sizes["row"] > 0
    scores = pd.read_csv(folder / "scores_pan.csv")
    np.testing.assert_allclose(scores["completeness"], tree["pan"]["completeness"], atol=1e-5)
    again = tmp_path / "again.json"  # the tables of a result can be scored like anybody's
    files = (folder / "tracks_pan.csv", folder / "truth.csv")
    assert program(monkeypatch, "score", *files, "--json", again) == 0
    purity = json.loads(again.read_text())["purity"]
    assert purity == pytest.approx(float(tree["pan"].attrs["purity"]), abs=1e-6)
    for name in ("view_rgb", "view_dolp", "rgb", "pan", "dolp", "completeness"):
        assert (folder / "pictures" / f"{name}.png").stat().st_size > 5000


def test_frames_and_lines_lie_where_the_cars_are(result):
    """The bright car in the GeoTIFF, its track in GeoJSON and the truth agree on the map."""
    folder = result
    path = sorted((folder / "frames").glob("pan_*.tif"))[-1]
    truth = pd.read_csv(folder / "truth.csv")
    with rasterio.open(path) as file:
        pan, time_s = file.read(1), float(file.tags()["time_s"])
        assert file.crs.to_string() == "EPSG:32618" and file.descriptions[0] == "pan"
        assert file.units == (*["W m-2 sr-1 um-1"] * 4, "1")
        row, column = np.unravel_index(np.nanargmax(pan), pan.shape)
        easting, northing = file.xy(row, column)
    now = truth[np.isclose(truth["time_s"], time_s)]
    distance = np.hypot(now["east_m"] + 288000 - easting, now["north_m"] + 4781000 - northing)
    half_a_car_and_a_cell_m = 3.3
    assert distance.min() < half_a_car_and_a_cell_m
    features = json.loads((folder / "tracks_pan_points.geojson").read_text())["features"]
    to_utm = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32618", always_xy=True)
    assert features
    for feature in features:
        found, (x, y) = feature["properties"], to_utm.transform(*feature["geometry"]["coordinates"])
        assert (x, y) == pytest.approx((found["east_m"], found["north_m"]), abs=2e-3)
        then = truth[np.isclose(truth["time_s"], found["time_s"])]
        place = then["east_m"] + 288000 - x, then["north_m"] + 4781000 - y
        assert np.hypot(*place).min() < half_a_car_and_a_cell_m


@pytest.mark.parametrize("frames", [0, 4])
def test_an_interrupt_leaves_a_readable_result(monkeypatch, three_cars, case_file, tmp_path, capsys, frames):
    real = functions.Recorder.record

    def stop(self, epoch):
        if epoch.index == frames:
            os.kill(os.getpid(), signal.SIGINT)
        real(self, epoch)

    monkeypatch.setattr(functions.Recorder, "record", stop)
    assert program(monkeypatch, "run", case_file, "-o", tmp_path / "cut") == 130
    assert f"interrupted after {frames} of 9 frames" in capsys.readouterr().out.replace("\n", " ")
    tree = xr.open_datatree(tmp_path / "cut" / "result.nc", engine="h5netcdf")
    assert tree["pan"].sizes["time"] == frames


MESH = "o house\nv 0 0 0\nv 100 0 0\nv 100 100 0\nv 0 100 0\nv 0 0 20\nf 1 2 3\nf 1 3 4\nf 1 2 5\n"
ON_A_DEM = """[scene]
city = "mesh"
mesh_file = "mesh.obj"
mesh_up = "z"
materials_file = "materials.toml"
dem_file = "dem.tif"
crs = "EPSG:32618"
origin_m = [287900.0, 4779100.0]
"""


@pytest.mark.parametrize(
    ("crs", "low_m", "vertex", "sentence"),
    [
        ("EPSG:32618", 20.0, "100 100 0", ""),
        ("EPSG:32633", 20.0, "100 100 0", "`dem_file` must cover the scene; got no height in 100 %"),
        ("EPSG:32618", -32768.0, "100 100 0", "`dem_file` must hold heights of -500 to 9000 m; got -32768"),
        ("EPSG:32618", 1e30, "100 100 0", "`dem_file` must hold heights of -500 to 9000 m; got 1e+30"),
        ("EPSG:32618", 20.0, "100 nan 0", "`mesh_file` must have finite coordinates; got 1 of 5 vertices"),
        (
            "EPSG:32618",
            20.0,
            "100 100 1e30",
            "`mesh_file` must be 20 to 20000 m wide and at most 2000 m tall",
        ),
    ],
)
def test_a_check_opens_the_files_that_a_case_names(
    monkeypatch, tmp_path, capsys, crs, low_m, vertex, sentence
):
    (tmp_path / "mesh.obj").write_text(MESH.replace("100 100 0", vertex))
    (tmp_path / "materials.toml").write_text('[mesh]\n"*" = "panel_20"\n')
    (tmp_path / "case.toml").write_text(ON_A_DEM)
    heights = np.full((90, 90), 20.0, np.float32)
    heights[30:40, 30:40] = low_m
    about = {"height": 90, "width": 90, "count": 1, "dtype": "float32", "crs": crs}
    corner = rasterio.transform.from_origin(286550, 4780450, 30, 30)
    with rasterio.open(tmp_path / "dem.tif", "w", driver="GTiff", transform=corner, **about) as file:
        file.write(heights, 1)
    code = program(monkeypatch, "case", "check", tmp_path / "case.toml")
    told = capsys.readouterr()
    if sentence:
        assert code == 2
        assert sentence in told.err and len(told.err.strip().splitlines()) == 1
    else:
        assert code == 0 and "is a valid case" in told.out and "field of view" in told.out


def test_wrong_calls_get_one_sentence_and_leave_nothing(monkeypatch, three_cars, case_file, tmp_path, capsys):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "mine.txt").touch()
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("[flight]\naltitud_m = 1\n")
    before = sorted(tmp_path.iterdir())
    for arguments, sentence in (
        (("run", case_file, "-o", tmp_path / "there"), "`output` must be a new or empty folder"),
        (("run", wrong, "-o", tmp_path / "new"), "Did you mean `altitude_m`?"),
        (("run", tmp_path / "none.toml"), "`case` must be a readable file; got"),
        (("case", "check", wrong), "Did you mean `altitude_m`?"),
    ):
        assert program(monkeypatch, *arguments) == 2
        told = capsys.readouterr().err
        assert sentence in told and told.startswith("glintrack: ") and told.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


def test_a_fault_while_writing_leaves_nothing(monkeypatch, three_cars, tmp_path):
    case_file = write_case(tmp_path, SMALL.replace("frames = 9", "frames = 2"))

    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("glintrack.results.run.write_result", full)
    monkeypatch.setattr(sys, "argv", ["glintrack", "run", str(case_file), "-o", str(tmp_path / "full")])
    with pytest.raises(SystemExit) as stop:
        app.main()
    assert stop.value.code == 2
    assert [p.name for p in tmp_path.iterdir()] == ["case.toml"]


def test_the_schema_lists_every_table(monkeypatch, capsys):
    assert program(monkeypatch, "case", "schema", "--json") == 0
    schema = json.loads(capsys.readouterr().out)
    assert set(Case.model_fields) == set(schema["properties"])
    assert program(monkeypatch, "case", "schema") == 0
    short = capsys.readouterr().out
    assert "[track.detect]" in short and "pitch_um" not in short and len(short.splitlines()) < 30
    assert program(monkeypatch, "case", "schema", "sensor.pitch_um") == 0
    one = capsys.readouterr().out
    assert "pitch_um" in one and "µm" in one and "≥ 1, ≤ 100" in one and "focal_length_mm" not in one
    assert program(monkeypatch, "case", "schema", "--all") == 0
    said = capsys.readouterr().out
    assert "[sensor.optics]" in said and "pitch_um" in said and "≥ 1, ≤ 100" in said
    assert program(monkeypatch, "case", "schema", "flight") == 0
    assert "altitude_m" in (said := capsys.readouterr().out) and "pitch_um" not in said
    assert program(monkeypatch, "case", "schema", "fligt") == 2
    assert "Did you mean `flight`" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["quickstart", "braunschweig"])
def test_packaged_cases_are_valid(monkeypatch, name, capsys):
    assert program(monkeypatch, "case", "check", name) == 0
    said = capsys.readouterr().out
    assert "30 good, 1 not stated\n" in said and "e+0" not in said
    assert said.splitlines()[-1] == "conclusion: good. No quantity of the design limits tracking."
    assert max(len(line) for line in said.splitlines() if line.startswith("  ")) <= 80


def test_a_bad_case_is_simulated_with_force_only(monkeypatch, three_cars, case_file, tmp_path, capsys):
    text = SMALL.replace("frames = 9", "frames = 9\nstare_east_m = 5000")
    case_file.write_text(f"{text}[scene]\nwidth_m = 660\nheight_m = 420\n", encoding="utf-8")
    assert program(monkeypatch, "run", case_file, "-o", tmp_path / "out") == 2
    error = capsys.readouterr().err
    assert "must have no bad quantity; got 1: the stare point is" in error and "--force" in error
    assert not (tmp_path / "out").exists() and error.count("\n") == 1
    assert program(monkeypatch, "case", "check", case_file, "--json") == 1
    records = json.loads(capsys.readouterr().out)
    assert [one["name"] for one in records if one["answer"] == "bad"] == ["beyond_window"]
    monkeypatch.setattr("glintrack.cli.run.is_complete", lambda: True)
    monkeypatch.setattr("glintrack.cli.run.run_case", lambda *arguments: pytest.fail("simulated", False))
    with pytest.raises(pytest.fail.Exception):
        program(monkeypatch, "run", case_file, "-o", tmp_path / "out", "--force")
    said = capsys.readouterr().out
    assert said.startswith("bad: stare point beyond window ") and "\nwindow: 660 m × 420 m" in said
    assert "\nexpected time on this machine: " in said and "the loss budget takes" in said


def test_progress_says_that_the_ground_is_learnt_before_the_first_tracks():
    """At 2 Hz the ground takes 2 frames, and reports have a lag of 3."""
    for index, tracked, text in (
        (2, 0, "learning the ground, first tracks from about frame 6"),
        (2, 1, "1/3 moving vehicles tracked now"),
        (5, 0, "0/3 moving vehicles tracked now"),
    ):
        score = SimpleNamespace(valid=np.arange(3) < tracked, should=np.ones(3, bool))
        assert describe_progress(SimpleNamespace(index=index, score=score), Case()) == text
