"""The benchmark of the loop and the scoreboard over a flight above three cars."""

import json

import pytest

from benchmarks import loop
from tests.bounds.test_run import case
from tools import scoreboard

pytestmark = pytest.mark.slow


def test_the_frame_total_is_among_the_rows(three_cars):
    rows = {row["name"]: row for row in loop.rows_of(loop.THREE, case(bound={"every": 0}))}
    assert rows["frame_total"]["value"] > 0 and rows["frame_total"]["unit"] == "ms"
    assert {"processor", "light", "sensor", "track"} <= set(rows)
    assert {"name", "value", "unit", "peer", "ratio"} <= set(rows["frame_total"])
    assert json.loads(json.dumps(list(rows.values())))
    other = loop.rows_of("pan", case(bound={"every": 0}, flight={"frames": 6}))
    assert other[0]["name"] == "frame_total, pan"


def test_three_cars_are_on_the_scoreboard(three_cars):
    rows = list(scoreboard.track_rows({"cars": case(bound={"every": 0})}, (31, 32), None))
    found = {row.quantity: row for row in rows}
    assert set(found) == set(scoreboard.QUANTITIES) and found["custody"].channel == "pan"
    assert found["completeness_visible"].value > 0.9
    assert found["completeness_visible"].low <= found["completeness_visible"].value
