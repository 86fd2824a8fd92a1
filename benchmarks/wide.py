"""A wide area on one machine: one frame of 4 km² at 0.5 m with a thousand vehicles, rendered in strips.

``python benchmarks/wide.py [--quick] [--json FILE]`` builds the city, looks straight down on it from 3 km and
renders radiance (I, Q, U) of the panchromatic band, as ``glintrack render --band`` does, in a process of its
own. It needs the extra ``traffic``; SUMO's run is kept in the user's cache and not counted. ``--quick`` takes
the default city at 0.25 m. Times are of all cores together. A frame so large is traced strip by strip
(`render.strips`); ``whole`` is what its hits would take at once.
"""

import argparse
import json
import multiprocessing
import resource
import time
from pathlib import Path

import numpy as np

from glintrack.case.build import trace_frame
from glintrack.case.design import Case
from glintrack.render import strips
from glintrack.render.frame import render_product
from glintrack.scene import record_traffic

PITCH_UM, ALTITUDE_M = 10.0, 3000.0
WAYS = {  # ground sample, size, and traffic: so many enter a second that a thousand drive
    "4 km²": (0.5, (2000.0, 2000.0), {"traffic_warmup_s": 120.0, "traffic_duration_s": 5.0,
                                      "traffic_insertion_period_s": 0.1}),
    "default city": (0.25, (660.0, 420.0), {}),
}  # fmt: skip
KB_A_MB = 1e3  # getrusage gives kB


def case_of(gsd_m: float, size_m: tuple[float, float], traffic: dict) -> Case:
    """The city looked at straight down, an element each ground sample."""
    wide, high = size_m
    scene = {"city": "embedded", **traffic}
    if traffic:
        scene |= {"width_m": wide, "height_m": high}
    return Case.model_validate({
        "name": "wide",
        "channels": ["pan"],
        "scene": scene,
        "flight": {"off_nadir_deg": 0.0, "altitude_m": ALTITUDE_M, "speed_m_s": 0.0, "frames": 1},
        "sensor": {
            "rows": round(high / gsd_m), "columns": round(wide / gsd_m), "pitch_um": PITCH_UM,
            "focal_length_mm": PITCH_UM * 1e-3 * ALTITUDE_M / gsd_m,
        },
    })  # fmt: skip


def measure(way: str) -> dict[str, float]:
    """Render the frame; called in a fresh process."""
    case = case_of(*WAYS[way])
    record_traffic(case.scene)
    started = time.process_time()
    view = trace_frame(case)
    if not isinstance(view.radiance, strips.StripRadiance):
        raise ValueError(f"the frame must be larger than {strips.AT_ONCE_BYTES / 1e9:g} GB to be cut")
    snapshot, built, city_mb = view.radiance.snapshot, time.process_time() - started, peak_mb()
    view.observer.prepare()
    ready, started = time.process_time() - started - built, time.process_time()
    _, light = render_product(view, "radiance")
    spent = time.process_time() - started
    if not np.isfinite(light).all():
        raise ValueError("the frame must have light everywhere")
    rays = view.camera.rows * view.camera.columns
    return {
        "elements": rays,
        "vehicles that drive": len(snapshot.vehicle_id) - snapshot.fixed,
        "instances": len(snapshot.model),
        "strips": -(-view.camera.rows // view.radiance.rows),
        "city, CPU s": built,
        "intersector, CPU s": ready,
        "frame, CPU s": spent,
        "elements a CPU second": rays / spent,
        "city, peak MB": city_mb,
        "peak MB": peak_mb(),
        "whole, MB": strips.whole_bytes(view.observer) / 1e6,
        "probes' lattice, m": view.observer.tracer.probes.step_m,
    }


def peak_mb() -> float:
    """Most memory that this process held so far. [MB]"""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / KB_A_MB


def main() -> None:
    """Measure, print a table, write the rows."""
    parser = argparse.ArgumentParser(description="Render a wide area in strips.")
    parser.add_argument("--quick", action="store_true", help="the default city at 0.25 m")
    parser.add_argument("--json", type=Path, help="file for the rows")
    arguments = parser.parse_args()
    way = list(WAYS)[1 if arguments.quick else 0]
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        found = pool.apply(measure, (way,))
    print(f"| {way} | |\n| --- | --- |")
    for name, value in found.items():
        shown = f"{value:.1f}" if name.endswith(("CPU s", " m")) else f"{value:,.0f}".replace(",", " ")
        print(f"| {name} | {shown} |")
    if arguments.json:
        rows = [
            {"name": f"{way}: {name}", "value": value, "unit": "1", "peer": None, "ratio": None}
            for name, value in found.items()
        ]
        arguments.json.write_text(json.dumps({"rows": rows}, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
