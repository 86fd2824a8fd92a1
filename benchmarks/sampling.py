"""Error of the renderer's own sampling over what it costs: n × n rays an element against 16 × 16, on crops.

``python benchmarks/sampling.py [CASE] [--size N] [--reference N] [--rays N …] [--time S] [--csv FILE]``.
Small sensors of the case's own lens and pitch stare at places of the window; each crop is traced and shaded
with n × n rays and with the reference's. Errors of what elements expect are in σ of the sensor's noise there,
as quantiles of |error| over those of a unit Gaussian: median/0.674 and 90 %/1.645, over flat ground, near
what stands tall, and within 15 m of lanes. Milliseconds are processor time of trace and shade for each
million elements; the first of a process compiles.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from glintrack.bound.frame import dark_electrons, element_points, expected_electrons
from glintrack.camera import look_at
from glintrack.config import Case, find_case
from glintrack.ortho import on_ground
from glintrack.render import trace
from glintrack.render.observer import SURROUNDINGS
from glintrack.scenario import build_scenario
from glintrack.sensor import build_sensor, light_on_elements

PLACES_M = ((0.0, 0.0), (-180.0, 80.0), (170.0, -110.0))
TALL_M, TALL_ELEMENTS, LANE_M = 0.7, 5, 15.0
MARGIN = 6  # elements at a crop's edge, where the lens has no neighbours
QUANTILES = {"median": (0.5, 0.6745), "90 %": (0.9, 1.645)}


def crops(scenario, case, size: int, time_s: float):
    """(sensor, pose) of each place."""
    design = case.sensor.replace({"rows": size, "columns": size})
    sensor = build_sensor(design, scenario.sky.wavelength_um)
    flown = scenario.flight.pose(time_s)
    for east, north in PLACES_M:
        target = on_ground(scenario.city.terrain, np.array([[east, north]]))[0]
        yield sensor, look_at(flown, target)


def expected(scenario, sensor, pose, rays: int, time_s: float):
    """Expected electrons of a crop, what its elements look at, and the processor's time. [e, m, s]"""
    whole, materials = scenario.observer, scenario.city.materials
    begun = time.process_time()
    hits = trace(
        scenario.city.at(time_s),
        sensor.camera,
        pose,
        whole.sky.sun_direction,
        roughness=materials["roughness"].values,
        surroundings=materials["material"].values.tolist().index(SURROUNDINGS),
        oversampling=rays,
        tracer=whole.tracer,
    )
    light = whole.radiance(hits)(sensor.channels).values
    spent = time.process_time() - begun
    points = element_points(hits, sensor.camera, pose)
    return expected_electrons(light_on_elements(light, sensor), sensor), points, spent


def where(city, points) -> dict[str, np.ndarray]:
    """Which elements look at flat ground, near something tall, or within 15 m of a lane."""
    flat = np.nan_to_num(points.reshape(-1, 3))
    above = (flat[:, 2] - on_ground(city.terrain, flat)[:, 2]).reshape(points.shape[:2])
    tall = maximum_filter(np.abs(above), TALL_ELEMENTS) > TALL_M
    lanes = [dense(lane) for lane in city.lanes]
    near = np.zeros(tall.shape, bool)
    if lanes:
        near = (cKDTree(np.concatenate(lanes)).query(flat[:, :2])[0] <= LANE_M).reshape(tall.shape)
    inner = np.zeros(tall.shape, bool)
    inner[MARGIN:-MARGIN, MARGIN:-MARGIN] = True
    return {"flat": ~tall & inner, "near tall": tall & inner, "within 15 m of lanes": near & inner}


def dense(lane, step_m: float = 2.0):
    """A polyline's points, at most so far apart. [m]"""
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(lane, axis=0).T))])
    along = np.linspace(0.0, length[-1], max(int(length[-1] / step_m) + 2, 2))
    return np.stack([np.interp(along, length, lane[:, k]) for k in (0, 1)], axis=1)


def curve(case: Case, size: int, reference: int, rays: list[int], time_s: float) -> list[dict]:
    """A row a number of rays: errors in each kind of place, and the time."""
    scenario = build_scenario(case)
    errors: dict[tuple[int, str], list[np.ndarray]] = {}
    spent = dict.fromkeys([*rays, reference], 0.0)
    for sensor, pose in crops(scenario, case, size, time_s):
        best, points, seconds = expected(scenario, sensor, pose, reference, time_s)
        spent[reference] += seconds
        sigma = np.sqrt(np.maximum(best, 0) + dark_electrons(sensor) ** 2)
        places = where(scenario.city, points)
        for n in rays:
            found, _, seconds = expected(scenario, sensor, pose, n, time_s)
            spent[n] += seconds
            for name, inside in places.items():
                errors.setdefault((n, name), []).append((np.abs(found - best) / sigma)[inside])
    out = []
    for n in rays:
        row: dict = {"rays": n * n, "ms_per_million": 1e9 * spent[n] / (len(PLACES_M) * size * size)}
        for name in ("flat", "near tall", "within 15 m of lanes"):
            every = np.concatenate(errors[n, name])
            for label, (share, unit) in QUANTILES.items():
                row[f"{name}, {label}"] = np.quantile(every, share) / unit if every.size else np.nan
        out.append(row)
    return out


def main() -> None:
    """Print the curve, and write it if asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("case", nargs="?", default="quickstart")
    parser.add_argument("--size", type=int, default=128, help="elements along a crop")
    parser.add_argument("--reference", type=int, default=16)
    parser.add_argument("--rays", type=int, nargs="+", default=[1, 2, 3, 4, 5])
    parser.add_argument("--time", type=float, default=10.0, help="of the flight [s]")
    parser.add_argument("--csv", type=Path)
    asked = parser.parse_args()
    case = Case.from_toml(find_case(asked.case))
    rows = curve(case, asked.size, asked.reference, asked.rays, asked.time)
    lines = [",".join(rows[0]), *(",".join(f"{v:.3g}" for v in row.values()) for row in rows)]
    print("\n".join(lines))
    if asked.csv:
        asked.csv.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
