"""What a frame of the closed loop costs, stage by stage, beside what this machine can do.

``python benchmarks/loop.py [--quick] [--json FILE] [--history RELEASE]`` flies `quickstart` (880 × 560
elements, a city of some 300 vehicles, polarized sky, shadow, reflections, point spread, noise, rectified
frames, tracks, spectra, scores) in several ways and times each stage of each frame: median, and half the
range from the 16 % to the 84 % quantile. The first frames, in which nothing is tracked yet, are left out.
`scene`, `trace`, `truth` and `shade` make a frame's light, with two threads while the frame before is sensed
and tracked: `light` is how long the loop waits for it, and they are not in `frame_total`. ``processor`` is
the processor time of all threads from frame to frame, which other work on the machine changes least.
``floor`` is what the stage's rays or bytes would take at the rate measured in the same run: rays at that of
Embree's intersection alone, bytes at that of copying. ``--history`` adds the ratios of this run to
benchmarks/history.csv; nothing else is compared from run to run.
"""

import argparse
import csv
import gc
import importlib
import json
import os
import platform
import resource
import sys
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the program does, before NumPy is loaded

import numba as nb
import numpy as np

from glintrack import simulate as fly
from glintrack.case.build import build_scenario
from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.core.heaps import share_heaps
from glintrack.core.kernels.ahead import compile_ahead
from glintrack.results.collect import Stopwatch

LEFT_OUT = 4  # frames
# stages of the light, made ahead where there are two threads, and what is no stage
BESIDE = "scene", "trace", "truth", "shade", "processor"
FIRST = "light", "scene"  # stage of a frame, in the loop and in what makes its light beside it
HISTORY = Path(__file__).with_name("history.csv")
SIMPLE = {
    "channels": ["pan"],
    "sensor.oversampling": 1,
    "sensor.polarizer": "ideal",
    "track.detect.detector": "background",
    "track.query.policy": "none",
}
WAYS = {
    "three channels, 3 × 3 rays": {},
    "pan alone, 3 × 3 rays": {"channels": ["pan"]},
    "pan, one ray, `background`": SIMPLE,
}
WANTED_MS = {"three channels, 3 × 3 rays": 900, "pan, one ray, `background`": 200}


class Laps(Stopwatch):
    """A stopwatch that keeps every frame's times by stage. [s]"""

    kept: ClassVar[list["Laps"]] = []

    def __init__(self):
        super().__init__()
        self.frames: list[dict[str, float]] = []
        self.processor_s: list[float] = []  # at the begin of each
        Laps.kept.append(self)

    def lap(self, stage: str) -> None:
        """Of one stage of the frame that is flown."""
        before = self.seconds.get(stage, 0.0)
        super().lap(stage)
        if stage in FIRST:
            self.frames.append(defaultdict(float))
            self.processor_s.append(time.process_time())
        if self.frames:
            self.frames[-1][stage] += self.seconds[stage] - before


@dataclass(frozen=True)
class Rates:
    """What this machine can do, all cores together."""

    rays_per_s: float
    bytes_per_s: float


def rates(case: Case) -> Rates:
    """Embree's own on a frame's rays of look, and that of copying 256 MB."""
    scenario = build_scenario(case)
    time_s = float(scenario.flight.times_s[0])
    observer, pose = scenario.observer, scenario.flight.pose(time_s)
    snapshot = scenario.city.at(time_s)
    hits = observer.trace(snapshot, pose)
    toward = hits.point[hits.material >= 0] - pose.position
    look = (toward / np.linalg.norm(toward, axis=1, keepdims=True)).astype(np.float32)
    start, rays = pose.position[None].astype(np.float32), observer.tracer.rays
    ray_s = least_s(lambda: rays.intersect(start, look, coherent=True))
    source = np.zeros(1 << 25)
    copy_s = least_s(lambda: np.copyto(np.empty_like(source), source))
    return Rates(len(look) / ray_s, 2 * source.nbytes / copy_s)


def least_s(work, times: int = 3) -> float:
    """Wall time, the least of some."""
    found = []
    for _ in range(times):
        began = time.perf_counter()
        work()
        found.append(time.perf_counter() - began)
    return min(found)


def flown(case: Case) -> dict[str, np.ndarray]:
    """Times of each stage, a value a frame; "light" is what the loop waits for its stages' end. [ms]"""
    Laps.kept.clear()
    fly(case)
    found = {}
    for laps in Laps.kept:
        frames = laps.frames[LEFT_OUT : case.flight.frames]
        stages = [stage for stage in laps.seconds if stage not in ("build", "compile")]
        found |= {stage: 1e3 * np.array([frame.get(stage, 0.0) for frame in frames]) for stage in stages}
        found["processor"] = 1e3 * np.diff(laps.processor_s)[LEFT_OUT:]
    return found


def rows_of(way: str, case: Case, threads: int) -> list[dict]:
    """A row a stage, and one for the whole frame."""
    before = nb.get_num_threads()
    nb.set_num_threads(threads)
    try:
        found = flown(case)
    finally:
        nb.set_num_threads(before)
    found["frame_total"] = np.sum([v for stage, v in found.items() if stage not in BESIDE], axis=0)
    rows = []
    for stage, values in found.items():
        low, middle, high = np.quantile(values, (0.16, 0.5, 0.84))
        rows.append(
            {"way": way, "threads": threads, "stage": stage, "ms": middle, "spread_ms": (high - low) / 2}
        )
    return rows


def floors(case: Case, known: Rates) -> dict[str, float]:
    """Least time of the stages whose rays or bytes are known. [ms]"""
    scenario = build_scenario(case)
    time_s = float(scenario.flight.times_s[0])
    observed = scenario.observer
    traced = observed.observe(scenario.city.at(time_s), scenario.flight.pose(time_s))
    rays = observed.camera.rows * observed.camera.columns * observed.oversampling**2
    size = sum(value.nbytes for value in vars(traced.hits).values() if isinstance(value, np.ndarray))
    # a ray of look and one to the sun each
    return {"trace": 2e3 * rays / known.rays_per_s, "shade": 1e3 * size / known.bytes_per_s}


def add_history(release: str, rows: list[dict]) -> None:
    """One line a way: frame time over that of its floors."""
    new = not HISTORY.exists()
    with HISTORY.open("a", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        if new:
            writer.writerow(["release", "way", "threads", "frame_over_floors"])
        for row in rows:
            if row["stage"] == "frame_total" and row.get("floor_ms"):
                writer.writerow([release, row["way"], row["threads"], f"{row['ms'] / row['floor_ms']:.2f}"])


def main() -> None:
    """Fly, time and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="two ways, few frames")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--history", metavar="RELEASE")
    given = parser.parse_args()
    share_heaps()  # as the program does
    compile_ahead(wait=True)
    gc.freeze()  # as the program does
    flight: Any = importlib.import_module("glintrack.simulate")
    flight.Stopwatch = Laps
    frames = LEFT_OUT + (4 if given.quick else 16)
    base = Case.from_toml(find_case("quickstart")).replace({"flight.frames": frames})
    known, cores = rates(base), os.cpu_count() or 1
    print(f"{platform.machine()}, {cores} cores: {1e-6 * known.rays_per_s:.1f} million rays and "
          f"{1e-9 * known.bytes_per_s:.1f} GB a second\n")  # fmt: skip
    rows = []
    for way, changes in WAYS.items():
        if given.quick and way not in WANTED_MS:
            continue
        case = base.replace(changes)
        least = floors(case, known)
        for threads in (cores,) if given.quick or cores == 1 else (1, cores):
            mine = rows_of(way, case, threads)
            for row in mine:
                whole, share = row["stage"] == "frame_total", cores / threads
                row["floor_ms"] = share * (sum(least.values()) if whole else least.get(row["stage"], 0.0))
            rows += mine
            print_table(way, threads, mine)
    memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (
        1e6 if sys.platform == "darwin" else 1e3
    )
    print(f"peak memory of all of it: {memory_mb:.0f} MB")
    if given.json:
        given.json.write_text(
            json.dumps({"rows": rows, "memory_mb": memory_mb, **vars(known)}, indent=1) + "\n"
        )
    if given.history:
        add_history(given.history, rows)


def print_table(way: str, threads: int, rows: list[dict]) -> None:
    """One way to fly, stage by stage."""
    print(f"**{way}, {threads} thread{'s' if threads > 1 else ''}**\n")
    print("| stage | ms, median | spread | floor | times its floor |\n| --- | --- | --- | --- | --- |")
    for row in rows:
        floor = f"{row['floor_ms']:.0f} | {row['ms'] / row['floor_ms']:.1f}" if row["floor_ms"] else " | "
        print(f"| {row['stage']} | {row['ms']:.0f} | {row['spread_ms']:.0f} | {floor} |")
    total = next(row["ms"] for row in rows if row["stage"] == "frame_total")
    wanted = f"; wanted {WANTED_MS[way]} ms" if way in WANTED_MS else ""
    print(f"\nreal time: {500 / total:.2f} × at 2 Hz, {100 / total:.3f} × at 10 Hz{wanted}\n", flush=True)


if __name__ == "__main__":
    main()
