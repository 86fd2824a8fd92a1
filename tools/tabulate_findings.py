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

# each row of Table 1 by its axis and level; None: the level's own words
TABLE1 = {
    ("clock", "10 Hz"): None,
    ("atmosphere.local_time_h", "12"): "12 h",
    ("atmosphere.local_time_h", "17"): "17 h",
    ("scene.trees", "0.5"): "half the trees",
    ("scene.trees", "0.0"): "no trees",
    ("atmosphere.aerosol", "urban"): "urban haze",
    **{("flight.azimuth_from_sun_deg", str(a)): f"{a}° from the sun's azimuth" for a in range(45, 360, 45)},
    ("angle", "20°"): "20° off nadir",
    ("angle", "3°, a small slow orbit"): "3° off nadir, a small slow orbit",
    ("pitch", "10.8 µm"): "10.8 µm, the same field",
    ("pitch", "8.5 µm"): "8.5 µm, the same field",
    ("pitch", "8.5 µm, as many elements"): None,
    ("ortho.gsd_m", "0.75"): "rectified in 0.75 m",
    ("sensor.oversampling", "1"): "one ray per element",
    ("sensor.spectrometer_bandwidth_um", "0.1"): "bands of 0.1 µm",
    ("region", "0.4 to 2.5 µm"): "to 2.5 µm",
    ("platform", "navigation noise"): "a POS AV 510's noise",
    ("platform", "aircraft jitter"): None,
    ("sensor.polarizer", "grid_a"): "grid A",
    ("sensor.polarizer", "grid_b_physical"): "grid B in aluminium",
    ("sensor.polarizer", "ideal"): "ideal polarizers",
    ("elements", "depolarized"): "light behind a depolarizer",
    ("elements", "all pan"): "all elements pan",
    ("elements", "adaptive, demosaicked as it lies"): "superpixel demosaicking, for rectified frames",
    ("spectra", "at detection, of whoever"): "spectra of random vehicles",
    ("spectra", "at prediction"): "spectra of predictions",
    ("spectra", "none"): "no spectra",
    ("detector", "background"): "`background`",
    ("detector", "background, DoLP × 5"): "`background`, DoLP × 5",
    ("track.association.method", "mht"): "`mht`",
}

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


def table1() -> Iterator[str]:
    """Table 1: what each row changes of the standard case."""
    yield "| instead of the standard case | pan | DoLP | all elements | of visible, all elements |"
    yield "|" + " --- |" * 5
    found = table1_rows()
    for (axis, level), words in TABLE1.items():
        held = [found.get((channel, "tracked_per_km2", axis, level)) for channel in CHANNELS]
        seen = found.get(("all", "completeness_visible", axis, level))
        cells = [_effect(row, 1) for row in held] + [_effect(seen, 3)]
        if seen is None:  # all elements are pan
            cells[-1] = _effect(found["pan", "completeness_visible", axis, level], 3) + " (pan)"
        yield f"| {' | '.join([words or level, *cells])} |"


def loss_budget() -> Iterator[str]:
    """Table 1 by the loss budget's stages, in all elements: the sensor's limit, and what is made of it."""
    stages = {
        "stage_known_background": "background known",
        "stage_predicted_background": "predicted from past frames",
        "stage_detector": "detector in use",
        "completeness": "tracker",
        "custody": "custody",
    }
    yield f"| instead of the standard case | {' | '.join(stages.values())} |"
    yield "|" + " --- |" * (len(stages) + 1)
    found = table1_rows()
    for (axis, level), words in TABLE1.items():
        channel = "all" if ("all", "completeness", axis, level) in found else "pan"
        cells = [_bare_effect(found[channel, stage, axis, level]) for stage in stages]
        yield f"| {' | '.join([words or level, *cells])} |"


def standard() -> Iterator[str]:
    """Tabulate the scores of each channel in the standard case."""
    columns = {"tracked_per_km2": 1, "completeness_visible": 3, "custody": 3, "purity": 3, "false_per_km2": 1}
    yield "| | tracked per km² | of visible | custody | purity | false tracks per km² |"
    yield "|" + " --- |" * 6
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


TABLES = {"table1": table1, "loss_budget": loss_budget, "standard": standard}


def written(text: str) -> str:
    """Text of the page with new tables."""
    for name, lines in TABLES.items():
        begin, end = f"<!-- {name}: written by python tools/tabulate_findings.py -->\n", "\n<!-- end -->"
        before, rest = text.split(begin)
        text = before + begin + "\n".join(lines()) + end + rest.split(end, 1)[1]
    return text


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
        print("a table of docs/findings.md is not that of its rows: python tools/tabulate_findings.py")
    return int(bool(lost or wrong) or (check and new != text))


def _rounds_to(figure: str, value: float) -> bool:
    decimals = len(figure.partition(".")[2])
    return abs(float(figure.replace("−", "-")) - value) <= 0.5 * 10**-decimals + 1e-12


def _format_signed(value: float, digits: int) -> str:
    return f"{value:+.{digits}f}".replace("-", "−")


def _effect(row: Row | None, digits: int) -> str:
    if row is None:
        return ""
    if not row["low"]:  # the same in each flight
        return "0"
    low, high = (_format_signed(float(row[name]), digits) for name in ("low", "high"))
    return f"{_format_signed(float(row['effect']), digits)} ({low} … {high}){_star(row)}"


def _bare_effect(row: Row) -> str:
    effect = round(float(row["effect"]), 3)
    return (_format_signed(effect, 3) if effect else "0") + _star(row)


def _star(row: Row) -> str:
    return " *" if row["p_max_t"] and float(row["p_max_t"]) < CHANCE else ""


def _interval(row: Row, name: str, digits: int) -> str:
    value, low, high = (f"{float(row[key]):.{digits}f}" for key in (name, "low", "high"))
    return f"{value} ({low} … {high})"


if __name__ == "__main__":
    sys.exit(main())
