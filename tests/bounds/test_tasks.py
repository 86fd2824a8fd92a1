"""Tasks measured on three cars that drive over level asphalt, in cities that differ by their noise."""

import numpy as np
import pandas as pd
import pytest

from glintrack.bounds import tasks
from glintrack.bounds.tasks import measure_tasks, summarize_tasks
from glintrack.sensor import read_presets
from tests.plain import plain_case

CASE = plain_case(
    {
        "name": "three cars",
        "flight": {"off_nadir_deg": 0.0, "altitude_m": 3000.0, "rate_hz": 2.0, "frames": 1},
        "sensor": {"rows": 160, "columns": 200, "polarizer": "ideal"},
    }
)


def test_moving_cars_are_found_by_every_sensor(three_cars, monkeypatch):
    monkeypatch.setattr(tasks, "_START_STEP_S", 0.0)  # they leave the frame
    rows = measure_tasks(CASE, "moving", (1, 2), frames=1)
    assert rows["preset"].tolist() == [name for name in read_presets() for _ in (1, 2)]
    assert (rows["vehicles"] == 3).all() and rows["city"].tolist()[:2] == [1, 2]
    assert (rows["found_50"] == 1).all() and (rows["found_200"] == 1).all()


def test_cars_that_all_move_are_no_standing_ones(three_cars):
    with pytest.raises(ValueError, match="must have vehicles for the task"):
        measure_tasks(CASE, "standing", (1, 2), frames=1)


def test_one_city_is_refused():
    for cities in ((1,), (1, 1)):
        with pytest.raises(ValueError, match="must be two different seeds"):
            measure_tasks(CASE, "standing", cities)


def test_gains_are_paired_by_city_with_students_t():
    rows = pd.DataFrame(
        {
            "preset": ["pan"] * 3 + ["rgb"] * 3,
            "city": [1, 2, 3] * 2,
            "vehicles": 10,
            "found_50": [0.2, 0.5, 0.8, 0.3, 0.7, 0.9],
            "found_200": [0.5, 0.6, 0.9, 0.6, 0.8, 1.0],
        }
    )
    found = summarize_tasks(rows)
    np.testing.assert_allclose(found.loc["rgb", ["found_50", "found_200", "gain"]], [1.9 / 3, 0.8, 0.4 / 3])
    np.testing.assert_allclose(
        found.loc["rgb", "half"], 4.303 * np.std([0.1, 0.2, 0.1], ddof=1) / 3**0.5, rtol=1e-3
    )
    np.testing.assert_allclose(found.loc["pan", ["gain", "half"]], 0)
