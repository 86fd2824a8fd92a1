"""How long a stranger waits: from `glintrack run quickstart` with empty caches to the first frame on disk.

``python benchmarks/first_frame.py [--frames N]`` flies twice, each time in a new process, the second with
what the first one kept. It tells wall and processor time when the first rectified frame lies in the result
folder, and what part of the machine that was: on a busy one only processor time says something. Linux only.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

_TICKS = os.sysconf("SC_CLK_TCK")


def processor_s(process: str) -> float:
    """Of a process, without its children. [s]"""
    fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


def machine_s() -> float:
    """Of all that ran on the machine since it started. [s]"""
    fields = Path("/proc/stat").read_text().splitlines()[0].split()[1:]
    return sum(map(int, fields[:3] + fields[5:8])) / _TICKS


def used_s(program: int) -> dict[str, float]:
    """Processor time of a program and of its living children, and theirs. [s]"""
    found = {}
    with suppress(OSError):  # it has ended
        found[str(program)] = processor_s(str(program))
        for thread in Path(f"/proc/{program}/task").iterdir():
            for child in (thread / "children").read_text().split():
                found |= used_s(int(child))
    return found


def main() -> None:
    """Fly, and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=2)
    frames = parser.parse_args().frames
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for caches in "empty", "as the first flight left them":
            print(f"caches {caches}:")
            fly(folder, frames)


def fly(folder: Path, frames: int) -> None:
    """Fly once, with caches in a folder, and print."""
    kept = {"NUMBA_CACHE_DIR": str(folder / "kernels"), "XDG_CACHE_HOME": str(folder / "cache")}
    words = [sys.executable, "-m", "glintrack", "run", "quickstart", f"--frames={frames}", "-o", "result"]
    before, began = machine_s(), time.perf_counter()
    flight = subprocess.Popen(words, env=os.environ | kept, cwd=folder, stdout=subprocess.DEVNULL)
    while flight.poll() is None and not list(folder.glob("*result*/frames/*.tif")):
        time.sleep(0.01)
    wall_s, mine = time.perf_counter() - began, used_s(flight.pid)
    share = sum(mine.values()) / max(machine_s() - before, 1e-9)
    own_s = mine.pop(str(flight.pid), 0.0)
    print(f"first frame on disk after {wall_s:.1f} s, with {100 * share:.0f} % of the machine:")
    print(f"processor time {own_s:.1f} s of the flight, {sum(mine.values()):.1f} s to compile beside it")
    flight.wait()
    print(f"{frames} frames and their result after {time.perf_counter() - began:.1f} s")
    shutil.rmtree(folder / "result")


if __name__ == "__main__":
    main()
