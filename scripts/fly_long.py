"""Long flights, long days, many vehicles and a large mesh: memory and time as they go on.

    python scripts/fly_long.py frames [--count 10000]      a small case with `glintrack run`
    python scripts/fly_long.py day [--count 86400]         the tracker alone, one step a second
    python scripts/fly_long.py vehicles [--count 20000]    at once, tracked from given detections
    python scripts/fly_long.py traffic [--count 20000]     at once in the scene, 20 frames flown
    python scripts/fly_long.py scores [--count 10000]      scores of that many frames, without flying them
    python scripts/fly_long.py mesh [--count 5000000]      triangles of a user's mesh, one frame rendered

``--plot FILE`` draws memory and time over the steps, of `frames` and `day`; ``--json FILE`` keeps them.
Memory is what the process holds at that moment, libraries and compiled kernels too. The scenes are made here:
a square of level ground over which cars drive one behind the other.
"""

import argparse
import json
import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import xarray as xr

from glintrack.case.design import Case
from glintrack.io.detections import DetectionTable
from glintrack.metrics import score_epochs, summarize
from glintrack.results.run import render_frame, run
from glintrack.track import track_detections

matplotlib.use("agg")
from matplotlib import pyplot  # after the choice of a backend

SPEED_M_S = 10.0
LANE_M = 12.0
SIDE_M = 140.0
FOUND = 0.9  # share of the vehicles that are detected
SMALL = {  # elements of 0.75 m; cars cross in 14 s
    "name": "long",
    "channels": ["pan"],
    "flight": {"off_nadir_deg": 0.0, "altitude_m": 3000.0, "rate_hz": 2.0, "speed_m_s": 0.0},
    "sensor": {"rows": 40, "columns": 80},
    "output": {"film_frames": 20},
    "bound": {"every": 50},
}


class Told(list):
    """Epochs that tell when one of them is done with."""

    def __init__(self, epochs: list, watch: Callable[[], None]):
        super().__init__(epochs)
        self.watch = watch

    def __iter__(self) -> Iterator:
        """As of any list."""
        for one in super().__iter__():
            yield one
            self.watch()


@dataclass(frozen=True)
class WatchedTable(DetectionTable):
    """Detections whose epochs are watched."""

    watch: Callable[[], None]

    def epochs(self) -> list:
        """As ever."""
        return Told(super().epochs(), self.watch)


class Watch:
    """Memory and time at each step, told now and then."""

    def __init__(self, every: int):
        self.every, self.steps = every, 0
        self.rows: list[tuple[int, float, float, float]] = []  # step, MB, ms a step, CPU ms a step
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def __call__(self, *_) -> None:
        """One step is done."""
        self.steps += 1
        if self.steps % self.every:
            return
        wall, cpu = time.perf_counter(), time.process_time()
        share = 1e3 / self.every
        self.rows.append((self.steps, held_mb(), share * (wall - self._wall), share * (cpu - self._cpu)))
        self._wall, self._cpu = wall, cpu
        print("{:8d} steps {:8.1f} MB {:8.2f} ms a step, {:.2f} of CPU".format(*self.rows[-1]), flush=True)


def held_mb() -> float:
    """Memory of this process now; where the system does not say, the most so far. [MB]"""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return pages * resource.getpagesize() / 1e6


def write_ground(path: Path, side_m: float, cells: int, relief_m: float) -> None:
    """A square of 2 × cells² triangles about (0, 0) as PLY."""
    at = np.linspace(-side_m / 2, side_m / 2, cells + 1)
    x, y = np.meshgrid(at, at)
    z = relief_m * np.sin(x / 40) * np.cos(y / 60)
    corner = np.arange((cells + 1) ** 2, dtype=np.int32).reshape(cells + 1, cells + 1)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
    triangles = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, d), (a, d, c))])
    faces = np.empty(len(triangles), [("n", "u1"), ("v", "<i4", 3)])
    faces["n"], faces["v"] = 3, triangles
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {x.size}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    points = np.stack([x, y, z], -1).reshape(-1, 3).astype("<f4")
    path.write_bytes(head.encode() + points.tobytes() + faces.tobytes())


def columns_of_cars(side_m: float, gap_m: float, lanes: int, duration_s: float) -> Iterator[pd.DataFrame]:
    """Cars that enter each lane in the west and leave it in the east, as floating-car data."""
    stay_s = side_m / SPEED_M_S
    age = np.arange(0, stay_s + 0.25, 0.5)
    for lane in range(lanes):
        offset = 0.37 * lane % 1 * gap_m / SPEED_M_S
        for k, start in enumerate(np.arange(-stay_s, duration_s, gap_m / SPEED_M_S)):
            t = 0.5 * np.round(2 * (start + offset)) + age
            kept = (t >= 0) & (t <= duration_s)
            yield pd.DataFrame({
                "timestep_time": t[kept], "vehicle_id": f"{lane}.{k}", "vehicle_type": "car",
                "vehicle_x": SPEED_M_S * age[kept] - side_m / 2,
                "vehicle_y": (lane - (lanes - 1) / 2) * LANE_M, "vehicle_angle": 90.0,
            })  # fmt: skip


def made_case(folder: Path, design: dict, side_m: float, cells: int = 1, relief_m: float = 0.0) -> dict:
    """The design over a mesh of that many cells a side."""
    write_ground(folder / "ground.ply", side_m, cells, relief_m)
    (folder / "materials.toml").write_text('[mesh]\n"*" = "asphalt"\n')
    scene = {"city": "mesh", "mesh_file": str(folder / "ground.ply"), "mesh_up": "z",
             "materials_file": str(folder / "materials.toml")}  # fmt: skip
    return {**design, "scene": scene}


def with_cars(folder: Path, design: dict, cars: pd.DataFrame) -> Case:
    """The design with that traffic."""
    cars.to_parquet(folder / "cars.parquet")
    return Case.model_validate(
        {**design, "scene": {**design["scene"], "traffic_file": str(folder / "cars.parquet")}}
    )


def fly_frames(folder: Path, count: int) -> Watch:
    """A small case of many frames, written as ever."""
    watch = Watch(max(count // 50, 1))
    cars = pd.concat(columns_of_cars(SIDE_M, 40.0, 4, count / 2 + 1))
    design = made_case(folder, {**SMALL, "flight": {**SMALL["flight"], "frames": count}}, SIDE_M)
    began = time.perf_counter()
    result = run(with_cars(folder, design, cars), folder / "flown", watch)
    scores = result.scores["pan"]
    print(f"{count} frames, {cars['vehicle_id'].nunique()} vehicles in {time.perf_counter() - began:.0f} s; "
          f"completeness {scores['completeness']:.3f}; at most {peak_mb():.0f} MB")  # fmt: skip
    return watch


def peak_mb() -> float:
    """The most memory that this process held. [MB]"""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def detected(cars: pd.DataFrame, watch: Watch, false: float, side_m: float) -> WatchedTable:
    """Detections of cars: some missing, some false, each 0.5 m off."""
    chance = np.random.default_rng(0)
    seen = cars[chance.random(len(cars)) < FOUND].sort_values(["timestep_time", "vehicle_id"])
    times = np.unique(cars["timestep_time"])
    wrong_s = np.repeat(times, chance.poisson(false, len(times)))
    wrong = chance.uniform(-side_m / 2, side_m / 2, (len(wrong_s), 2))
    place = np.concatenate([seen[["vehicle_x", "vehicle_y"]].to_numpy(), wrong])
    place[: len(seen)] += chance.normal(0, 0.5, (len(seen), 2))
    time_s = np.concatenate([seen["timestep_time"].to_numpy(), wrong_s])
    covariance = np.repeat(0.25 * np.eye(2)[None], len(place), axis=0)
    order = np.argsort(time_s, kind="stable")
    none = np.empty((len(place), 0))
    return WatchedTable(time_s[order], place[order], covariance, none, (), watch)


def track_day(count: int) -> Watch:
    """The tracker alone, one step a second."""
    cars = pd.concat(columns_of_cars(SIDE_M, 60.0, 3, float(count)))
    watch = Watch(max(count // 50, 1))
    table = detected(cars[cars["timestep_time"] % 1 == 0], watch, 1.0, SIDE_M)
    began = time.perf_counter()
    tracked = track_detections(table)
    print(f"{tracked.epochs} steps, {len(table.time_s)} detections, {tracked.rows.sizes['row']} rows of "
          f"{len(np.unique(tracked.rows['track_id']))} tracks of {cars['vehicle_id'].nunique()} vehicles in "
          f"{time.perf_counter() - began:.0f} s; at most {peak_mb():.0f} MB")  # fmt: skip
    return watch


def crowd(count: int, duration_s: float) -> tuple[float, pd.DataFrame, int]:
    """Rows of cars, 12 m from each other: side of their square, the cars, and how many there are at once."""
    side_m = LANE_M * np.ceil(np.sqrt(count))
    cars = pd.concat(columns_of_cars(side_m, LANE_M, int(side_m / LANE_M), duration_s))
    return side_m, cars, cars.groupby("timestep_time")["vehicle_id"].nunique().max()


def many_vehicles(count: int) -> Watch:
    """Rows of cars, 12 m from each other, tracked from given detections; 20 false ones a step."""
    side_m, cars, present = crowd(count, 6.0)
    watch = Watch(1)
    rows = track_detections(detected(cars, watch, 20.0, side_m)).rows
    last = int((rows["time_s"] == rows["time_s"].max()).sum())
    print(f"{present} vehicles at once: {last} tracks at the end; at most {peak_mb():.0f} MB")
    return watch


def fly_traffic(folder: Path, count: int) -> Watch:
    """Rows of cars, 12 m from each other, under the default sensor; few of them are in its view at once."""
    side_m, cars, present = crowd(count, 11.0)
    watch = Watch(1)
    design = made_case(folder, {"name": "traffic", "flight": {"frames": 20}}, side_m)
    began = time.perf_counter()
    result = run(with_cars(folder, design, cars), folder / "flown", watch)
    found = {name: round(scores["completeness"], 3) for name, scores in result.scores.items()}
    print(f"{present} vehicles at once, 20 frames in {time.perf_counter() - began:.0f} s; completeness of "
          f"them all {found}; at most {peak_mb():.0f} MB")  # fmt: skip
    return watch


def many_scores(count: int) -> None:
    """Scores of a flight in which every car is tracked twice, one track after the other."""
    cars = pd.concat(columns_of_cars(SIDE_M, 40.0, 4, count / 2 - 0.5))
    number = pd.factorize(cars["vehicle_id"])[0]
    age_s = (cars["vehicle_x"] + SIDE_M / 2) / SPEED_M_S
    columns = {
        "time_s": cars["timestep_time"], "east": cars["vehicle_x"], "north": cars["vehicle_y"],
        "east_speed": np.full(len(cars), SPEED_M_S), "north_speed": np.zeros(len(cars)),
    }  # fmt: skip
    rows = xr.Dataset({name: ("row", np.asarray(values)) for name, values in columns.items()})
    seen = np.flatnonzero(age_s > 1.5)
    tracks = rows.assign(track_id=("row", 2 * number + (age_s.to_numpy() > 9.0))).isel(row=seen)
    epochs = score_epochs(tracks, rows.assign(vehicle_id=("row", number)))
    begun_mb, began = peak_mb(), time.process_time()
    scores = summarize(epochs)
    print(f"{len(epochs)} frames, {len(np.unique(number))} vehicles, "
          f"{len(np.unique(tracks['track_id']))} tracks: "
          f"{time.process_time() - began:.1f} s of CPU; {begun_mb:.0f} MB before, {peak_mb():.0f} at most; "
          f"completeness {scores['completeness']:.3f}, IDF1 {scores['idf1_moving']:.3f}")  # fmt: skip


def large_mesh(folder: Path, count: int) -> None:
    """One frame over a mesh, as `glintrack render` makes it."""
    design = made_case(folder, {"name": "mesh"}, 1500.0, int(np.sqrt(count / 2)), 10.0)
    size_mb = (folder / "ground.ply").stat().st_size / 1e6
    began, cpu = time.perf_counter(), time.process_time()
    picture = render_frame(Case.model_validate(design))
    print(f"{2 * int(np.sqrt(count / 2)) ** 2} triangles, a file of {size_mb:.0f} MB: {picture.sizes['y']} × "
          f"{picture.sizes['x']} elements in {time.perf_counter() - began:.0f} s "
          f"({time.process_time() - cpu:.0f} s of CPU); at most {peak_mb():.0f} MB")  # fmt: skip


def plot(watch: Watch, title: str, path: Path) -> None:
    """Memory and time over the steps."""
    step, mb, _, cpu_ms = np.array(watch.rows).T
    figure, (above, below) = pyplot.subplots(2, 1, sharex=True, figsize=(6, 4), layout="constrained")
    above.plot(step, mb)
    above.set(ylabel="memory held [MB]", ylim=(0, 1.1 * mb.max()), title=title)
    below.plot(step, cpu_ms)
    below.set(ylabel="CPU time a step [ms]", xlabel="step", ylim=(0, 1.1 * np.quantile(cpu_ms, 0.98)))
    figure.savefig(path, dpi=80, metadata={"Software": None})


def main() -> None:
    """Fly, tell, and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    usual = {
        "frames": 10_000,
        "day": 86_400,
        "vehicles": 20_000,
        "traffic": 20_000,
        "scores": 10_000,
        "mesh": 5_000_000,
    }
    parser.add_argument("what", choices=usual)
    parser.add_argument("--count", type=int, help="of frames, seconds, vehicles or triangles")
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    count, watch = asked.count or usual[asked.what], None
    with tempfile.TemporaryDirectory(prefix="glintrack-long-") as scratch:
        if asked.what == "frames":
            watch = fly_frames(Path(scratch), count)
        elif asked.what == "day":
            watch = track_day(count)
        elif asked.what == "vehicles":
            watch = many_vehicles(count)
        elif asked.what == "traffic":
            watch = fly_traffic(Path(scratch), count)
        elif asked.what == "scores":
            many_scores(count)
        else:
            large_mesh(Path(scratch), count)
    if watch is not None and asked.json:
        asked.json.write_text(json.dumps(watch.rows) + "\n")
    if watch is not None and asked.plot:
        names = {
            "frames": f"{count} frames of a small case",
            "day": f"The tracker alone, {count / 3600:.0f} h",
        }
        plot(watch, names.get(asked.what, asked.what), asked.plot)


if __name__ == "__main__":
    main()
