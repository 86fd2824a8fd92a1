"""The figures of docs/findings.md are those of its tables."""

import csv
import importlib.util
from pathlib import Path

import numpy as np
import pytest

from glintrack.case.packaged import find_case
from glintrack.scene import build_scene
from glintrack.study import read_plan

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def findings():
    spec = importlib.util.spec_from_file_location("findings", ROOT / "tools" / "tabulate_findings.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_each_figure_with_an_interval_is_in_a_table(findings):
    text = findings.PAGE.read_text(encoding="utf-8")
    assert len(findings.INTERVAL.findall(text)) > 50
    assert findings.strays(text, list(findings.figures())) == []


def test_the_tables_are_those_of_their_rows(findings):
    text = findings.PAGE.read_text(encoding="utf-8")
    assert findings.written(text) == text


@pytest.mark.slow
def test_travel_over_distance_is_that_of_the_recorded_traffic(findings):
    """Moving vehicles in the window over 20 s; the next vehicle ahead within 2 m of their line."""
    cases = {case.scene: case for case in read_plan(find_case("traffic")).cases.values()}
    found = {}
    for scene, case in cases.items():
        city, shares = build_scene(scene), []
        for time_s in case.flight.start_s + np.arange(0, 20, 2.0):
            now = city.truth(time_s)
            place = np.array([now["east_m"], now["north_m"]])
            velocity = np.array([now["east_speed_m_s"], now["north_speed_m_s"]])
            speed = np.hypot(*velocity)
            inside = (abs(place[0]) < 330) & (abs(place[1]) < 210)
            for k in np.flatnonzero((speed > 1) & inside):
                offset, (x, y) = place - place[:, [k]], velocity[:, k] / speed[k]
                along, across = x * offset[0] + y * offset[1], x * offset[1] - y * offset[0]
                ahead = along[(along > 0) & (abs(across) < 2)]
                shares += [speed[k] / ahead.min()] if ahead.size else []
        kind = Path(scene.net_file).name.split(".")[0] if scene.net_file else "city"
        found[kind] = float(np.median(shares))
    assert found == pytest.approx(findings.TRAVEL_OVER_DISTANCE, abs=0.006)


def test_a_figure_that_is_not_there_is_found(findings):
    known = [(-2.84, -4.04, -1.65)]
    assert findings.strays("2.8 (1.7 … 4.0) * more, or −2.8 (−4.0 … −1.7)", known) == []
    assert findings.strays("2.9 (1.7 … 4.0)", known) == ["2.9 (1.7 … 4.0)"]
    assert findings.strays("+2.8 (−4.0 … −1.7)", known) == ["+2.8 (−4.0 … −1.7)"]


def test_a_better_design_is_not_reported_worse(findings):
    rows = findings.known_rows()
    assert len(rows) == 63  # seven levels, three channels, three scores
    assert [row for row, sign in rows if findings.contradicts(row, sign)] == []
    row = {"effect": "-1", "p_max_t": "0.01"}
    assert findings.contradicts(row, 1) and not findings.contradicts(row, -1)
    assert not findings.contradicts(row | {"p_max_t": "0.2"}, 1)


def test_each_row_of_evidence_names_its_status_and_a_command_that_exists():
    with (ROOT / "docs" / "evidence.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["status"] for row in rows} == {"validated", "modelled", "assumed"}
    for row in rows:
        words = row["command"].replace("`", "").replace("python ", "").split(", ")
        assert all((ROOT / word).exists() for word in words), row["subject"]
        assert row["status"] != "validated" or words != [""], (
            f"{row['subject']} has no command that repeats it"
        )
