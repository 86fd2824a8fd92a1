"""A run as CI's fails on a test that skips without a good reason, and on no other."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

HOOKS = Path(__file__).parents[1] / "conftest.py"


@pytest.mark.parametrize(
    ("body", "options", "code"),
    [
        ("pytest.skip('needs the extra em')", [], 0),
        ("pytest.skip('needs the extra em')", ["--no-unexpected-skip"], 1),
        ("pytest.importorskip('no_such_module')", ["--no-unexpected-skip"], 1),
        ("pytest.skip('needs the right to mount a tmpfs')", ["--no-unexpected-skip"], 0),
        ("assert True", ["--no-unexpected-skip"], 0),
        ("assert False", ["--no-unexpected-skip"], 1),
    ],
)
def test_only_allowed_reasons_skip(tmp_path, body, options, code):
    (tmp_path / "conftest.py").write_text(HOOKS.read_text(encoding="utf-8"), encoding="utf-8")
    (tmp_path / "test_it.py").write_text(f"import pytest\n\ndef test_it():\n    {body}\n", encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--rootdir", str(tmp_path), *options]
    env = {k: v for k, v in os.environ.items() if k != "PYTEST_ADDOPTS"}  # the outer run may have the switch
    done = subprocess.run(
        [*command, str(tmp_path)], cwd=tmp_path, env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == code, done.stdout
    assert ("UNEXPECTED SKIP" in done.stdout) == (code == 1 and body != "assert False")


def test_every_test_of_the_slow_list_exists():
    lines = (HOOKS.parent / "tests" / "slow.txt").read_text(encoding="utf-8").splitlines()
    for line in (line for line in lines if "::" in line):
        path, _, name = line.partition("::")
        assert f"def {name.rsplit('::')[-1]}(" in (HOOKS.parent / path).read_text(encoding="utf-8"), line
