"""Where a frame's processor time goes, function by function.

``python benchmarks/profile_frame.py [--simple] [--frames N] [--rows N]`` flies `quickstart` on one thread
under Python's profiler, by the thread's processor time, and prints the functions that take most themselves:
compiled kernels stand as functions. The first three frames are left out, and what a detector does in threads
of its own (`update_ground`).
"""

import argparse
import cProfile
import importlib
import os
import pstats
import time
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the program does, before NumPy is loaded

import numba as nb
from loop import SIMPLE

from glintrack.case.design import Case
from glintrack.case.packaged import find_case

LEFT_OUT = 3  # frames


def main() -> None:
    """Fly and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--simple", action="store_true", help="pan, one ray, `background`")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--rows", type=int, default=30)
    given = parser.parse_args()
    flight: Any = importlib.import_module("glintrack.simulate")
    nb.set_num_threads(1)
    profile, begun, light = cProfile.Profile(time.thread_time), [0], flight._lit_frame

    def lit_frame(*arguments):
        begun[0] += 1
        if begun[0] == LEFT_OUT + 1:
            profile.enable()
        return light(*arguments)

    flight._lit_frame = lit_frame
    case = Case.from_toml(find_case("quickstart")).replace({"flight.frames": given.frames})
    flight.simulate(case.replace(SIMPLE) if given.simple else case)
    profile.disable()
    count = given.frames - LEFT_OUT
    own: dict = pstats.Stats(profile).stats  # pyright: ignore
    rows = sorted(((tt, ct, calls, where) for where, (_, calls, tt, ct, _) in own.items()), reverse=True)
    print(f"{1e3 * sum(row[0] for row in rows) / count:.0f} ms a frame\n")
    print("| function | ms itself | ms with what it calls | calls |\n| --- | --- | --- | --- |")
    for itself, whole, calls, (file, _, name) in rows[: given.rows]:
        place = file.split("glintrack/")[-1].split("site-packages/")[-1]
        ms = f"{1e3 * itself / count:.1f} | {1e3 * whole / count:.1f}"
        print(f"| {place} {name} | {ms} | {calls / count:.0f} |")


if __name__ == "__main__":
    main()
