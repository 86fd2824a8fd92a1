"""What is installed is pinned: every dependency, and the lock with hashes has the constraints' versions."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
PIN = re.compile(r"^([A-Za-z0-9._-]+)==([^\s;\\]+)", re.MULTILINE)


def pins(name):
    found = PIN.findall((ROOT / name).read_text(encoding="utf-8"))
    return {(package.lower().replace("_", "-"), version) for package, version in found}


def asked():
    """Names of all requirements of pyproject.toml, extras and all."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lists = [project["dependencies"], *project["optional-dependencies"].values()]
    names = {re.match(r"[A-Za-z0-9._-]+", line)[0].lower().replace("_", "-") for row in lists for line in row}
    return names - {"glintrack"}


def test_every_dependency_is_pinned():
    loose = asked() - {name for name, _ in pins("constraints.txt")}
    assert loose == set(), "run: python tools/lock.py"


def test_constraints_are_the_lock_without_hashes():
    assert pins("constraints.txt") == pins("requirements.lock"), "run: python tools/lock.py"
    text = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    assert text.count("==") <= text.count("--hash=sha256:")


def test_complete_brings_every_extra():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    brought, waiting = set(), ["complete"]
    while waiting:
        for line in extras[waiting.pop()]:
            if named := re.match(r"glintrack\[([^\]]+)\]", line):
                waiting += set(named[1].split(",")) - brought
                brought |= set(named[1].split(","))
    assert brought == set(extras) - {"complete"}
