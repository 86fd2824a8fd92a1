"""How cost grows: processor time and peak memory over elements, bands, triangles, vehicles and queries.

``python benchmarks/cost_laws.py [--quick] [--only LAW …] [--json FILE] [--csv FILE] [--figure FILE]``. A law
is t ∝ n^p; p is the slope of log t over log n, by least squares, in the upper half of log n, where what
does not grow weighs least; beside it the slope between the two largest sizes. ``near-linear or better`` is
p ≤ 1.15. Times are processor time of all threads [s], the least of some calls after a first one that
compiles, and finds probes, uncounted: other work on the machine stretches it less than the wall clock's. Each
law is measured in a process of its own, smallest size first, so that the most memory held so far is that of
the size [MB]; it is left out where there is no /proc.
"""

import argparse
import csv
import json
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the program does, before NumPy is loaded

import numpy as np
from tracker import designs, moving, step_ms
from tracking import tracks_of, truth_of

from glintrack.camera import Camera
from glintrack.core.heaps import share_heaps
from glintrack.core.records import ServedQueries, SpectralQuery
from glintrack.core.spectral import channel_weights
from glintrack.metrics import score_epoch
from glintrack.render import Observer, build_tracer, shade_blocks
from glintrack.render.strips import frame_light
from glintrack.scene import City, Snapshot
from glintrack.scene.objects.instances import no_instances
from glintrack.scene.terrain import level_terrain
from glintrack.scene.traffic import Traffic
from glintrack.sensor import SensorDesign, build_sensor, measure_spectra, serve
from render import Set, build_set, hills, memory_mb, with_bands

NEAR_LINEAR = 1.15
APART_M = 12.0  # between vehicles: however many there are, a view holds as many
GROUND_TRIANGLES = 1000  # under vehicles
SCANS = 9  # of a tracker, six of which are not counted
Timed = Iterator[tuple[int, float]]  # size and processor time [s]


@dataclass(frozen=True)
class Law:
    """One cost over one size.

    Parameters
    ----------
    over
        What the size counts.
    least, most
        Decades of the sizes.
    measure
        Gives size and processor time of each size asked for. [s]
    """

    over: str
    least: int
    most: int
    measure: Callable[[Sequence[int]], Timed]

    def sizes(self, quick: bool) -> list[int]:
        """Every half decade; with ``quick``, three decades from the least on."""
        most, a_decade = (min(self.most, self.least + 2), 1) if quick else (self.most, 2)
        steps = np.arange(a_decade * self.least, a_decade * most + 1)
        return [round(10 ** (step / a_decade)) for step in steps]


@dataclass(frozen=True)
class Point:
    """What one size took; a line of the CSV."""

    law: str
    over: str
    size: int
    cpu_s: float
    peak_mb: float | None


def exponent(sizes: Sequence[float], seconds: Sequence[float]) -> float:
    """Slope of log time over log size in the upper half of log size. [1]"""
    n, t = np.log(np.asarray(sizes, float)), np.log(np.asarray(seconds, float))
    upper = n >= 0.5 * (n.min() + n.max()) - 1e-9
    return float(np.polyfit(n[upper], t[upper], 1)[0])


def cpu_s(work: Callable[[], object]) -> float:
    """Least processor time of one to three calls, two seconds of them at least, after one not counted. [s]"""
    work()
    took: list[float] = []
    while len(took) < 3 and sum(took) < 2.0:
        began = time.process_time()
        work()
        took.append(time.process_time() - began)
    return min(took)


def over_elements(sizes: Sequence[int]) -> Timed:
    """Trace and shade one channel of the default city; large frames go in strips, as the program does."""
    one = build_set()
    camera = one.camera
    for size in sizes:
        factor = (size / (camera.rows * camera.columns)) ** 0.5
        shape = round(camera.rows * factor), round(camera.columns * factor)
        observer = one.observer.replace(camera=Camera(camera.focal_length_m, camera.pitch_m / factor, *shape))
        yield (
            shape[0] * shape[1],
            cpu_s(lambda o=observer: frame_light(o, one.snapshot, one.pose)(one.pan)),
        )


def over_bands(sizes: Sequence[int]) -> Timed:
    """Trace, and shade a cube of so many bands in blocks, none kept."""
    one = build_set()
    for size in sizes:
        sky = with_bands(one, size)

        def cube(sky=sky):
            hits = one.observer.trace(one.snapshot, one.pose)
            for _ in shade_blocks(hits, sky, one.city.materials, wavelength_um=sky.wavelength_um, rows=8):
                pass

        yield size, cpu_s(cube)


def over_wavelengths(sizes: Sequence[int]) -> Timed:
    """Trace, and shade one channel that is the mean of so many wavelengths."""
    one = build_set()
    for size in sizes:
        sky = with_bands(one, size)
        weights = channel_weights(sky.wavelength_um, np.ones((1, size)))
        yield (
            size,
            cpu_s(lambda s=sky, w=weights: one.shade(one.observer.trace(one.snapshot, one.pose), w, s)),
        )


def ground(triangles: int) -> Snapshot:
    """Rolling ground alone."""
    none = np.zeros(0, int)
    return Snapshot(hills(triangles), (), np.zeros((0, 3, 4)), none, none, none)


def over_triangles(sizes: Sequence[int]) -> Timed:
    """Trace and shade one channel of rolling ground."""
    one = build_set()
    for size in sizes:
        scene = ground(size)
        tracer = build_tracer(scene)
        yield (
            len(scene.static.faces),
            cpu_s(lambda t=tracer, s=scene: one.shade(one.trace(t, snapshot=s), one.pan)),
        )


def building_over_triangles(sizes: Sequence[int]) -> Timed:
    """Build the intersector of rolling ground."""
    for size in sizes:
        scene = ground(size)
        yield len(scene.static.faces), cpu_s(lambda s=scene: build_tracer(s))


def city_of(one: Set, vehicles: int) -> City:
    """Level ground with so many cars in rows, on a square that grows with them."""
    side = int(np.ceil(vehicles**0.5))
    place = (
        APART_M * (np.arange(vehicles) % side - side / 2),
        APART_M * (np.arange(vehicles) // side - side / 2),
    )
    steps = 3
    all_of = partial(np.full, vehicles)
    east, north = (np.repeat(p, steps) for p in place)
    drive = np.tile(5.0 * np.arange(steps), vehicles)  # 10 m/s eastward
    traffic = Traffic(
        0.5, steps, all_of(0), all_of(steps), all_of(0), east + drive, north, np.full(len(east), np.pi / 2)
    )
    reach = APART_M * (side / 2 + 1)
    extent = (-reach, -reach, reach, reach)
    city = replace(
        one.city, static=hills(GROUND_TRIANGLES), planted=no_instances(), traffic=traffic, start_s=0.0,
        terrain=level_terrain(extent), extent_m=extent, paints=all_of(int(one.city.paints[0])),
    )  # fmt: skip
    return city


def over_vehicles(sizes: Sequence[int]) -> Timed:
    """Place vehicles, trace and shade one channel, and say which can be seen; most are out of view."""
    one = build_set()
    for size in sizes:
        city = city_of(one, size)
        observer = Observer(city, one.sky, one.camera, city.at(0.0))

        def frame(city=city, observer=observer):
            traced = observer.observe(city.at(0.5), one.pose)
            observer.radiance(traced.hits)(one.pan)
            return city.truth(0.5)

        yield size, cpu_s(frame)


def steps_over_vehicles(name: str, sizes: Sequence[int]) -> Timed:
    """A step of the tracker with the queries it asks."""
    for size in sizes:
        rng = np.random.default_rng(0)
        side, scans = moving(size, SCANS, rng)
        yield size, 1e-3 * step_ms(designs()[name], side, scans, rng)


def scores_over_vehicles(sizes: Sequence[int]) -> Timed:
    """Match the tracks of a frame with its vehicles."""
    rng = np.random.default_rng(0)
    for size in sizes:
        side = APART_M * size**0.5
        states = np.zeros((size, 5))
        states[:, :2], states[:, 3] = rng.uniform(0, side, (size, 2)), 10.0
        truth = truth_of(np.arange(size), states)
        tracks = tracks_of(np.arange(size), states[:, :2] + rng.normal(0, 0.5, (size, 2)))
        yield size, cpu_s(lambda a=tracks, b=truth, s=side: score_epoch(a, b, (0.0, 0.0, s, s)))


def serving_over_queries(sizes: Sequence[int]) -> Timed:
    """Turn what a tracker asks of the ground into mirrors, at most one a column."""
    one, rng = build_set(), np.random.default_rng(0)
    sensor = build_sensor(SensorDesign(), one.sky.wavelength_um)
    for size in sizes:
        west, south, east, north = one.city.extent_m
        place = rng.uniform((west, south), (east, north), (size, 2)).tolist()
        asked = tuple(SpectralQuery(x, y, priority=k) for k, (x, y) in enumerate(place))
        yield size, cpu_s(lambda q=asked: serve(q, sensor, one.pose))


def spectra_over_queries(sizes: Sequence[int]) -> Timed:
    """Take spectra at so many superpixels of the default city; a frame's mirrors serve 440 at most."""
    one, rng = build_set(), np.random.default_rng(0)
    sensor = build_sensor(SensorDesign(), one.sky.wavelength_um)
    radiance = one.observer.radiance(one.observer.trace(one.snapshot, one.pose))
    for size in sizes:
        rows, columns = (
            rng.integers(0, n // sensor.side, size) for n in (one.camera.rows, one.camera.columns)
        )
        served = ServedQueries((SpectralQuery(0.0, 0.0),) * size, rows, columns, ("",) * size)
        yield size, cpu_s(lambda s=served: measure_spectra(s, radiance, sensor, np.random.default_rng(1)))


LAWS = {
    "frame, elements": Law("elements", 4, 7, over_elements),
    "frame as a cube, bands": Law("bands", 0, 3, over_bands),
    "frame in one channel, wavelengths": Law("bands", 0, 3, over_wavelengths),
    "frame, triangles": Law("triangles", 4, 7, over_triangles),
    "building the intersector, triangles": Law("triangles", 4, 7, building_over_triangles),
    "frame, vehicles": Law("vehicles", 1, 5, over_vehicles),
    "tracker's step and queries, vehicles": Law(
        "vehicles", 1, 5, partial(steps_over_vehicles, "asking at once")
    ),
    "the same with `mht`, vehicles": Law("vehicles", 1, 5, partial(steps_over_vehicles, "MHT")),
    "scores of a frame, vehicles": Law("vehicles", 1, 5, scores_over_vehicles),
    "mirrors for queries, queries": Law("queries", 1, 5, serving_over_queries),
    "spectra, queries": Law("queries", 1, 5, spectra_over_queries),
}


def points_of(name: str, quick: bool) -> list[Point]:
    """One law, size after size; called in a fresh process."""
    share_heaps()  # as the program does
    law, found = LAWS[name], []
    for size, seconds in law.measure(law.sizes(quick)):
        found.append(Point(name, law.over, size, seconds, memory_mb("VmHWM")))
    return found


def summary(points: Sequence[Point]) -> dict:
    """Of one law: its ends, its exponent, and what that means."""
    sizes, seconds = [point.size for point in points], [point.cpu_s for point in points]
    p = exponent(sizes, seconds)
    verdict = "near-linear or better" if p <= NEAR_LINEAR else "more than linear"
    return {
        "law": points[0].law,
        "sizes": (points[0].size, points[-1].size),
        "cpu_s": (points[0].cpu_s, points[-1].cpu_s),
        "peak_mb": (points[0].peak_mb, points[-1].peak_mb),
        "exponent": p,
        "last_exponent": float(np.log(seconds[-1] / seconds[-2]) / np.log(sizes[-1] / sizes[-2])),
        "verdict": verdict,
    }


def write_csv(points: Sequence[Point], path: Path) -> None:
    """A line a size."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(Point.__dataclass_fields__), lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(point) for point in points)


def draw(points: Sequence[Point], path: Path) -> None:
    """A column a kind of size: processor time above, peak memory below."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(17, 6.4), layout="constrained")
    kinds = list(dict.fromkeys(law.over for law in LAWS.values()))
    above, below = figure.subplots(2, len(kinds), sharex="col")
    for law in dict.fromkeys(point.law for point in points):
        mine = [point for point in points if point.law == law]
        column = kinds.index(mine[0].over)
        sizes = [point.size for point in mine]
        label = f"{law.rpartition(',')[0]}: {summary(mine)['exponent']:.2f}"
        above[column].loglog(sizes, [point.cpu_s for point in mine], "o-", ms=3, label=label)
        if all(point.peak_mb for point in mine):
            below[column].loglog(sizes, [point.peak_mb for point in mine], "o-", ms=3)
    for kind, time_ax, memory_ax in zip(kinds, above, below, strict=True):
        if not time_ax.lines:
            continue
        highest = max((line.get_xydata() for line in time_ax.lines), key=lambda at: at[-1, 1])
        low, high = time_ax.get_ylim()
        x, end = highest[:, 0], highest[-1]
        time_ax.plot(x, end[1] * x / end[0], "k:", lw=1, label="as the size")
        time_ax.set_ylim(low, 6 * high * (high / low) ** (0.1 * (len(time_ax.lines) - 2)))  # a legend's room
        memory_ax.set(xlabel=kind, ylim=(200, 6000))
        time_ax.legend(fontsize=8, loc="upper left")
        for ax in (time_ax, memory_ax):
            ax.grid(alpha=0.3)
    above[0].set_ylabel("processor time / s")
    below[0].set_ylabel("peak memory / MB")
    figure.savefig(path, dpi=90, metadata={"Software": None})


def main() -> None:
    """Measure, print a table, write what is asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="the three least decades, about a minute")
    parser.add_argument("--only", nargs="+", choices=LAWS, default=list(LAWS), metavar="LAW")
    parser.add_argument("--json", type=Path, metavar="FILE", help="exponents, and all sizes")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="all sizes")
    parser.add_argument("--figure", type=Path, metavar="FILE")
    given = parser.parse_args()
    points: list[Point] = []
    laws: list[dict] = []
    print(
        "| law | sizes | processor time | peak memory | exponent | of the last two | |\n" + "| --- " * 7 + "|"
    )
    for name in given.only:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            mine = pool.apply(points_of, (name, given.quick))
        points += mine
        laws.append(summary(mine))
        print(line_of(laws[-1]), flush=True)
    if given.csv:
        write_csv(points, given.csv)
    if given.json:
        rows = [asdict(point) for point in points]
        given.json.write_text(json.dumps({"laws": laws, "rows": rows}, indent=1) + "\n", encoding="utf-8")
    if given.figure:
        draw(points, given.figure)


def line_of(law: dict) -> str:
    """A row of the table."""
    sizes, seconds = (f"{low:.3g} … {high:.3g}" for low, high in (law["sizes"], law["cpu_s"]))
    low, high = law["peak_mb"]
    memory = f"{low:.0f} … {high:.0f} MB" if low else ""
    return (
        f"| {law['law']} | {sizes} | {seconds} s | {memory} | {law['exponent']:.2f} | "
        f"{law['last_exponent']:.2f} | {law['verdict']} |"
    )


if __name__ == "__main__":
    main()
