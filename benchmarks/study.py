"""What kept hits save, how two workers compare with one, and where a study's scheduler saturates.

``python benchmarks/study.py [--quick] [--json FILE] [--plot PNG]``. Three parts, on real cases of the
embedded city:

1. The same case with hits traced, traced and kept, and recalled, frame by frame in turns; the peer is
   tracing. Processor time of all threads, so that other work on the machine adds little.
2. A study of cases of different geometry with one and with two processes, in wall time, and the work they did
   in processor time.
3. A simulation of a study on 10, 100 and 1,000 workers: task times drawn from those measured in part 2, the
   driver's time for each case measured with cases that cost nothing (written by one process; and sent through
   a Dask cluster on this machine), kept hits passing one disk that all share. Workers ask the program's own
   work queue what to fly next.
"""

import argparse
import heapq
import json
import sys
import tempfile
import time
from concurrent.futures import wait
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from glintrack import Case, simulate
from glintrack.study import (
    HitsCache,
    Pool,
    StudyFolder,
    dask,
    processes,
    read_plan,
    run_study,
    serial,
    source_key,
)
from glintrack.study.hits import geometry
from glintrack.study.order import WorkQueue

DISK_BYTES_S = 1e9  # of a file server that all workers share
CASES_A_WORKER = 20
CASES_A_GEOMETRY = 5
FRAMES_A_CASE = 40  # as the quickstart's
RESULT_BYTES = 200_000
SIZES = (10, 100, 1000)


def free(case, errand):
    """A case that costs nothing: what is left is the scheduler's own work."""
    scores = {"completeness": 0.5, "over_time": {"completeness": [0.5] * case.flight.frames}}
    return {"scores": dict.fromkeys(case.channels, scores), "files": {"result.nc": bytes(RESULT_BYTES)}}


def kept_hits(quick: bool) -> list[dict]:
    """Processor time of a frame, traced and recalled in turns, and the bytes of a kept frame."""
    frames, oversampling = (6, 1) if quick else (12, 2)
    case = Case.model_validate(
        {"flight": {"frames": frames}, "sensor": {"oversampling": oversampling}, "channels": ["dolp"]}
    )
    seconds: dict[str, list[float]] = {"traced": [], "kept": [], "recalled": []}
    begun: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        cache = HitsCache(Path(folder), geometry(case))

        class Timed:
            """The cache, asked three times a frame."""

            def get(self, time_s, observe):
                start = time.process_time()
                begun.append(start)
                frame = observe()
                traced = time.process_time()
                cache.get(time_s, lambda: frame)
                stored = time.process_time()
                again = cache.get(time_s, observe)
                seconds["recalled"].append(time.process_time() - stored)
                seconds["traced"].append(traced - start)
                seconds["kept"].append(stored - start)
                return again

        simulate(case, hits_cache=Timed())
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
    """Wall time with one and with two processes, of one thread each, and each case's processor time."""
    plan, rows, seconds, walls = read_plan(study), [], {}, {}
    for workers in (1, 2):
        folder = StudyFolder(out / f"workers-{workers}")
        # two workers are there in both runs: each has one thread
        with folder.opened(plan), processes(2) as pool:
            pool.slots = workers
            start_up(pool)
            start = time.perf_counter()
            run_study(plan, folder, pool)
            walls[workers] = time.perf_counter() - start
        told = [folder.finished(key) for key in plan.cases]
        seconds[workers] = [t["cpu_seconds"] for t in told if t]
    for workers, wall in walls.items():
        label = f"{len(plan.cases)} cases, {workers} workers"
        rows += [
            {"name": label, "value": wall, "unit": "s", "peer": "1 worker", "ratio": walls[1] / wall},
            {"name": f"{label}, processor time", "value": sum(seconds[workers]), "unit": "s"},
        ]
    return rows, seconds[1]


def start_up(pool: Pool) -> None:
    """Have every worker started, with the program loaded."""
    wait([pool.executor.submit(source_key) for _ in range(pool.slots)])


def drivers_time(study: Path, out: Path) -> tuple[float, float]:
    """Seconds of the driver for a case: queue, taking back and publishing 200 kB; and with Dask between."""
    plan, took = read_plan(study), []
    for name, where in (("free", serial()), ("sent", dask("local", 2))):
        folder = StudyFolder(out / name)
        with folder.opened(plan), where as pool:
            start_up(pool)
            start = time.perf_counter()
            run_study(plan, folder, pool, fly=free)
            took.append((time.perf_counter() - start) / len(plan.cases))
    return took[0], took[1]


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


def kinds(task_s: list[float], hits: list[dict]) -> dict[str, tuple[list[float], float, float]]:
    """What is simulated: task times, the share that kept hits save, and the bytes they take, of a case."""
    value = {row["name"]: row["value"] for row in hits}
    minute = [60 * s / float(np.mean(task_s)) for s in task_s]
    saved = 1 - value["whole frame, recalled"] / value["whole frame, traced"]
    return {
        "as measured": (task_s, 0.0, 0.0),
        "of a minute": (minute, 0.0, 0.0),
        "of a minute, hits kept": (minute, saved, 1e6 * value["a kept frame"] * FRAMES_A_CASE),
    }


def scaling(task_s: list[float], driver_s: tuple[float, float], hits: list[dict]) -> list[dict]:
    """The simulation at three sizes; cases of a minute beside those measured."""
    rows = [
        {"name": "driver's time for a case", "value": 1e3 * driver_s[0], "unit": "ms"},
        {"name": "driver's time for a case, through Dask", "value": 1e3 * driver_s[1], "unit": "ms"},
    ]
    for label, (tasks, saved, size) in kinds(task_s, hits).items():
        for workers in SIZES:
            found = simulated(workers, tasks, driver_s[1], saved, size)
            for name, share in zip(("efficiency", "driver busy", "disk busy"), found, strict=True):
                rows.append(
                    {"name": f"{workers} workers, cases {label}: {name}", "value": share, "unit": "1"}
                )
        rows.append(
            {"name": f"cases {label}: workers that the driver can serve",
             "value": float(np.mean(tasks)) / driver_s[1], "unit": "1"}
        )  # fmt: skip
    return rows


def plot(path: Path, task_s: list[float], driver_s: float, hits: list[dict]) -> None:
    """Efficiency over the number of workers."""
    figure = Figure(figsize=(6.0, 3.2), layout="constrained")
    ax = figure.add_subplot()
    sizes = np.unique(np.round(np.logspace(0, 3.5, 29)).astype(int)).tolist()
    for (label, (tasks, saved, size)), style in zip(
        kinds(task_s, hits).items(), ("-", "--", ":"), strict=True
    ):
        mean = f"{np.mean(tasks):.2g} s" if label == "as measured" else ""
        share = [simulated(n, tasks, driver_s, saved, size)[0] for n in sizes]
        ax.semilogx(sizes, share, f"k{style}", label=f"cases {label} {mean}".strip())
    ax.set(xlabel="workers", ylabel="efficiency", ylim=(0, 1.05))
    ax.grid(alpha=0.3)
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=160)


def main() -> None:
    """Print the table and, if asked, write it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        real, many = write_studies(folder, arguments.quick)
        rows = kept_hits(arguments.quick)
        measured, task_s = one_and_two_workers(real, folder)
        rows += measured
        driver_s = drivers_time(many, folder)
        rows += scaling(task_s, driver_s, rows)
    if arguments.plot:
        plot(arguments.plot, task_s, driver_s[1], rows)
    for row in rows:
        ratio = f"{row['ratio']:6.2f} × {row['peer']}" if "ratio" in row else ""
        print(f"{row['name']:62s} {row['value']:10.3g} {row['unit']:3s} {ratio}")
    if arguments.json:
        arguments.json.write_text(json.dumps({"rows": rows}, indent=1))


if __name__ == "__main__":
    sys.exit(main())
