"""Scores, intervals and counts of the scoreboard, on three cars and small inputs."""

import math

import numpy as np
import pytest
import xarray as xr

from tools import scoreboard

AREA_M = (-100.0, -100.0, 100.0, 100.0)
KM2 = 0.04
FRAMES, FIRST = 6, 2


def three_cars():
    """Truth of three cars that drive east at 10 m/s, and tracks of two of them with one false track.

    One track changes its id in the fourth frame; in the first two frames nothing is tracked.
    """
    truth, tracks = [], []
    for k in range(FRAMES):
        for car, north in enumerate((-20.0, 0.0, 20.0)):
            truth.append((float(k), car, 10.0 * k - 30, north))
        if k >= FIRST:
            tracks.append((float(k), 5, 10.0 * k - 30, -20.0))
            tracks.append((float(k), 6 if k < 4 else 8, 10.0 * k - 30, 0.0))
            tracks.append((float(k), 7, -80.0, 80.0))
    return table(truth, "vehicle_id"), table(tracks, "track_id")


def table(rows, ident):
    time_s, ids, east, north = map(np.array, zip(*rows, strict=True))
    columns = {"time_s": time_s, ident: ids, "east_m": east, "north_m": north}
    if ident == "vehicle_id":
        columns |= {
            "east_speed_m_s": 0 * east + 10,
            "north_speed_m_s": 0 * east,
            "visible_fraction": 0 * east + 1,
        }
    return xr.Dataset({name: ("row", values) for name, values in columns.items()})


def test_a_flight_is_scored_without_its_first_frames():
    truth, tracks = three_cars()
    scores = scoreboard.score_flight(tracks, truth, AREA_M, FIRST)
    assert scores["completeness_visible"] == pytest.approx(2 / 3)
    assert scores["false_per_km2"] == pytest.approx(1 / KM2)
    assert scores["identity_switches"] == 1
    assert scores["custody"] == pytest.approx((1 + 0.5 + 0) / 3)
    whole = scoreboard.score_flight(tracks, truth, AREA_M, 0)
    assert whole["completeness_visible"] == pytest.approx(4 / 6 * 2 / 3)


def test_intervals_are_students():
    mean, low, high = scoreboard.mean_and_interval([1.0, 2.0, 3.0, math.nan])
    assert (mean, high - mean) == (2.0, pytest.approx(4.302653 / math.sqrt(3)))
    assert mean - low == pytest.approx(high - mean)
    assert scoreboard.mean_and_interval([5.0])[0] == 5.0
    assert np.isnan(scoreboard.mean_and_interval([5.0])[1:]).all()


def test_keys_of_nested_tables_are_counted_once():
    reference = {"$ref": "#/$defs/Sensor"}
    schema = {
        "properties": {"name": {"type": "string"}, "sensor": reference, "others": {"items": reference}},
        "$defs": {
            "Sensor": {"properties": {"rows": {}, "kind": {"$ref": "#/$defs/Kind"}}},
            "Kind": {"enum": []},
        },
    }
    assert scoreboard.count_keys(schema) == 3


def test_long_signatures_but_not_commands(tmp_path):
    long = ", ".join(f"a{k}" for k in range(11))
    heads = ("", "@app.command()\n", "@njit(cache=True)\n")
    text = "\n".join(f"{head}def f{k}({long}):\n    pass\n" for k, head in enumerate(heads))
    path = tmp_path / "module.py"
    path.write_text(text, encoding="utf-8")
    assert scoreboard.count_long_signatures([path]) == 1
    assert scoreboard.count_lines([path]) == text.count("\n")


def test_words_outside_code(tmp_path):
    path = tmp_path / "page.md"
    path.write_text("# Three words here\n```bash\nnot these\n```\nand two\n", encoding="utf-8")
    assert scoreboard.count_words([path]) == 5


def test_a_table_with_another_commits_values(tmp_path):
    rows = [
        scoreboard.Row("tracks", "a", "pan", "custody", 0.5, 0.4, 0.6),
        scoreboard.Row("code", "", "", "m", 1234),
    ]
    scoreboard.write_csv(tmp_path / "old.csv", rows[:1])
    lines = scoreboard.markdown(rows, scoreboard.read_values(tmp_path / "old.csv")).splitlines()
    assert lines[2] == "| tracks | a | pan | custody | 0.5 | 0.5 | 0.4 to 0.6 | 1 |"
    assert lines[3] == "| code |  |  | m |  | 1,234 |  | 1 |"
