"""What cities cost: triangles stored and seen, build time and peak memory, by the size of the window.

``python benchmarks/scene.py [--quick] [--json FILE] [--markdown]``. Each city is built in a process of its
own, with an empty cache, and then read from it. Cities of another size than the default's need the extra
``traffic`` and get 5 s of it; the time SUMO takes is given apart. There is no peer that builds the same; the
peer of the triangles is the same city without instances.
"""

import argparse
import json
import multiprocessing
import os
import resource
import tempfile
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from glintrack.core.extras import MissingExtraError
from glintrack.scene import SceneDesign, build_scene, record_traffic

SHORT = {"traffic_warmup_s": 20.0, "traffic_duration_s": 5.0}  # traffic costs SUMO's time, not the city's
CITIES: dict[str, dict] = {
    "default city, 660 m × 420 m": {},
    "the same, level": {"relief_m": 0.0},
    "1 km²": {"width_m": 1000.0, "height_m": 1000.0, **SHORT},
    "4 km²": {"width_m": 2000.0, "height_m": 2000.0, **SHORT},
}
QUICK = 1
MIB = 1024.0  # of getrusage's KiB
SIZES = "stored triangles", "seen triangles", "instances"
COLUMNS = (*SIZES, "SUMO s", "build s", "build CPU s", "read CPU s", "peak MiB")


def measure(keys: dict) -> dict[str, float]:
    """Build one city and say what it took; called in a fresh process."""
    with tempfile.TemporaryDirectory() as cache:
        os.environ["XDG_CACHE_HOME"] = cache
        return measure_built(SceneDesign(**keys))


def measure_built(design: SceneDesign) -> dict[str, float]:
    """What a city takes to build, with nothing kept, and to read."""
    started = time.perf_counter()
    record_traffic(design)
    driven, busy = time.perf_counter(), time.process_time()
    city = build_scene(design)
    built, busy = time.perf_counter(), time.process_time() - busy
    begun = time.process_time()
    build_scene(design)
    read = time.process_time() - begun
    snapshot = city.at(0.0)
    sizes = [len(model.faces) for model in city.models]
    static = len(city.static.faces)
    return {
        "stored triangles": static + sum(sizes),
        "seen triangles": static + sum(sizes[k] for k in snapshot.model),
        "instances": len(snapshot.model),
        "SUMO s": driven - started,
        "build s": built - driven,
        "build CPU s": busy,
        "read CPU s": read,
        "peak MiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / MIB,
    }


def main() -> None:
    """Measure, print a table, write the rows."""
    parser = argparse.ArgumentParser(description="Measure what cities cost.")
    parser.add_argument("--quick", action="store_true", help="the default city only")
    parser.add_argument("--json", type=Path, help="file for the rows")
    parser.add_argument("--markdown", action="store_true", help="print the table of docs/scene.md")
    arguments = parser.parse_args()
    names = list(CITIES)[: QUICK if arguments.quick else None]
    found: dict[str, dict[str, float]] = {}
    for name in names:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            try:
                found[name] = pool.apply(measure, (CITIES[name],))
            except MissingExtraError as error:
                print(f"{name}: left out, {error}")
    lines = [(name, *(_shown(column, row[column]) for column in COLUMNS)) for name, row in found.items()]
    if arguments.markdown:
        head = ("city", *COLUMNS)
        ruled = (head, ["---"] * len(head), *lines)
        print("\n".join("| " + " | ".join(line) + " |" for line in ruled))
    else:
        table = Table("city", *COLUMNS)
        for line in lines:
            table.add_row(*line)
        Console(width=140).print(table)
    if arguments.json:
        arguments.json.write_text(json.dumps({"rows": rows(found)}, indent=1), encoding="utf-8")


def rows(found: dict[str, dict[str, float]]) -> list[dict]:
    """One entry a figure, in the form all benchmarks share."""
    out = []
    for name, row in found.items():
        for column in COLUMNS:
            unit = {"SUMO s": "s", "build s": "s", "build CPU s": "s", "peak MiB": "MiB"}.get(column, "1")
            entry = {"name": f"{name}: {column}", "value": row[column], "unit": unit}
            entry |= {"peer": None, "ratio": None}
            if column == "stored triangles":
                seen = row["seen triangles"]
                entry |= {"peer": "one mesh without instances", "ratio": seen / row[column]}
            out.append(entry)
    return out


def _shown(column: str, value: float) -> str:
    return f"{value:.1f}" if column.endswith(" s") else f"{value:,.0f}".replace(",", " ")


if __name__ == "__main__":
    main()
