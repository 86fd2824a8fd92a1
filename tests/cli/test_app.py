"""The program's front: commands by name, their help, the version, and other values of keys."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

import glintrack
from glintrack.cli.app import COMMANDS, load_command, load_program
from glintrack.cli.run import parse_changes
from tests.cli.test_cli import program

CLI = Path(glintrack.__file__).parent / "cli"


@pytest.mark.parametrize("name", COMMANDS)
def test_the_list_says_of_each_command_what_its_own_help_begins_with(name):
    help = " ".join((load_command(name).help or "").split())
    assert help.startswith(COMMANDS[name]), help


def test_every_file_is_a_command_or_shared_by_some():
    files = {path.stem for path in CLI.glob("*.py")} - {"__init__", "app", "options"}
    assert set(COMMANDS) - files == {"view", "video", "warm-up"} and files < set(COMMANDS)
    assert set(load_program().commands) == set(COMMANDS)


def test_the_version(monkeypatch, capsys):
    assert program(monkeypatch, "--version") == 0
    assert capsys.readouterr().out.strip() == f"glintrack {glintrack.__version__}"


@pytest.mark.parametrize(("given", "kept"), [(None, "1"), ("2", "2")])
def test_products_keep_to_one_thread_unless_told_otherwise(given, kept):
    """The program sets it before it loads NumPy, whose helpers spin."""
    code = (
        "import os, sys\nimport glintrack.cli\nassert 'numpy' not in sys.modules\n"
        "from glintrack.cli.app import main\n"
        "try: main()\nfinally: print(os.environ['OPENBLAS_NUM_THREADS'])"
    )
    environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    environment |= {} if given is None else {"OPENBLAS_NUM_THREADS": given}
    told = subprocess.run(
        [sys.executable, "-c", code, "--version"], env=environment, capture_output=True, text=True, check=True
    )
    assert told.stdout.split()[-1] == kept


def test_a_wrong_command_is_told_the_nearest(monkeypatch, capsys):
    assert program(monkeypatch, "rum") == 2
    assert "'run'" in capsys.readouterr().err


@pytest.mark.skipif(os.name != "posix", reason="how a shell closes a stream")
@pytest.mark.parametrize("closed", [">&-", ">&- 2>&-", "<&- >&-"])
def test_a_stream_that_is_closed_takes_nothing_in(closed):
    line = f'exec "{sys.executable}" -m glintrack case schema {closed}'
    done = subprocess.run(["sh", "-c", line], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_warning_is_one_sentence(monkeypatch):
    before = warnings.formatwarning
    monkeypatch.setattr(warnings, "formatwarning", before)  # and put back after
    assert program(monkeypatch, "--version") == 0  # from here on the program speaks
    ours = warnings.formatwarning("the traffic\x1b[2J jams", UserWarning, "traffic.py", 163)
    assert ours == "glintrack: warning: the traffic\\x1b[2J jams\n"
    assert "file.py:3" in warnings.formatwarning("old", DeprecationWarning, "file.py", 3)


def test_changes_are_read_as_toml():
    read = parse_changes(
        ["sensor.pitch_um=8.5", 'channels=["pan"]', "track.motion.model = imm", "output.quality=true"]
    )
    assert read == {
        "sensor.pitch_um": 8.5,
        "channels": ["pan"],
        "track.motion.model": "imm",
        "output.quality": True,
    }
    with pytest.raises(ValueError, match="`--set` must be KEY=VALUE"):
        parse_changes(["sensor.pitch_um"])


def test_wrong_changes_are_all_told_before_anything_flies(monkeypatch, capsys, tmp_path):
    wrong = ["--set", "sensor.pich_um=8.5", "--set", "flight.frames=0"]
    assert program(monkeypatch, "run", "quickstart", *wrong, "-o", tmp_path / "out") == 2
    said = capsys.readouterr().err
    assert "Did you mean `pitch_um`" in said and "`flight.frames`" in said
    assert list(tmp_path.iterdir()) == []


def test_a_wrong_name_of_a_case_is_told_the_nearest(monkeypatch, capsys, tmp_path):
    assert program(monkeypatch, "run", "quikstart", "-o", tmp_path / "out") == 2
    assert "Did you mean `quickstart`" in capsys.readouterr().err
