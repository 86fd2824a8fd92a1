"""Build the sdist and the wheel, install each into new virtual environments, and fly from another folder.

    python scripts/try_installs.py [--python /path/to/python3.12 ...] [--frames 2] [--json FILE]

What is built is the last commit, unpacked elsewhere: files that git does not know cannot help. The wheel is
made from the sdist, as an installer does. For each Python: the wheel and its dependencies at the versions of
`constraints.txt`, `pip check`, `glintrack run quickstart` from an empty folder with no cache; then the sdist
in the place of the wheel, which must bring the same files, and every file of `src/glintrack` that git knows.
The second flight, with the kernels and tables that the first one kept, must give the same frames, pictures,
tracks and scores to the last bit; whether the Pythons do is told.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
BUILD = "import sys, setuptools.build_meta as b; print(b.build_sdist(sys.argv[1]))"
LIST = "import importlib.metadata as m; print(*sorted(map(str, m.files('glintrack'))), sep='\\n')"
TIMED = ("provenance.toml", "result.nc")  # hold wall times
WRITTEN = ("case.toml", "result.nc", "tracks_pan.csv", "tracks_dolp.csv", "tracks_all.csv", "truth.csv")


@dataclass(frozen=True)
class Tried:
    """What one Python made of it.

    Parameters
    ----------
    python
        Its version.
    packages
        Installed, pip left out.
    install_s, first_s, second_s
        Of the wheel with its dependencies, and of the first and the second flight, wall time. [s]
    digest
        Of all files of a flight but those with times.
    """

    python: str
    packages: int
    install_s: float
    first_s: float
    second_s: float
    digest: str


def typed(*command: str | Path, cwd: Path, cache: Path | None = None) -> str:
    """What a program says; the end of this one if it fails."""
    known = ("PYTHONPATH", "PYTHONHOME", "NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "MPLCONFIGDIR")
    environment = {k: v for k, v in os.environ.items() if k not in known}
    if cache is not None:
        environment |= {"XDG_CACHE_HOME": str(cache), "NUMBA_CACHE_DIR": str(cache / "numba")}
    done = subprocess.run(
        [str(word) for word in command], cwd=cwd, env=environment, capture_output=True, text=True
    )
    if done.returncode:
        said = (done.stdout + done.stderr)[-3000:]
        sys.exit(f"{' '.join(map(str, command))} ended with {done.returncode}:\n{said}")
    return done.stdout


def new_environment(python: str, folder: Path) -> Path:
    """Its Python."""
    typed(python, "-m", "venv", folder, cwd=folder.parent)
    return folder / "bin" / "python"


def build(scratch: Path) -> tuple[Path, Path]:
    """Sdist of the last commit, and the wheel of that sdist."""
    source, dist = scratch / "source", scratch / "dist"
    source.mkdir()
    dist.mkdir()
    archive = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, capture_output=True, check=True).stdout
    subprocess.run(["tar", "-x", "-C", str(source)], input=archive, check=True)
    python = new_environment(sys.executable, scratch / "builds")
    typed(python, "-m", "pip", "install", "--quiet", "setuptools>=77", cwd=scratch)
    sdist = dist / typed(python, "-c", BUILD, dist, cwd=source).split()[-1]
    typed(python, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", dist, sdist, cwd=scratch)
    return sdist, next(dist.glob("*.whl"))


def installed(python: Path) -> set[str]:
    """Files of the package, without what is compiled or names the way it came."""
    lines = typed(python, "-c", LIST, cwd=python.parent).splitlines()
    return {line for line in lines if line.startswith("glintrack/") and "__pycache__" not in line}


def fly(python: Path, folder: Path, frames: int, cache: Path) -> float:
    """Wall time of a flight of the quickstart from a folder; the end if a file of it is missing. [s]"""
    began = time.monotonic()
    program = python.with_name("glintrack")
    typed(program, "run", "quickstart", "--frames", str(frames), "-o", "flown", cwd=folder, cache=cache)
    spent = time.monotonic() - began
    missing = [name for name in WRITTEN if not (folder / "flown" / name).is_file()]
    if missing:
        sys.exit(f"{python}: the result lacks {', '.join(missing)}")
    return spent


def digest(flown: Path) -> str:
    """Hash of the names and contents of a flight's files, but of those that hold times."""
    found = hashlib.sha256()
    for path in sorted(p for p in flown.rglob("*") if p.is_file() and p.name not in TIMED):
        found.update(str(path.relative_to(flown)).encode() + b"\0" + path.read_bytes())
    return found.hexdigest()[:16]


def attempt(interpreter: str, built: tuple[Path, Path], scratch: Path, frames: int) -> Tried:
    """One Python: install, check, fly, and install the sdist."""
    sdist, wheel = built
    version = typed(
        interpreter, "-c", "import platform; print(platform.python_version())", cwd=scratch
    ).strip()
    place = scratch / f"python{version}"
    place.mkdir()
    python = new_environment(interpreter, place / "venv")
    pip = (python, "-m", "pip")
    began = time.monotonic()
    pinned = ("-c", ROOT / "constraints.txt")
    typed(*pip, "install", "--quiet", *pinned, wheel, cwd=place)
    spent = time.monotonic() - began
    typed(*pip, "check", cwd=place)
    times = []
    for name in ("first", "second"):
        (place / name).mkdir()
        times.append(fly(python, place / name, frames, place / "cache"))
    first, second = (digest(place / name / "flown") for name in ("first", "second"))
    if first != second:
        sys.exit(f"{version}: the second flight must give the files of the first, got others")
    of_wheel = installed(python)
    typed(*pip, "uninstall", "--quiet", "--yes", "glintrack", cwd=place)
    typed(*pip, "install", "--quiet", "--no-deps", sdist, cwd=place)
    source = scratch / "source" / "src"
    known = {str(path.relative_to(source)) for path in source.rglob("*") if path.is_file()}
    for what, found in (("wheel", of_wheel), ("sdist", installed(python))):
        lacking = sorted({name for name in known if name.startswith("glintrack/")} - found)
        if lacking:
            sys.exit(
                f"the {what} must bring every file of src/glintrack, got none of {', '.join(lacking[:9])}"
            )
    packages = len(json.loads(typed(*pip, "list", "--format", "json", cwd=place))) - 1
    return Tried(version, packages, round(spent, 1), round(times[0], 1), round(times[1], 1), first)


def main() -> None:
    """Build, try each Python, and tell."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--python", action="append", help="an interpreter; repeatable; by default this one")
    parser.add_argument("--frames", type=int, default=2)
    parser.add_argument("--json", type=Path, help="write what came to this file")
    asked = parser.parse_args()
    tried = []
    with tempfile.TemporaryDirectory(prefix="glintrack-installs-") as scratch:
        built = build(Path(scratch))
        print(*(f"{one.name}: {one.stat().st_size / 1e6:.1f} MB" for one in built), sep="\n", flush=True)
        for interpreter in asked.python or [sys.executable]:
            tried.append(attempt(interpreter, built, Path(scratch), asked.frames))
            one = tried[-1]
            print(
                f"Python {one.python}: {one.packages} packages in {one.install_s:.0f} s; flown in "
                f"{one.first_s:.0f} s, and again in {one.second_s:.0f} s: {one.digest}",
                flush=True,
            )
    same = len({one.digest for one in tried}) == 1
    print(f"their flights: {'the same to the last bit' if same else 'different'}")
    if asked.json:
        asked.json.write_text(json.dumps([asdict(one) for one in tried], indent=1) + "\n")


if __name__ == "__main__":
    main()
