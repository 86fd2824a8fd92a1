"""Where nothing can be written, kernels are kept for as long as the program runs."""

import os
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from glintrack.core.kernels import place
from glintrack.core.kernels.place import find_place, tell_place

SOURCE = Path(place.__file__).parents[2]
BOUND = 'mount --bind "$0" "$0" && mount -o remount,ro,bind "$0" && exec "$@"'


def in_a_read_only_system(*command):
    """What a program says whose source cannot be written, and which has no home."""
    known = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    environment = {**known, "HOME": "/proc/none", "PYTHONPATH": str(SOURCE), "PYTHONDONTWRITEBYTECODE": "1"}
    alone = ["unshare", "--mount", "sh", "-c", BOUND, str(SOURCE)]
    if not shutil.which("unshare") or subprocess.run([*alone, "true"], capture_output=True).returncode:
        pytest.skip("needs the right to mount a folder read-only")
    return subprocess.run(
        [*alone, *command], env=environment, capture_output=True, text=True, cwd="/", check=False
    )


def test_a_command_with_kernels_begins_in_a_read_only_system():
    done = in_a_read_only_system(sys.executable, "-m", "glintrack", "track", "/none.csv", "-o", "/tmp/none")
    assert "Traceback" not in done.stderr
    assert done.returncode == 2 and "got /none.csv" in done.stderr.replace("\n", " ")
    assert done.stderr.count("compiled kernels cannot be kept, and are compiled each time (set NUMBA") == 1


@pytest.mark.parametrize("before", ["", "import numba; "])
def test_python_users_need_no_command_for_it(before):
    """Nor does it matter whether numba, which reads its environment once, was there first."""
    asked = before + "from glintrack import track; print('frame', track.start().frame)"
    done = in_a_read_only_system(sys.executable, "-c", asked)
    assert done.returncode == 0 and done.stdout == "frame 0\n", done.stderr
    assert done.stderr.count("compiled kernels cannot be kept") == 1


def test_what_needs_no_kernel_says_nothing_of_them():
    done = in_a_read_only_system(sys.executable, "-m", "glintrack", "--version")
    assert done.returncode == 0 and done.stderr == ""


def test_a_folder_of_its_own_is_left_where_one_can_be_written(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "of mine"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        find_place()
        tell_place()
    assert os.environ["NUMBA_CACHE_DIR"] == str(tmp_path / "of mine")


def test_the_place_found_is_writable_and_goes_with_the_process(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/proc/none")
    monkeypatch.setattr(place, "_is_writable", lambda folder: False)
    monkeypatch.setattr(place.tempfile, "tempdir", str(tmp_path))
    leavers = []
    monkeypatch.setattr(place.atexit, "register", lambda *call, **how: leavers.append((call, how)))
    find_place()
    with pytest.warns(UserWarning, match="compiled kernels cannot be kept"):
        tell_place()
    found = Path(os.environ["NUMBA_CACHE_DIR"])
    assert found.parent == tmp_path and found.is_dir()
    ((leave, *where), how) = leavers[0]
    leave(*where, **how)
    assert not found.exists()
