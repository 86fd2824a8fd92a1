"""The scripts of the how-to pages run as they stand there, over three frames of the page's own case."""

import re
import runpy
from pathlib import Path

import pytest

HOWTO = Path(__file__).parents[2] / "docs" / "howto"


@pytest.mark.parametrize("name", ["my_detector", "my_tracker"])
def test_a_script_of_a_page_runs(tmp_path, monkeypatch, capsys, name):
    page = (HOWTO / "my_tracker.md").read_text(encoding="utf-8")
    case = re.search(r"```toml\n(# small\.toml.*?)```", page, re.DOTALL)[1]
    (tmp_path / "small.toml").write_text(case.replace("frames = 10", "frames = 3"), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(HOWTO / f"{name}.py"), run_name="__main__")
    assert re.search(r"\d", capsys.readouterr().out)
