"""Error of the renderer's own sampling over what it costs, against 16 × 16 rays an element on crops.

``python benchmarks/sampling.py [CASE] [--size N] [--reference N] [--even N …] [--errors E …] [--time S]
[--csv FILE]
[--picture FILE]``. Small sensors of the case's own lens and pitch stare at places of the window; each crop is
traced and shaded with n × n rays, with as many as a sampling error asks for, and with the reference's. Errors
of what elements expect are in σ of the sensor's noise there: median and 90 % quantile of |error| as they are,
over flat ground, near what stands tall, and within 15 m of lanes. Rays an element and milliseconds (processor
time of trace and shade on one core, the least of three) are those of a whole frame. ``--picture`` draws where
the rays of the last sampling error go in the first crop, beside what stands there, and measures nothing.
"""

import argparse
import time
from pathlib import Path

import numba
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from scipy.ndimage import maximum_filter
from scipy.spatial import KDTree

from glintrack.bounds.frame import element_points, expected_electrons
from glintrack.camera import look_at
from glintrack.case.build import build_scenario
from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.core.colour import colour_channels, natural_colour
from glintrack.ortho import on_ground
from glintrack.render import Observer, Sampling
from glintrack.sensor import build_sensor, dark_noise_e, light_on_elements

PLACES_M = ((0.0, 0.0), (-180.0, 80.0), (170.0, -110.0))
TALL_M, TALL_ELEMENTS, LANE_M = 0.7, 5, 15.0
MARGIN = 6  # elements at a crop's edge, where the lens has no neighbours
QUANTILES = {"median": 0.5, "90 %": 0.9}
REPEATS = 3
FLAT, TALL, LANES = "flat", "near tall", "within 15 m of lanes"


def crops(scenario, case, size: int, time_s: float):
    """(sensor, pose) of each place."""
    design = case.sensor.replace({"rows": size, "columns": size})
    sensor = build_sensor(design, scenario.sky.wavelength_um)
    flown = scenario.flight.pose(time_s)
    for east, north in PLACES_M:
        target = on_ground(scenario.city.terrain, np.array([[east, north]]))[0]
        yield sensor, look_at(flown, target)


def sampled(observer: Observer, sensor, rays: int | None, error: float | None) -> Observer:
    """The observer with n × n rays an element, or with as many as an error asks for."""
    sampling = error and Sampling(error, sensor.electrons_per_radiance, dark_noise_e(sensor))
    return observer.replace(camera=sensor.camera, oversampling=rays or 1, sampling=sampling or None)


def expected(scenario, sensor, pose, observer: Observer, time_s: float):
    """Expected electrons of a crop, what its elements look at, and the rays of each. [e, m, 1]"""
    hits = observer.trace(scenario.city.at(time_s), pose)
    light = observer.radiance(hits)(sensor.channels).values
    points = element_points(hits, sensor.camera, pose)
    return expected_electrons(light_on_elements(light, sensor), sensor), points, hits.rays


def frame_cost(scenario, observer: Observer, time_s: float) -> tuple[float, float]:
    """Mean rays an element of a whole frame, and the processor's time. [1, s]"""
    pose, snapshot = scenario.flight.pose(time_s), scenario.city.at(time_s)
    spent, rays = [], 0.0
    for _ in range(REPEATS):
        begun = time.process_time()
        hits = observer.trace(snapshot, pose)
        _ = observer.radiance(hits)(scenario.sensor.channels)
        spent.append(time.process_time() - begun)
        rays = float(hits.rays.mean())
    return rays, min(spent)


def where(city, points) -> dict[str, np.ndarray]:
    """Which elements look at flat ground, near something tall, or within 15 m of a lane."""
    flat = np.nan_to_num(points.reshape(-1, 3))
    above = (flat[:, 2] - on_ground(city.terrain, flat)[:, 2]).reshape(points.shape[:2])
    tall = maximum_filter(np.abs(above), TALL_ELEMENTS) > TALL_M
    lanes = [dense(lane) for lane in city.lanes]
    near = np.zeros(tall.shape, bool)
    if lanes:
        near = (KDTree(np.concatenate(lanes)).query(flat[:, :2])[0] <= LANE_M).reshape(tall.shape)
    inner = np.zeros(tall.shape, bool)
    inner[MARGIN:-MARGIN, MARGIN:-MARGIN] = True
    return {FLAT: ~tall & inner, TALL: tall & inner, LANES: near & inner}


def dense(lane, step_m: float = 2.0):
    """A polyline's points, at most so far apart. [m]"""
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(lane, axis=0).T))])
    along = np.linspace(0.0, length[-1], max(int(length[-1] / step_m) + 2, 2))
    return np.stack([np.interp(along, length, lane[:, k]) for k in (0, 1)], axis=1)


def curve(case: Case, size: int, reference: int, ways: list[tuple], time_s: float) -> list[dict]:
    """A row for each way to sample: errors in each kind of place, rays and time of a frame."""
    scenario = build_scenario(case)
    errors: dict[tuple, list[np.ndarray]] = {}
    for sensor, pose in crops(scenario, case, size, time_s):
        finest = sampled(scenario.observer, sensor, reference, None)
        best, points, _ = expected(scenario, sensor, pose, finest, time_s)
        sigma = np.sqrt(np.maximum(best, 0) + dark_noise_e(sensor) ** 2)
        places = where(scenario.city, points)
        for way in ways:
            observer = sampled(scenario.observer, sensor, *way)
            found, _, _ = expected(scenario, sensor, pose, observer, time_s)
            for name, inside in places.items():
                errors.setdefault((way, name), []).append((np.abs(found - best) / sigma)[inside])
    out = []
    for rays, error in ways:
        whole = sampled(scenario.observer, scenario.sensor, rays, error)
        spread, seconds = frame_cost(scenario, whole, time_s)
        row: dict = {"sampling": f"{rays} x {rays}" if rays else f"error {error:g}"}
        row |= {"rays an element": f"{spread:.2f}", "ms a frame": f"{1e3 * seconds:.0f}"}
        for name in (FLAT, TALL, LANES):
            every = np.concatenate(errors[(rays, error), name])
            for label, share in QUANTILES.items():
                row[f"{name}, {label}"] = f"{np.quantile(every, share):.2f}" if every.size else "nan"
        out.append(row)
    return out


def draw_rays(case: Case, size: int, error: float, time_s: float, path: Path) -> None:
    """What stands in the first crop, and how many rays each element gets at a sampling error."""
    scenario = build_scenario(case)
    sensor, pose = next(crops(scenario, case, size, time_s))
    observer = sampled(scenario.observer, sensor, None, error)
    hits = observer.trace(scenario.city.at(time_s), pose)
    channels = colour_channels(scenario.sky.wavelength_um)
    xyz = observer.radiance(hits)(channels).values[..., 0]
    rays = hits.rays.reshape(hits.rows, hits.columns)
    figure = Figure(figsize=(10, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.imshow(natural_colour(xyz, observer.white(channels)), interpolation="nearest")
    left.set_title(f"{case.name}, {size} × {size} elements", loc="left")
    counts = right.imshow(rays, norm=LogNorm(), cmap="viridis", interpolation="nearest")
    right.set_title(f"rays an element at an error of {error:g} σ: mean {rays.mean():.1f}", loc="left")
    figure.colorbar(counts, ax=right, shrink=0.9)
    for axes in (left, right):
        axes.set_xticks([])
        axes.set_yticks([])
    figure.savefig(path, dpi=110)


def main() -> None:
    """Print the curve, and write it if asked."""
    parser = argparse.ArgumentParser(description="Error of the sampling over what it costs")
    parser.add_argument("case", nargs="?", default="quickstart")
    parser.add_argument("--size", type=int, default=128, help="elements along a crop")
    parser.add_argument("--reference", type=int, default=16)
    parser.add_argument("--even", type=int, nargs="*", default=[1, 2, 3, 4, 5])
    parser.add_argument("--errors", type=float, nargs="*", default=[10, 8, 6, 4, 2, 1])
    parser.add_argument("--time", type=float, default=10.0, help="of the flight [s]")
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--picture", type=Path, help="draw where rays go, and measure nothing")
    asked = parser.parse_args()
    numba.set_num_threads(1)
    case = Case.from_toml(find_case(asked.case))
    if asked.picture:
        draw_rays(case, asked.size, asked.errors[-1], asked.time, asked.picture)
        return
    ways = [(n, None) for n in asked.even] + [(None, error) for error in asked.errors]
    rows = curve(case, asked.size, asked.reference, ways, asked.time)
    lines = [",".join(f'"{name}"' if "," in name else name for name in rows[0])]
    lines += [",".join(row.values()) for row in rows]
    print("\n".join(lines))
    if asked.csv:
        asked.csv.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
