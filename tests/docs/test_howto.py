"""The scripts of the how-to pages run as they stand there, over three frames of the page's own case."""

import re
import runpy
import sys
from pathlib import Path

import pytest

from glintrack import score, track_detections
from glintrack.dataset import build_dataset, plan_dataset
from glintrack.io.detections import read_detections
from tests.plain import plain_case

HOWTO = Path(__file__).parents[2] / "docs" / "howto"


def test_a_trained_detector_finds_cars_of_a_city_that_it_has_not_seen(
    three_cars, tmp_path, monkeypatch, capsys
):
    """Three boxes on asphalt in both cities: hardly a test of learning, but of every step of the page."""
    design = {
        "seed": 4,
        "flight": {"off_nadir_deg": 0.0, "altitude_m": 3000.0, "frames": 8, "rate_hz": 2.0},
        "sensor": {"rows": 240, "columns": 320},
    }
    cases = [
        plain_case({**design, "name": name, "scene": {"city": city}})
        for name, city in (("first", "embedded"), ("second", "braunschweig"))
    ]
    build_dataset(plan_dataset(cases), tmp_path / "my_set")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["my_trained_detector.py", "my_set"])
    runpy.run_path(str(HOWTO / "my_trained_detector.py"), run_name="__main__")
    assert "second:" in capsys.readouterr().out
    tracked = track_detections(read_detections(tmp_path / "second.detections.csv"))
    scores = score(tracked.rows, tmp_path / "second.truth.csv")
    assert scores["completeness"] > 0.5 and scores["purity"] > 0.9


@pytest.mark.parametrize("name", ["my_detector", "my_tracker"])
def test_a_script_of_a_page_runs(tmp_path, monkeypatch, capsys, name):
    page = (HOWTO / "my_tracker.md").read_text(encoding="utf-8")
    case = re.search(r"```toml\n(# small\.toml.*?)```", page, re.DOTALL)[1]
    (tmp_path / "small.toml").write_text(case.replace("frames = 10", "frames = 3"), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(HOWTO / f"{name}.py"), run_name="__main__")
    assert re.search(r"\d", capsys.readouterr().out)
