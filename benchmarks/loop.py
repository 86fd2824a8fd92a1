"""Time the frames of the closed loop, stage by stage.

``python benchmarks/loop.py [--quick] [--json FILE]`` simulates `quickstart` (880 × 560 elements, a city of
some 300 vehicles, polarized sky, shadows, reflections, point spread, noise, rectified frames, tracks and
spectra). The first frames, in which kernels are compiled and nothing is tracked yet, are left out.

``frame_total`` is the median wall time from one frame to the next, ``processor`` the same of the processor
time of all threads, which other work on the machine changes least. The other rows are means over all frames
of a stage of the loop, without compiling; rows with "ahead" are stages that run in threads next to the loop,
and ``light`` is how long the loop waits for them. Names of rows of further designs end in the design.
"""

import argparse
import json
import os
import platform
import resource
import sys
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the program does, before NumPy is loaded

import numpy as np

from glintrack import simulate
from glintrack.case.design import Case
from glintrack.case.packaged import find_case

LEFT_OUT = 4  # frames
THREE = "three channels"
DESIGNS = {
    THREE: {},
    "pan": {"channels": ["pan"]},
    "pan, one ray": {
        "channels": ["pan"], "sensor.oversampling": 1, "sensor.polarizer": "ideal",
        "track.query.policy": "none",
    },
}  # fmt: skip


def row(name: str, value: float, unit: str, **more) -> dict:
    """One row of the report."""
    return {"name": name, "value": value, "unit": unit, "peer": None, "ratio": None, **more}


def rows_of(design: str, case: Case) -> list[dict]:
    """Simulate a case; a row for the whole frame, one for the processor time, one a stage."""
    wall_s, processor_s = [], []

    def watch(epoch) -> None:
        if epoch.channel == case.channels[0]:
            wall_s.append(time.perf_counter())
            processor_s.append(time.process_time())

    tree = simulate(case, watch)
    frames, processor = (1e3 * np.diff(times)[LEFT_OUT - 1 :] for times in (wall_s, processor_s))
    low, median, high = np.quantile(frames, (0.16, 0.5, 0.84))
    label = "" if design == THREE else f", {design}"
    rows = [
        row(f"frame_total{label}", float(median), "ms", spread=float(high - low) / 2),
        row(f"processor{label}", float(np.median(processor)), "ms"),
    ]
    for key, value in tree.attrs.items():
        for end, said in (("_ms_per_frame", ""), ("_ms_ahead", " ahead")):
            if key.endswith(end):
                rows.append(row(f"{key.removesuffix(end)}{said}{label}", float(value), "ms"))
    return rows


def memory_mb() -> float:
    """Peak memory of this process. [MB]"""
    unit = 1e6 if sys.platform == "darwin" else 1e3
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def main() -> None:
    """Simulate, time and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="three channels, few frames")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows to this file")
    given = parser.parse_args()
    print(f"{platform.machine()}, {os.cpu_count()} cores\n\n| row | value |\n| --- | --- |")
    base = Case.from_toml(find_case("quickstart"))
    base = base.replace({"flight.frames": LEFT_OUT + (6 if given.quick else 16)})
    rows = []
    for design, changes in DESIGNS.items():
        if given.quick and design != THREE:
            continue
        mine = rows_of(design, base.replace(changes))
        mine.append(row("peak memory" + ("" if design == THREE else f", {design}"), memory_mb(), "MB"))
        for one in mine:
            print(f"| {one['name']} | {one['value']:,.0f} {one['unit']} |", flush=True)
        rows += mine
    if given.json:
        given.json.write_text(json.dumps({"rows": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
