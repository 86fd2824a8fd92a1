"""A wrong command line: one sentence, exit code 2, before any library is loaded."""

import os
import subprocess
import sys
import typing

import pytest

from glintrack import metrics
from glintrack.cli import polarimetry, scene, score
from glintrack.cli import sensor as sensor_command
from glintrack.render.preview import View
from glintrack.sensor.ghosts import SILICON
from glintrack.sensor.layouts import Demosaicker
from tests.cli.test_cli import program

HEAVY = {"numpy", "scipy", "numba", "xarray", "pandas", "matplotlib", "rasterio"}
OTHER_KEY = 'like = "quickstart"\n[sensor]\npich_um = 3.0\n'


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("study table1 --workers 0", "`--workers` must be greater than or equal to 1, got 0"),
        ("study table1 --memory -1", "`--memory` must be greater than or equal to 0.5, got -1"),
        ("run --frames x", "`--frames` must be a valid integer, got x"),
        (
            "ortho a.png --camera c --pose p -o o.tif --method cubicc",
            "`--method` must be one of 'nearest', 'bilinear', 'cubic', got 'cubicc' (did you mean `cubic`?)",
        ),
        ("ortho a.png", "`--camera` must be given, got none (see `glintrack ortho --help`)"),
        (
            "run --frame 3",
            "`--frame` must be an option of `glintrack run`, got an unknown one (did you mean `--frames`?)",
        ),
        ("run -o", "`-o` must be given a value, got none (see `glintrack --help`)"),
        (
            "run quickstart 7",
            "`glintrack run` must be given no more words than it takes, got 7 too (see `glintrack run "
            "--help`)",
        ),
        (
            "rum",
            "`glintrack` must be followed by a known command, got 'rum' (did you mean `run`?)",
        ),
        ("run --set sensor.rows", "`--set` must be KEY=VALUE, as sensor.pitch_um=8.5, got 'sensor.rows'"),
    ],
)
def test_a_wrong_command_line_is_one_sentence(monkeypatch, capsys, words, sentence):
    assert program(monkeypatch, *words.split()) == 2
    assert capsys.readouterr().err == f"glintrack: {sentence}\n"


def loaded(*words, cwd):
    """Exit code and the libraries that a call of the program loads."""
    code = (
        "import sys\nfrom glintrack.cli.app import main\ntry: main()\n"
        "finally: print('loaded', *sorted(sys.modules), file=sys.stderr)"
    )
    command = [sys.executable, "-c", code, *words]
    done = subprocess.run(command, cwd=cwd, env=os.environ, capture_output=True, text=True, check=False)
    names = done.stderr.split("loaded ")[-1].split()
    assert "glintrack.cli.app" in names, done.stderr
    return done.returncode, set(names)


@pytest.mark.parametrize(
    "words",
    [
        ["--help"],
        ["case", "list"],
        ["run", "quikstart"],
        ["run", "--frames", "0"],
        ["run", "nofile.toml"],
        ["run", "--help"],
        ["study", "table1", "--workers", "0"],
        ["study", "tabel1"],
        ["score", "a.csv"],
        ["ortho", "a.png"],
        ["scene", "preview", "--view", "top"],
        ["sensor", "expose", "quikstart"],
        ["polarimetry", "a.tif"],
    ],
)
def test_a_wrong_command_line_loads_no_library(tmp_path, words):
    """Which takes seconds."""
    code, names = loaded(*words, cwd=tmp_path)
    assert code == (0 if {"--help", "list"} & set(words) else 2)
    assert not names & HEAVY


def test_a_wrong_key_is_told_before_what_flies_is_loaded(tmp_path):
    (tmp_path / "own.toml").write_text(OTHER_KEY, encoding="utf-8")
    for words in (["run", "own.toml"], ["run", "quickstart", "--set", "sensor.pich_um=3"]):
        code, names = loaded(*words, cwd=tmp_path)
        assert code == 2
        assert not names & {"matplotlib", "glintrack.simulate", "glintrack.render"}


def test_a_taken_folder_is_told_before_what_flies_is_loaded(tmp_path):
    for name in ("result-quickstart", "result-other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "kept.txt").write_text("mine", encoding="utf-8")
    for words in (["run"], ["run", "--set", "name=other"], ["run", "braunschweig", "-o", "result-other"]):
        code, names = loaded(*words, cwd=tmp_path)
        assert code == 2
        assert not names & {"matplotlib", "glintrack.simulate", "glintrack.render"}


def test_what_commands_repeat_is_what_the_packages_say():
    """Their own words for choices and defaults spare the load of a package."""
    assert typing.get_args(scene.View) == typing.get_args(View)
    assert typing.get_args(polarimetry.Demosaicker) == typing.get_args(Demosaicker)
    assert sensor_command.SILICON == SILICON
    assert score.MATCH_DISTANCE_M == metrics.MATCH_DISTANCE_M
    assert score.MOVING_SPEED_M_S == metrics.MOVING_SPEED_M_S
