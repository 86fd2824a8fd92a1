"""What kept hits save, how two workers compare with one, and where a study's scheduler saturates.

``python benchmarks/study.py [--quick] [--json FILE]``. Three parts, on real cases of the embedded city:

1. The same case with hits traced, traced and kept, and recalled, frame by frame in turns; the peer is
   tracing.
2. A study of cases of different geometry with one and with two processes.
3. A simulation of a study on 10, 100 and 1,000 workers: task times drawn from those measured in part 2, the
   driver's time for each case measured with cases that cost nothing, results and kept hits passing one disk.
   Workers ask the program's own work queue what to fly next.
"""

import argparse
import heapq
import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from glintrack import Case, simulate
from glintrack.study import HitsCache, StudyFolder, processes, read_plan, run_study, serial
from glintrack.study.hits import geometry
from glintrack.study.order import WorkQueue

DISK_BYTES_S = 1e9  # of a file server that all workers share
CASES_A_WORKER = 20
CASES_A_GEOMETRY = 5


def free(case, errand):
    """A case that costs nothing: what is left is the scheduler's own work."""
    scores = {"completeness": 0.5, "over_time": {"completeness": [0.5] * case.flight.frames}}
    return {"scores": dict.fromkeys(case.modalities, scores), "files": {"result.nc": bytes(200_000)}}


def kept_hits(quick: bool) -> list[dict]:
    """Seconds a frame, traced and recalled in turns, and the bytes of a kept frame."""
    frames, oversampling = (6, 1) if quick else (12, 2)
    case = Case.model_validate(
        {"flight": {"frames": frames}, "sensor": {"oversampling": oversampling}, "modalities": ["dolp"]}
    )
    seconds: dict[str, list[float]] = {"traced": [], "kept": [], "recalled": []}
    begun: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        cache = HitsCache(Path(folder), geometry(case))

        def recall(time_s, look):
            start = time.perf_counter()
            begun.append(start)
            sight = look()
            traced = time.perf_counter()
            cache.recall(time_s, lambda: sight)
            stored = time.perf_counter()
            again = cache.recall(time_s, look)
            seconds["recalled"].append(time.perf_counter() - stored)
            seconds["traced"].append(traced - start)
            seconds["kept"].append(stored - start)
            return again

        simulate(case, recall=recall)
        bytes_a_frame = cache.bytes_kept / frames
    # the first frame builds the intersectors and compiles
    ms = {name: 1e3 * float(np.median(values[1:])) for name, values in seconds.items()}
    first_ms = 1e3 * seconds["traced"][0]
    rows = [
        {"name": f"a frame's hits, {name}", "value": value, "unit": "ms", "peer": "tracing",
         "ratio": ms["traced"] / value}
        for name, value in ms.items()
    ]  # fmt: skip
    rows.append({"name": "first frame, with intersectors", "value": first_ms, "unit": "ms"})
    rows.append({"name": "a kept frame", "value": 1e-6 * bytes_a_frame, "unit": "MB"})
    # the first two frames compile what comes after the hits
    frame_ms = 1e3 * float(np.median(np.diff(begun)[1:])) - (ms["kept"] - ms["traced"]) - ms["recalled"]
    recalled_ms = frame_ms - ms["traced"] + ms["recalled"]
    rows.append({"name": "whole frame, traced", "value": frame_ms, "unit": "ms"})
    rows.append({"name": "whole frame, recalled", "value": recalled_ms, "unit": "ms", "peer": "traced",
                 "ratio": frame_ms / recalled_ms})  # fmt: skip
    return rows


def write_studies(folder: Path, quick: bool) -> tuple[Path, Path]:
    """Small real cases of different geometry, and many that cost nothing."""
    (folder / "base.toml").write_text("[sensor]\nrows = 280\ncolumns = 440\npitch_um = 34.0\n")
    count, frames = (4, 4) if quick else (8, 12)
    turns = np.linspace(0, 315, count).tolist()
    real = f'case = "base.toml"\n[base]\nflight.frames = {frames}\n[axes]\n'
    real += f"flight.azimuth_from_sun_deg = {turns}\n"
    many = f'case = "base.toml"\n[axes]\nseed = {list(range(100 if quick else 400))}\n'
    for name, text in (("real", real), ("many", many)):
        (folder / f"{name}.toml").write_text(text)
    return folder / "real.toml", folder / "many.toml"


def one_and_two_workers(study: Path, out: Path) -> tuple[list[dict], list[float]]:
    """Wall time with one and with two processes, of one thread each, and what each case took."""
    plan, rows, seconds, walls = read_plan(study), [], [], {}
    for workers in (1, 2):
        folder = StudyFolder(out / f"workers-{workers}")
        # two workers are there in both runs: each has one thread
        with folder.opened(plan), processes(2) as pool:
            pool.slots = workers
            start = time.perf_counter()
            run_study(plan, folder, pool)
            walls[workers] = time.perf_counter() - start
        told = [folder.finished(key) for key in plan.cases]
        seconds = [t["seconds"] for t in told if t] if workers == 1 else seconds
    for workers, wall in walls.items():
        rows.append(
            {"name": f"{len(plan.cases)} cases, {workers} workers", "value": wall, "unit": "s",
             "peer": "1 worker", "ratio": walls[1] / wall}
        )  # fmt: skip
    return rows, seconds


def drivers_time(study: Path, out: Path) -> float:
    """Seconds of the driver for a case: queue, sending, taking back and publishing 200 kB."""
    plan, folder = read_plan(study), StudyFolder(out / "free")
    with folder.opened(plan), serial() as pool:
        start = time.perf_counter()
        run_study(plan, folder, pool, fly=free)
        return (time.perf_counter() - start) / len(plan.cases)


def simulated(
    workers: int, task_s: list[float], driver_s: float, saved_share: float, bytes_a_case: float
) -> tuple[float, float, float]:
    """A study of many cases on many workers: efficiency, and how busy driver and disk are. [1]

    Parameters
    ----------
    workers
        How many.
    task_s
        Of cases that trace all their rays; each case draws one. [s]
    driver_s
        Of the one driver for each case, one after the other. [s]
    saved_share
        Part of a case's time that kept hits save.
    bytes_a_case
        Kept hits that a case writes or reads. [byte]
    """
    rng = np.random.default_rng(workers)
    cases = workers * CASES_A_WORKER
    geometry_of = {str(k): str(k // CASES_A_GEOMETRY) for k in range(cases)}
    durations = rng.choice(task_s, cases)
    queue, ready = WorkQueue(geometry_of, geometry_of), set()
    driver_free = disk_free = now = ideal = driver_busy = disk_busy = 0.0
    events: list[tuple[float, str]] = []  # when a case's result reaches the driver
    idle = workers
    while len(queue) or events:
        while idle and len(queue):
            key = queue.pop()
            driver_free = max(driver_free, now) + 0.5 * driver_s
            task = float(durations[int(key)]) * (1 - saved_share * (geometry_of[key] in ready))
            disk_free = max(disk_free, driver_free) + bytes_a_case / DISK_BYTES_S
            driver_busy, disk_busy = driver_busy + driver_s, disk_busy + bytes_a_case / DISK_BYTES_S
            ideal += task
            heapq.heappush(events, (max(driver_free + task, disk_free), key))
            idle -= 1
        now, key = heapq.heappop(events)
        driver_free = max(driver_free, now) + 0.5 * driver_s
        ready.add(geometry_of[key])
        queue.traced(geometry_of[key])
        idle += 1
    return ideal / (workers * now), driver_busy / now, disk_busy / now


def scaling(task_s: list[float], driver_s: float, hits: list[dict]) -> list[dict]:
    """The simulation at three sizes; cases of a minute beside those measured."""
    value = {row["name"]: row["value"] for row in hits}
    bytes_a_case = 1e6 * value["a kept frame"] * 40
    rows = [{"name": "driver's time for a case", "value": 1e3 * driver_s, "unit": "ms"}]
    minute = [60 * s / float(np.mean(task_s)) for s in task_s]
    saved = 1 - value["whole frame, recalled"] / value["whole frame, traced"]
    kinds = (
        ("as measured", task_s, 0.0),
        ("of a minute", minute, 0.0),
        ("of a minute, hits kept", minute, bytes_a_case),
    )
    for label, tasks, size in kinds:
        for workers in (10, 100, 1000):
            share, driver, disk = simulated(workers, tasks, driver_s, saved if size else 0.0, size)
            rows.append(
                {"name": f"{workers} workers, cases {label}: efficiency", "value": share, "unit": "1"}
            )
            rows.append(
                {"name": f"{workers} workers, cases {label}: driver busy", "value": driver, "unit": "1"}
            )
            rows.append({"name": f"{workers} workers, cases {label}: disk busy", "value": disk, "unit": "1"})
    return rows


def main() -> None:
    """Print the table and, if asked, write it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        real, many = write_studies(folder, arguments.quick)
        rows = kept_hits(arguments.quick)
        measured, task_s = one_and_two_workers(real, folder)
        rows += measured
        rows += scaling(task_s, drivers_time(many, folder), rows)
    for row in rows:
        ratio = f"{row['ratio']:6.2f} × {row['peer']}" if "ratio" in row else ""
        print(f"{row['name']:62s} {row['value']:10.3g} {row['unit']:3s} {ratio}")
    if arguments.json:
        arguments.json.write_text(json.dumps({"rows": rows}, indent=1))


if __name__ == "__main__":
    sys.exit(main())
