"""A wrong command line is one sentence and exit code 2."""

import pytest

from tests.cli.test_cli import program


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ("study table1 --workers 0", ("--workers", "greater than or equal to 1")),
        ("run --frames x", ("`--frames` must be a whole number; got 'x' (see",)),
        (
            "sensor ghosts relay --pitch-um 3,45",
            ("`--pitch-um` must be a number in µm; got '3,45'. Write 3.45",),
        ),
        ("sensor ghosts relay --gap-mm 2,000", ("got '2,000'. Write 2000 or 2.000, with a point",)),
        ("score a b --match-m 20m", ("a number in m; got '20m'. Write the number without its unit",)),
        ("score a b --area 0 1,5 2 3", ("`--area` must be a number in m; got '1,5'. Write 1.5",)),
        ("score a b --area 0,1,2,3", ("'--area' requires 4 arguments separated by spaces",)),
        ("run --require custody>=0,8", ("got '0,8'. Write 0.8, with a point",)),
        ("run --set sensor.pitch_um=3,45um", ("got '3,45um'. Write 3.45, with a point. Write the number",)),
        ("ortho a.png --camera c --pose p -o o.tif --method cubicc", ("--method", "cubicc", "bilinear")),
        ("ortho a.png", ("--camera", "glintrack ortho --help")),
        ("run --frame 3", ("--frame", "--frames", "glintrack run --help")),
        ("run quickstart 7", ("7", "glintrack run --help")),
        ("rum", ("rum", "run")),
        ("device", ("command", "glintrack device --help")),
        ("run --set sensor.rows", ("`--set` must be KEY=VALUE, as sensor.pitch_um=8.5; got 'sensor.rows'",)),
    ],
)
def test_a_wrong_command_line_is_one_sentence(monkeypatch, capsys, words, parts):
    assert program(monkeypatch, *words.split()) == 2
    said = capsys.readouterr().err
    assert said.startswith("glintrack: ") and said.count("\n") == 1
    assert all(part in said for part in parts), said


def test_a_taken_folder_is_refused_before_the_case_is_simulated(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    for name in ("result-quickstart", "result-other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "kept.txt").write_text("mine", encoding="utf-8")
    for words in (["run"], ["run", "--set", "name=other"], ["run", "braunschweig", "-o", "result-other"]):
        assert program(monkeypatch, *words) == 2
        assert "new or empty folder" in capsys.readouterr().err
