"""Write the tables of docs/findings.md from the rows in docs/findings, and check its sentences against them.

    python tools/tabulate_findings.py          # writes the tables
    python tools/tabulate_findings.py --check  # says what differs, and ends with 1

The rows are those of the report of a study, `study-NAME/report/*.csv`. A figure with its interval,
"+1.2 (0.3 … 2.1)", must be one of theirs, of either sign and rounded as it is written. A design of Table 1
that is better in every respect must not be reported worse beyond chance.
"""

import argparse
import csv
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE, ROWS = ROOT / "docs" / "findings.md", ROOT / "docs" / "findings"
Row = dict[str, str]
CHANNELS = {"pan": "pan", "dolp": "DoLP", "all": "all elements"}
# medians of moving vehicles: their travel in 1 s over the distance to the next vehicle ahead in their lane
TRAVEL_OVER_DISTANCE = {"motorway": 0.75, "arterial": 0.55, "junction": 0.36, "city": 0.28, "suburb": 0.24}
CHANCE = 0.05  # a star marks rows whose |t| chance alone exceeds in fewer studies
ESTIMATES = (  # columns of an estimate and of its interval
    ("effect", "low", "high"),
    ("score", "low", "high"),
    ("tau", "low", "high"),
    ("coverage", "coverage_low", "coverage_high"),
)
INTERVAL = re.compile(r"([+−]?\d+\.?\d*) \(([+−]?\d+\.?\d*) … ([+−]?\d+\.?\d*)\)")

# levels of Table 1 that are better (1) or worse (−1) than the standard case in every respect
KNOWN_BETTER = {
    ("clock", "10 Hz"): 1,
    ("scene.trees", "0.5"): 1,
    ("scene.trees", "0.0"): 1,
    ("platform", "navigation noise"): -1,
    ("platform", "aircraft jitter"): -1,
    ("sensor.polarizer", "grid_b_physical"): -1,
    ("sensor.polarizer", "ideal"): 1,
}


def rows_of(name: str) -> list[Row]:
    """Rows of one table in docs/findings."""
    with (ROWS / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def points_of(study: str) -> dict[tuple[str, str, str], Row]:
    """Scores of a study's designs by point, channel and response."""
    return {(row["point"], row["channel"], row["response"]): row for row in rows_of(f"{study}_points")}


def standard() -> Iterator[str]:
    """Tabulate the scores of each channel in the standard case."""
    columns = {"tracked_per_km2": 1, "completeness_visible": 3, "custody": 3, "same_track_after_stop": 2}
    columns |= {"purity": 3, "false_per_km2": 1}
    yield "| | tracked per km² | of visible | custody | same id after a stop | purity | false per km² |"
    yield "|" + " --- |" * 7
    found = points_of("standard")
    sensors = [(name, "adaptive", channel) for channel, name in CHANNELS.items()]
    for name, point, channel in (*sensors, ("all elements pan", "all pan", "pan")):
        cells = [_interval(found[point, channel, key], "score", digits) for key, digits in columns.items()]
        yield f"| {name} | {' | '.join(cells)} |"


def traffic() -> Iterator[str]:
    """Tabulate kinds of traffic, each cell at 1, 2, 5 and 10 Hz."""
    yield "| traffic | travel in 1 s over distance ahead | of visible | custody | false per km² |"
    yield "|" + " --- |" * 5
    found = points_of("traffic")
    for kind, share in TRAVEL_OVER_DISTANCE.items():
        level = "" if kind == "motorway" else f"traffic = {kind}"
        rates = "", *(f"rate = {rate} Hz" for rate in (2, 5, 10))
        points = [", ".join(filter(None, (level, rate))) or "base" for rate in rates]
        cells = [
            " / ".join(f"{float(found[point, 'all', key]['score']):.{digits}f}" for point in points)
            for key, digits in {"completeness_visible": 2, "custody": 2, "false_per_km2": 0}.items()
        ]
        yield f"| {kind} | {share:.2f} | {' | '.join(cells)} |"


def figures() -> Iterator[tuple[float, float, float]]:
    """All estimates with their intervals, of all tables."""
    for file in sorted(ROWS.glob("*.csv")):
        for row in rows_of(file.stem):
            for names in ESTIMATES:
                if all(row.get(name) for name in names):
                    value, low, high = (float(row[name]) for name in names)
                    yield value, low, high


def strays(text: str, known: list[tuple[float, float, float]]) -> list[str]:
    """Figures with intervals in a text that are in no table."""
    known = [*known, *((-value, -high, -low) for value, low, high in known)]
    return [
        found.group()
        for found in INTERVAL.finditer(text)
        if not any(all(map(_rounds_to, found.groups(), row)) for row in known)
    ]


def known_rows() -> list[tuple[Row, int]]:
    """Effects of Table 1 with a sign that is known beforehand, and that sign."""
    scores = "tracked_per_km2", "completeness_visible", "custody"
    rows = [row for row in rows_of("table1_effects") if row["response"] in scores]
    levels = [(row["axis"], row["level"].split(" against ")[0]) for row in rows]
    return [(r, KNOWN_BETTER[level]) for r, level in zip(rows, levels, strict=True) if level in KNOWN_BETTER]


def contradicts(row: Row, sign: int) -> bool:
    """Return True if a row is significant with the opposite sign."""
    beyond_chance = row["p_max_t"] and float(row["p_max_t"]) < CHANCE
    return bool(beyond_chance) and sign * float(row["effect"]) < 0


def written(text: str) -> str:
    """Text of the page with new tables."""
    for table in (standard, traffic):
        begin = f"<!-- {table.__name__}: written by python tools/tabulate_findings.py -->\n"
        before, rest = text.split(begin)
        text = before + begin + "\n".join(table()) + "\n<!-- end -->" + rest.split("\n<!-- end -->", 1)[1]
    return text


def main() -> int:
    """Write, or check."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="write nothing; end with 1 if anything differs")
    check = parser.parse_args().check
    text = PAGE.read_text(encoding="utf-8")
    lost = strays(new := written(text), list(figures()))
    for figure in lost:
        print(f"{figure} is in none of docs/findings/*.csv")
    wrong = [row for row, sign in known_rows() if contradicts(row, sign)]
    for row in wrong:
        print(f"{row['level']} in {row['channel']} has {row['response']} {row['effect']}: the wrong sign")
    if not check:
        PAGE.write_text(new, encoding="utf-8")
    elif new != text:
        print("the tables of docs/findings.md are not those of its rows: python tools/tabulate_findings.py")
    return int(bool(lost or wrong) or (check and new != text))


def _rounds_to(figure: str, value: float) -> bool:
    decimals = len(figure.partition(".")[2])
    return abs(float(figure.replace("−", "-")) - value) <= 0.5 * 10**-decimals + 1e-12


def _interval(row: Row, name: str, digits: int) -> str:
    value, low, high = (f"{float(row[key]):.{digits}f}" for key in (name, "low", "high"))
    return f"{value} ({low} … {high})"


if __name__ == "__main__":
    sys.exit(main())
