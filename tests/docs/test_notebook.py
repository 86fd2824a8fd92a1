"""The notebook of the examples: short, and what its cells do, on a smaller array and fewer frames."""

import json
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[2] / "examples" / "two_designs.ipynb"
SHORT = (
    '{"flight.frames": 3, "bound.every": 0, "sensor.oversampling": 1, "sensor.rows": 140, '
    '"sensor.columns": 220}'
)


def cells():
    return [
        "".join(c["source"]) for c in json.loads(NOTEBOOK.read_text())["cells"] if c["cell_type"] == "code"
    ]


def test_it_is_short_and_holds_no_output():
    told = json.loads(NOTEBOOK.read_text())["cells"]
    assert sum(len(cell.splitlines()) for cell in cells()) < 30
    assert all(not c["outputs"] and c["execution_count"] is None for c in told if c["cell_type"] == "code")


@pytest.mark.slow
def test_its_cells_run_in_order(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names, shown = {}, []
    for text in cells():
        shorter = text.replace('{"flight.frames": 12}', SHORT)
        *before, last = shorter.splitlines()
        exec(compile("\n".join(before), "cell", "exec"), names)
        shown.append(eval(compile(last, "cell", "eval"), names))
    oblique, steeper, table = shown
    assert oblique.case.flight.off_nadir_deg == 50 and steeper.case.flight.off_nadir_deg == 20
    changed = {
        key
        for key, value in oblique.case.flight.model_dump().items()
        if value != steeper.case.flight.model_dump()[key]
    }
    assert changed == {"off_nadir_deg"} and oblique.case.sensor == steeper.case.sensor
    assert list(table.columns) == ["50°", "20°"] and table.loc["tracked_per_km2"].notna().all()
    assert (tmp_path / "result-steeper" / "tracks_all.csv").is_file()
