"""``glintrack bound --task`` as a user meets it."""

import sys

import pandas as pd
import pytest
from typer.testing import CliRunner

from glintrack.bounds import tasks
from glintrack.cli import bound as command
from glintrack.cli.app import app
from glintrack.core.installation import MissingExtraError

ROWS = pd.DataFrame(
    {
        "task": "standing",
        "preset": ["pan", "pan", "superpixel", "superpixel"],
        "city": [7, 8, 7, 8],
        "vehicles": [1000, 1200, 1000, 1200],
        "found_50": [0.4, 0.5, 0.5, 0.62],
        "found_200": [0.6, 0.7, 0.7, 0.8],
    }
)


@pytest.fixture
def asked(monkeypatch):
    calls = []
    monkeypatch.setattr(command, "measure_tasks", lambda *a: calls.append(a) or ROWS)
    return calls


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_a_table_is_printed_and_its_rows_are_written(tmp_path, asked, ending):
    out = tmp_path / f"rows.{ending}"
    words = ["bound", "--task", "standing", "--cities", "2", "--seed", "7", "-o", str(out)]
    told = CliRunner().invoke(app, words)
    assert told.exit_code == 0, told.output
    assert "2,200 cases" in told.output and "cities 7 to 8, 3 frames each" in told.output
    assert "superpixel" in told.output and "0.560" in told.output and "+0.110 ± 0.127" in told.output
    (case, task, cities, frames) = asked[0]
    assert (case.name, task, list(cities), frames) == ("quickstart", "standing", [7, 8], 3)
    read = pd.read_csv(out) if ending == "csv" else pd.read_parquet(out)
    pd.testing.assert_frame_equal(read, ROWS)


def test_another_ending_is_refused_before_anything_is_measured(tmp_path, asked):
    told = CliRunner().invoke(app, ["bound", "--task", "moving", "-o", str(tmp_path / "rows.nc")])
    assert told.exit_code != 0 and "must be a .csv or .parquet file" in str(told.exception)
    assert not asked


def test_a_missing_extra_is_named_before_a_city_is_built(monkeypatch):
    monkeypatch.setitem(sys.modules, "sklearn.ensemble", None)
    monkeypatch.setattr(tasks, "_observe_city", lambda *_: pytest.fail("a city was simulated"))
    told = CliRunner().invoke(app, ["bound", "--task", "standing"])
    assert isinstance(told.exception, MissingExtraError) and "optimize" in str(told.exception)
