"""Measure the whole product and write one table: scores of tracks, validation, peers, size of the code.

    python tools/scoreboard.py [--quick] [--output FILE.md] [--before FILE.csv] [--benchmarks FILE.json …]

Simulates the packaged cases and the situations (``--situations DIR``, by default ``../shared/situations``
where it exists) with five named seeds, each with its own city and traffic, and scores them from frame 8 on,
when tracks can exist. Intervals are 95 % by Student's t over the seeds. ``--quick`` simulates one seed and 24
frames. The CSV of the same name holds the same rows; ``--before`` adds a column from the CSV of another
commit. Ratios to peers are read from what ``benchmarks/*.py --json FILE`` wrote; above 1 the peer is slower.
``--only code --root DIR`` counts the code of another checkout.
"""

import argparse
import ast
import csv
import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
from scipy import stats

sys.path.insert(0, str(Path(__file__).parents[1]))
from glintrack import metrics
from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.loop import simulate

ROOT = Path(__file__).parents[1]
SEEDS = (31, 32, 33, 34, 35)
FIRST_FRAME, QUICK_FRAMES = 8, 24
PACKAGED = ("quickstart", "braunschweig")
OWN_TRAFFIC = {"scene.traffic_duration_s": 130.0, "flight.start_s": 20.0}  # longer than the shipped recording
QUANTITIES = {
    "completeness_visible": "1", "custody": "1", "purity": "1", "identity_switches": "1",
    "false_per_km2": "km-2",
}  # fmt: skip
MAX_PARAMETERS = 10
COUNT_KEYS = "import json; from glintrack import Case; print(json.dumps(Case.model_json_schema()))"


@dataclass(frozen=True)
class Row:
    """One measured quantity.

    Parameters
    ----------
    part, case, channel, quantity
        Where it belongs. ``case`` is the case, reference, peer or folder.
    value, low, high
        Mean and its 95 % interval; NaN where there is no interval.
    unit
        Unit of the three.
    """

    part: str
    case: str
    channel: str
    quantity: str
    value: float
    low: float = math.nan
    high: float = math.nan
    unit: str = "1"

    @property
    def key(self) -> tuple[str, str, str, str]:
        """Subject of the row."""
        return self.part, self.case, self.channel, self.quantity


def mean_and_interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Mean of finite values and the 95 % interval of the mean by Student's t."""
    known = np.array([v for v in values if math.isfinite(v)], float)
    if len(known) == 0:
        return math.nan, math.nan, math.nan
    mean = float(known.mean())
    if len(known) < 2:
        return mean, math.nan, math.nan
    half = float(stats.t.ppf(0.975, len(known) - 1) * known.std(ddof=1) / math.sqrt(len(known)))
    return mean, mean - half, mean + half


# ---- scores of tracks


def score_flight(tracks, truth, area_m, first_frame: int = FIRST_FRAME) -> dict[str, float]:
    """Scores of a table of tracks against the truth, without the first frames."""
    (epochs,) = metrics.score_tables([tracks], truth, area_m)
    scores = metrics.summarize(epochs[first_frame:])
    return {name: float(scores[name]) for name in QUANTITIES}


def simulate_scores(case: Case) -> dict[str, dict[str, float]]:
    """Simulate a case; scores by channel."""
    areas = []
    tree = simulate(case, lambda epoch: areas or areas.append(epoch.city.extent_m))
    truth = tree["/truth"].to_dataset()
    return {
        channel: score_flight(tree[f"/{channel}/tracks"].to_dataset(), truth, areas[0])
        for channel in case.channels
    }


def cases_by_name(situations: Path | None) -> dict[str, Case]:
    """Load the packaged cases, with traffic of their own, and the situations of a folder."""
    cases = {name: Case.from_toml(find_case(name)) for name in PACKAGED}
    cases["quickstart"] = cases["quickstart"].replace(OWN_TRAFFIC)
    for path in sorted(situations.glob("*.toml")) if situations else ():
        cases[path.stem] = Case.from_toml(path)
    return cases


def track_rows(cases: dict[str, Case], seeds: Sequence[int], frames: int | None) -> Iterator[Row]:
    """Rows of every case and channel."""
    for name, case in cases.items():
        flights = []
        for seed in seeds:
            changes = {"seed": seed, "scene.seed": seed}
            changes |= {} if frames is None else {"flight.frames": frames}
            flights.append(simulate_scores(case.replace(changes)))
            print(f"{name}, seed {seed}: {flights[-1]}", file=sys.stderr, flush=True)
        for channel in flights[0]:
            for quantity, unit in QUANTITIES.items():
                values = [flight[channel][quantity] for flight in flights]
                yield Row("tracks", name, channel, quantity, *mean_and_interval(values), unit)


# ---- validation and peers


def validation_rows() -> Iterator[Row]:
    """Rows of the comparisons with outside references that take seconds."""
    from glintrack.devices import wire_grid
    from validation import rayleigh

    largest = max(rayleigh.largest_differences())
    yield Row("validation", "Rayleigh tables (Natraj 2009)", "", "largest difference", largest)
    for name in ("grid_a", "grid_b"):
        table = wire_grid.load(name).sel(wavelength=[0.5, 1.0, 1.5], method="nearest")
        for key in ("pass_transmittance", "extinction_ratio"):
            for um, value in zip(table["wavelength"].values, table[key].values, strict=True):
                yield Row("validation", f"wire-grid table {name}", f"{um:g} µm", key, float(value))
    try:
        from validation import wire_grid as against_rcwa
    except ImportError:  # no ngsolve
        return
    for name, um in against_rcwa.GRIDS:
        ours, peer = zip(
            *(against_rcwa.transmittances(name, um, way) for way in against_rcwa.WAYS), strict=True
        )
        worst = float(np.abs(np.subtract(ours, peer)).max())
        yield Row("validation", f"{name} against RCWA", f"{um:g} µm", "largest difference of T", worst)


def tracking_rows(quick: bool) -> Iterator[Row]:
    """Rows of trackers on the same given detections."""
    from benchmarks import tracking

    epochs = tracking.traffic(30 if quick else 120)
    measured = tracking.measure(epochs, 1)
    trackers = {"glintrack": tracking.ours(tracking.DETECTIONS_DESIGN), "SORT-style": tracking.baseline()}
    try:
        trackers["Stone Soup GNN"] = tracking.stone_soup(False)
    except ImportError:
        print("Stone Soup is not installed", file=sys.stderr)
    for name, tracker in trackers.items():
        found = tracking.row(name, epochs, measured, tracker)
        for quantity in ("completeness", "purity", "false_per_frame", "identity_switches"):
            yield Row("given detections", name, "", quantity, float(found[quantity]))


def peer_rows(files: Sequence[Path]) -> Iterator[Row]:
    """Rows with a ratio, from the JSON of benchmarks."""
    for path in files:
        for row in json.loads(path.read_text(encoding="utf-8"))["rows"]:
            if row["name"] == "frame_total":
                yield Row("time", path.stem, "", row["name"], float(row["value"]), unit=row["unit"])
            if row.get("ratio") is not None:
                yield Row(
                    "peers", str(row["peer"]), "", f"{row['name']}: time over ours", float(row["ratio"])
                )


# ---- size of the code


def count_lines(files: Sequence[Path]) -> int:
    """Lines of some files."""
    return sum(path.read_bytes().count(b"\n") for path in files)


def count_words(files: Sequence[Path]) -> int:
    """Words outside code blocks; lines of tables are none."""
    texts = (re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL) for path in files)
    return sum(len(re.findall(r"\S*\w\S*", text)) for text in texts)


def count_keys(schema: dict) -> int:
    """Leaves of a JSON schema of nested tables, tables in lists counted once."""
    tables, seen = schema.get("$defs", {}), set()

    def leaves(node: dict) -> int:
        references = re.findall(
            r'"#/\$defs/(\w+)"', json.dumps({k: v for k, v in node.items() if k != "$defs"})
        )
        if "properties" in node:
            return sum(leaves(value) for value in node["properties"].values())
        inner = [name for name in dict.fromkeys(references) if "properties" in tables[name]]
        fresh = [name for name in inner if name not in seen]
        seen.update(fresh)
        return sum(leaves(tables[name]) for name in fresh) if inner else 1

    return leaves(schema)


def count_long_signatures(files: Sequence[Path]) -> int:
    """Functions with too many parameters, without compiled ones and commands."""
    count = 0
    for path in files:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                named = " ".join(ast.unparse(one) for one in node.decorator_list)
                given = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
                exempt = re.search(r"jit|command|callback|intrinsic|overload", named)
                count += len(given) > MAX_PARAMETERS and not exempt
    return count


def code_rows(root: Path) -> Iterator[Row]:
    """Rows of the size of a checkout: source, entries, keys, programs, tests and words."""
    source = root / "src" / "glintrack"
    modules = sorted(source.rglob("*.py"))
    programs = [
        p for name in ("benchmarks", "validation", "tools", "scripts") for p in (root / name).glob("*.py")
    ]
    listed = subprocess.run(
        ["git", "ls-files", "docs/*.md"], cwd=root, capture_output=True, text=True, check=True
    )
    pages = [root / name for name in listed.stdout.split()]
    environment = {**os.environ, "PYTHONPATH": str(root / "src")}
    asked = subprocess.run(
        [sys.executable, "-c", COUNT_KEYS], env=environment, capture_output=True, text=True, check=True
    )
    entries = {p for p in source.iterdir() if not p.name.startswith((".", "__pycache__", "py.typed"))}
    counts = {
        "source lines": count_lines(modules), "modules": len(modules), "top entries": len(entries),
        "case keys": count_keys(json.loads(asked.stdout)), "program files": len(programs),
        "program lines": count_lines(programs),
        "test lines": count_lines(sorted((root / "tests").rglob("*.py"))),
        f"functions above {MAX_PARAMETERS} parameters": count_long_signatures(modules),
        "words of README": count_words([root / "README.md"]), "words of docs": count_words(pages),
    }  # fmt: skip
    for quantity, value in counts.items():
        yield Row("code", "", "", quantity, float(value))


# ---- tables


def number(value: float) -> str:
    """Three significant digits, or a whole number with thousands separators; empty for NaN."""
    if math.isnan(value):
        return ""
    if abs(value) >= 1000 or (value == int(value) and abs(value) >= 10):
        return f"{value:,.0f}"
    return f"{value:.1e}" if 0 < abs(value) < 1e-3 else f"{value:.3g}"


def markdown(rows: Sequence[Row], before: dict[tuple, float]) -> str:
    """One table; the column of the other commit stands where there is one."""
    heads = ["Part", "Case or reference", "Channel", "Quantity", "Value", "95 % interval", "Unit"]
    heads[4:4] = ["Before"] if before else []
    lines = ["| " + " | ".join(heads) + " |", "|" + " --- |" * len(heads)]
    for row in rows:
        interval = "" if math.isnan(row.low) else f"{number(row.low)} to {number(row.high)}"
        cells = [*row.key, number(row.value), interval, row.unit]
        cells[4:4] = [number(before.get(row.key, math.nan))] if before else []
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write the rows."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Row)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(map(asdict, rows))


def read_values(path: Path) -> dict[tuple, float]:
    """Value of each row of a CSV."""
    with path.open(newline="", encoding="utf-8") as file:
        names = ("part", "case", "channel", "quantity")
        return {tuple(row[name] for name in names): float(row["value"]) for row in csv.DictReader(file)}


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    at_hand = ROOT.parent / "shared" / "situations"
    parts = ("code", "validation", "given", "peers", "tracks")
    parser.add_argument("--quick", action="store_true", help="one seed and few frames")
    parser.add_argument("--output", type=Path, default=Path("scoreboard.md"), help="Markdown; and CSV")
    parser.add_argument("--situations", type=Path, default=at_hand if at_hand.is_dir() else None)
    parser.add_argument("--benchmarks", type=Path, nargs="*", default=[], metavar="FILE.json")
    parser.add_argument("--before", type=Path, metavar="FILE.csv", help="rows of another commit")
    parser.add_argument("--root", type=Path, default=ROOT, help="checkout to count code in")
    parser.add_argument(
        "--only", nargs="+", choices=parts, default=parts, metavar="PART", help=", ".join(parts)
    )
    given = parser.parse_args()
    seeds, frames = (SEEDS[:1], QUICK_FRAMES) if given.quick else (SEEDS, None)
    makers: dict[str, Callable[[], Iterator[Row]]] = {
        "code": lambda: code_rows(given.root),
        "validation": validation_rows,
        "given": lambda: tracking_rows(given.quick),
        "peers": lambda: peer_rows(given.benchmarks),
        "tracks": lambda: track_rows(cases_by_name(given.situations), seeds, frames),
    }
    before = read_values(given.before) if given.before else {}
    rows: list[Row] = []
    for part in given.only:
        for row in makers[part]():
            rows.append(row)
            given.output.write_text(markdown(rows, before), encoding="utf-8")
            write_csv(given.output.with_suffix(".csv"), rows)
    print(markdown(rows, before))


if __name__ == "__main__":
    main()
