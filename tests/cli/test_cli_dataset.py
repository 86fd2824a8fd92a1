"""``glintrack dataset`` as somebody who wants labels meets it."""

import sys
from pathlib import Path

import pytest

from glintrack.cli import app
from glintrack.cli.dataset import baseline
from glintrack.dataset import BASELINES, SCORES

CASE = """name = "three"
seed = 4
channels = ["pan", "dolp"]
[flight]
off_nadir_deg = 0.0
altitude_m = 3000.0
frames = 2
[sensor]
rows = 64
columns = 80
oversampling = 1
polarizer = "ideal"
demosaic = "bilinear"
"""


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Exit code, stdout and stderr of the program, beside a case file."""
    (tmp_path / "three.toml").write_text(CASE, encoding="utf-8")
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["glintrack", "dataset", *map(str, arguments)])
        try:
            app.main()
            code = 0
        except SystemExit as stop:
            code = stop.code or 0
        out = capsys.readouterr()
        return code, " ".join(out.out.split()), " ".join(out.err.split())

    return call


def test_a_set_is_built_and_found_again(run, three_cars, tmp_path):
    code, said, _ = run("three.toml", "-o", "set")
    assert code == 0 and "1 cases (1 train), 2 frames" in said and "2 frames simulated" in said
    assert (tmp_path / "set" / "coco" / "train.json").is_file()
    code, said, _ = run("build", "three.toml", "-o", "set")
    assert code == 0 and "0 frames simulated" in said and "2 there already" in said


def test_the_standard_set_can_be_foreseen(run, tmp_path):
    code, said, _ = run("standard", "-o", "set", "--dry-run")
    assert code == 0 and "48 cases (36 train, 6 val, 6 test), 960 frames" in said
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("three.toml", "three.toml", "-o", "set"), "`CASE` must be named once each; got 'three' twice"),
        (("three.toml", "-o", "set", "--frames", "0"), "`frames` must lie within"),
        (("three.toml", "-o", "three.toml"), "`output` must be a new or empty folder"),
        (("none.toml", "-o", "set"), "must"),
        (("baseline", "nothing"), "`DATASET` must be a folder that `glintrack dataset` wrote"),
    ],
)
def test_wrong_calls_get_one_sentence(run, tmp_path, arguments, message):
    code, _, err = run(*arguments)
    assert code == 2 and message in err and err.count("glintrack:") == 1
    assert not (tmp_path / "set").exists()


def test_the_table_of_baselines_fits_eighty_columns(monkeypatch, capsys):
    found = {line: dict.fromkeys(SCORES, 12.345) for line in BASELINES}
    monkeypatch.setattr("glintrack.cli.dataset.score_baselines", lambda *asked: found)
    monkeypatch.setenv("COLUMNS", "80")
    baseline(Path("set"))
    told = capsys.readouterr().out
    assert max(map(len, told.splitlines())) <= 80 and "…" not in told
    assert told.count("12.345") == len(found) * len(SCORES)
    assert all(line.rpartition(", ")[0] in told for line in BASELINES)
