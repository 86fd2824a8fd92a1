"""Write the table of docs/findings.md from the rows in docs/findings, and check its sentences against them.

    python tools/tabulate_findings.py          # writes the table
    python tools/tabulate_findings.py --check  # says what differs, and ends with 1

The rows are those of the report of a study, `study-NAME/report/*.csv`. A figure with its interval,
"+1.2 (0.3 … 2.1)", must be one of theirs, of either sign and rounded as it is written. A design of Table 1
that is better in every respect must not be reported worse beyond chance.
"""

import argparse
import csv
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE, ROWS = ROOT / "docs" / "findings.md", ROOT / "docs" / "findings"
Row = dict[str, str]
CHANNELS = {"pan": "pan", "dolp": "DoLP", "all": "all elements"}
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


def table1_rows() -> dict[tuple[str, str, str, str], Row]:
    """Effects of Table 1 by channel, response, axis and level."""
    return {
        (row["channel"], row["response"], row["axis"], row["level"].split(" against ")[0]): row
        for row in rows_of("table1_effects")
    }


def standard() -> Iterator[str]:
    """Tabulate the scores of each channel in the standard case."""
    columns = {"tracked_per_km2": 1, "completeness_visible": 3, "custody": 3, "same_track_after_stop": 2}
    columns |= {"purity": 3, "false_per_km2": 1}
    yield "| | tracked per km² | of visible | custody | same id after a stop | purity | false per km² |"
    yield "|" + " --- |" * 7
    found = {(row["point"], row["channel"], row["response"]): row for row in rows_of("standard_points")}
    sensors = [(name, "adaptive", channel) for channel, name in CHANNELS.items()]
    for name, point, channel in (*sensors, ("all elements pan", "all pan", "pan")):
        cells = [_interval(found[point, channel, key], "score", digits) for key, digits in columns.items()]
        yield f"| {name} | {' | '.join(cells)} |"


def figures() -> Iterator[tuple[float, float, float]]:
    """All estimates with their intervals, of all tables."""
    for file in sorted(ROWS.glob("*.csv")):
        for row in rows_of(file.stem):
            for names in ESTIMATES:
                if all(row.get(name) for name in names):
                    value, low, high = (float(row[name]) for name in names)
                    yield value, low, high


def strays(text: str, known: Iterable[tuple[float, float, float]]) -> list[str]:
    """Figures with intervals in a text that are in no table."""
    known = list(known)
    known += [(-value, -high, -low) for value, low, high in known]
    return [
        found.group()
        for found in INTERVAL.finditer(text)
        if not any(all(map(_rounds_to, found.groups(), row)) for row in known)
    ]


def known_rows() -> list[tuple[Row, int]]:
    """Effects of Table 1 with a sign that is known beforehand, and that sign."""
    scores = "tracked_per_km2", "completeness_visible", "custody"
    return [
        (row, KNOWN_BETTER[axis, level])
        for (_, score, axis, level), row in table1_rows().items()
        if score in scores and (axis, level) in KNOWN_BETTER
    ]


def contradicts(row: Row, sign: int) -> bool:
    """Return True if a row is significant with the opposite sign."""
    return bool(_star(row)) and sign * float(row["effect"]) < 0


def written(text: str) -> str:
    """Text of the page with a new table."""
    begin, end = "<!-- standard: written by python tools/tabulate_findings.py -->\n", "\n<!-- end -->"
    before, rest = text.split(begin)
    return before + begin + "\n".join(standard()) + end + rest.split(end, 1)[1]


def main() -> int:
    """Write, or check."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--check", action="store_true", help="write nothing; end with 1 where anything differs"
    )
    check = parser.parse_args().check
    text = PAGE.read_text(encoding="utf-8")
    new = written(text)
    lost = strays(new, figures())
    for figure in lost:
        print(f"{figure} is in none of docs/findings/*.csv")
    wrong = [row for row, sign in known_rows() if contradicts(row, sign)]
    for row in wrong:
        print(f"{row['level']} in {row['channel']} has {row['response']} {_effect(row, 3)}: the wrong sign")
    if not check:
        PAGE.write_text(new, encoding="utf-8")
    elif new != text:
        print("the table of docs/findings.md is not that of its rows: python tools/tabulate_findings.py")
    return int(bool(lost or wrong) or (check and new != text))


def _rounds_to(figure: str, value: float) -> bool:
    decimals = len(figure.partition(".")[2])
    return abs(float(figure.replace("−", "-")) - value) <= 0.5 * 10**-decimals + 1e-12


def _format_signed(value: float, digits: int) -> str:
    return f"{value:+.{digits}f}".replace("-", "−")


def _effect(row: Row, digits: int) -> str:
    low, high = (_format_signed(float(row[name]), digits) for name in ("low", "high"))
    return f"{_format_signed(float(row['effect']), digits)} ({low} … {high}){_star(row)}"


def _star(row: Row) -> str:
    return " *" if row["p_max_t"] and float(row["p_max_t"]) < CHANCE else ""


def _interval(row: Row, name: str, digits: int) -> str:
    value, low, high = (f"{float(row[key]):.{digits}f}" for key in (name, "low", "high"))
    return f"{value} ({low} … {high})"


if __name__ == "__main__":
    sys.exit(main())
