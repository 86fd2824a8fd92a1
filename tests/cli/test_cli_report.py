"""``glintrack report``, ``view`` and ``video``: what they write, and what wrong input is told."""

import pytest

from tests.cli.test_cli import program
from tests.report.made import write_small_result


@pytest.fixture
def folder(tmp_path):
    return write_small_result(tmp_path / "result")


def test_report_writes_one_file(monkeypatch, folder, tmp_path, capsys):
    assert program(monkeypatch, "report", folder, "-o", tmp_path / "out.html") == 0
    assert "wrote" in capsys.readouterr().out
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.html", "result"]


@pytest.mark.parametrize(
    ("content", "reason"), [(None, "result.nc is missing"), (b"no NetCDF", "result.nc cannot be read")]
)
def test_a_result_that_cannot_be_read_is_one_sentence(monkeypatch, folder, tmp_path, capsys, content, reason):
    (folder / "result.nc").unlink()
    if content:
        (folder / "result.nc").write_bytes(content)
    assert program(monkeypatch, "report", folder, "-o", tmp_path / "out.html") == 2
    said = capsys.readouterr().err
    assert f"`result` must be a finished result; got {folder}: {reason}" in said and said.count("\n") == 1
    assert not (tmp_path / "out.html").exists()


def test_report_says_what_is_missing(monkeypatch, folder, tmp_path, capsys):
    (folder / "case.toml").unlink()
    assert program(monkeypatch, "report", folder, "-o", tmp_path / "out.html") == 0
    assert "note: case.toml is missing" in capsys.readouterr().out


def test_video_writes_a_gif(monkeypatch, folder, tmp_path):
    assert program(monkeypatch, "video", folder, "-o", tmp_path / "out.gif", "--width", 320) == 0
    assert (tmp_path / "out.gif").stat().st_size > 1000


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("report", "{}/none"), "`result` must be a folder that `glintrack run` wrote"),
        (("report", "{}"), "without any of case.toml"),
        (("report", "{}/result", "{}/result"), "`report` must get one result; got 2"),
        (("video", "{}", "-o", "{}/x.gif"), "without any of case.toml"),
        (("view", "{}"), "without any of case.toml"),
        (("report", "{}/result", "-o", "{}/x.pdf"), "`output` must end in .html"),
        (
            ("report", "{}/result", "-o", "{}/x.html", "--base", "{}/no.toml"),
            "`case` must be a readable file; got",
        ),
        (("report", "{}/result", "-o", "{}/no/x.html"), "`output` must be a file in an existing folder"),
        (("video", "{}/result", "-o", "{}/no/x.mp4"), "`output` must be a file in an existing folder"),
        (("video", "{}/result", "-o", "{}/x.gif", "--pictures", "ir"), "`pictures` must be in the film"),
        (("view", "{}/result", "--host", "300.1.1.1"), "must be free to listen on"),
    ],
)
def test_wrong_input_is_one_sentence(monkeypatch, folder, capsys, arguments, sentence):
    filled = [a.format(folder.parent) for a in arguments]
    assert program(monkeypatch, *filled) == 2
    said = capsys.readouterr().err
    assert sentence in said and said.count("\n") == 1
