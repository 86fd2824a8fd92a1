"""What was read is accounted for, and printed as the last table of a command."""

import pytest
from rich.console import Console

from glintrack.cli import app
from glintrack.cli.options import print_readings
from glintrack.io.detections import read_truth
from glintrack.io.readings import Reading, collect_readings, report_reading


def test_readings_are_collected_once_and_inner_blocks_hide_theirs():
    report_reading("nobody_collects.csv", "rows", 1, 1)
    with collect_readings() as readings:
        for _ in range(2):
            report_reading(
                "folder/f.csv", "vehicles", 5, 3, {"bicycles": 2, "trams": 0}, ["time zero is 2 s"]
            )
        with collect_readings() as inner:
            report_reading("scratch.csv", "rows", 1, 1)
    assert readings == [Reading("f.csv", "vehicles", 5, 3, (("bicycles", 2),), ("time zero is 2 s",))]
    assert [reading.file for reading in inner] == ["scratch.csv"]


@pytest.mark.parametrize(("used", "left_out"), [(3, {}), (3, {"bicycles": 1}), (6, {})])
def test_a_difference_without_a_reason_is_refused(used, left_out):
    with pytest.raises(ValueError, match=r"`f.obj` must be read whole; got \d of its 5 meshes"):
        report_reading("f.obj", "meshes", 5, used, left_out)


def test_the_table_states_numbers_and_reasons_in_full(capsys):
    reason = "a type that is no road vehicle, as the file's own table of types says, " * 2
    print_readings(Console(soft_wrap=True), [Reading("f.csv", "vehicles", 12345, 12340, ((reason, 5),))])
    said = " ".join(capsys.readouterr().out.split())
    assert (
        "f.csv" in said and "12,345 vehicles" in said and "12,340" in said and f"5: {reason.strip()}" in said
    )


def test_a_command_ends_with_what_was_read(monkeypatch, capsys, tmp_path):
    rows = [f"{t},{10 * t},0" for t in range(12)] + ["5,900,900"]
    rows.sort(key=lambda row: float(row.split(",")[0]))
    (tmp_path / "d.csv").write_text("time_s,east_m,north_m\n" + "\n".join(rows))
    words = ["track", str(tmp_path / "d.csv"), "-o", str(tmp_path / "o"), "--area", "-9", "-9", "200", "9"]
    monkeypatch.setattr("sys.argv", ["glintrack", *words])
    with pytest.raises(SystemExit) as end:
        app.main()
    said = capsys.readouterr().out
    assert end.value.code == 0
    assert "13 detections" in said.rpartition("What was read")[2]
    assert "1: outside -9 -9 200 9 m" in said.rpartition("What was read")[2]


def test_identities_may_be_texts(tmp_path):
    rows = [(t, name, 10.0 * t, k) for k, name in enumerate(("flow.1", "bus 7")) for t in range(3)]
    text = "".join(f"{t},{name},{x},{y}\n" for t, name, x, y in rows)
    (tmp_path / "truth.csv").write_text("time_s,vehicle_id,east_m,north_m\n" + text)
    assert read_truth(tmp_path / "truth.csv")["vehicle_id"].values.tolist() == [0, 0, 0, 1, 1, 1]
    (tmp_path / "truth.csv").write_text("time_s,vehicle_id,east_m,north_m\n" + text + "2,bus 7,1,1\n")
    with pytest.raises(ValueError, match="`vehicle_id` must appear once in each frame"):
        read_truth(tmp_path / "truth.csv")
