"""Pin every package that the extra ``complete`` needs, for all Pythons that are promised, and check the pins.

Writes ``requirements.lock``, with the hash of every file (``pip install --require-hashes -r``, as CI does),
and ``constraints.txt``, the same versions without hashes (``pip install -c``). Pins stay unless ``--upgrade``
is given or ``pyproject.toml`` asks for others. ``--check`` writes nothing: it resolves the constraints again
for the oldest and the newest Python, and compares.

    python tools/lock.py [--upgrade | --check]
"""

import argparse
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
LOCK, CONSTRAINTS = ROOT / "requirements.lock", ROOT / "constraints.txt"
PYTHONS = ("3.11.2", "3.12", "3.13")  # the first is that of Debian 12, the last that of Debian 13
PIN = re.compile(r"^([A-Za-z0-9._-]+)==([^\s;\\]+)( ; [^\\]+?)?(?: \\)?$", re.MULTILINE)
HEADER = {
    LOCK: "# What CI installs: pip install --require-hashes -r requirements.lock. Made by tools/lock.py.\n",
    CONSTRAINTS: "# The versions of requirements.lock, for pip install -c. Made by tools/lock.py.\n",
}


def compile_pins(*arguments: str) -> str:
    """Resolve the extra ``complete`` with uv; returns the text of a requirements file."""
    command = [sys.executable, "-m", "uv", "pip", "compile", "pyproject.toml", "--extra", "complete"]
    quiet = ("--quiet", "--no-header", "--no-annotate")
    done = subprocess.run([*command, *quiet, *arguments], cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"the pins do not resolve ({' '.join(arguments)}):\n{done.stderr}")
    return done.stdout


def pins(text: str) -> set[tuple[str, str]]:
    """(name, version) of every pin of a requirements file."""
    return {(name.lower().replace("_", "-"), version) for name, version, _ in PIN.findall(text)}


def write(upgrade: bool) -> None:
    """Both files, from one resolution for every platform and Python."""
    kept = ("--upgrade",) if upgrade or not LOCK.exists() else ()
    arguments = ("--universal", "--python-version", "3.11", "--generate-hashes", "-o", LOCK.name)
    compile_pins(*arguments, *kept)
    text = LOCK.read_text(encoding="utf-8")
    LOCK.write_text(HEADER[LOCK] + text.removeprefix(HEADER[LOCK]), encoding="utf-8")
    lines = [f"{name}=={version}{marker}" for name, version, marker in PIN.findall(text)]
    CONSTRAINTS.write_text(HEADER[CONSTRAINTS] + "\n".join(lines) + "\n", encoding="utf-8")


def check() -> None:
    """Check that the constraints resolve for the oldest and the newest Python, with all pins in them."""
    known = pins(CONSTRAINTS.read_text(encoding="utf-8"))
    for python in (PYTHONS[0], PYTHONS[-1]):
        chosen = pins(compile_pins("--python-version", python, "-c", CONSTRAINTS.name))
        if loose := chosen - known:
            names = ", ".join(sorted(f"{name} {version}" for name, version in loose))
            sys.exit(f"constraints.txt must pin all that Python {python} installs; got none for {names}")
        print(f"constraints.txt resolves for Python {python}: {len(chosen)} packages")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--upgrade", action="store_true", help="take the newest versions")
    what.add_argument("--check", action="store_true", help="write nothing, resolve and compare")
    asked = parser.parse_args()
    check() if asked.check else write(asked.upgrade)
