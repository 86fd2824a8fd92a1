"""The paper's claims: pan and DoLP, toward and away from the sun, with and without trees and spectra.

``python scripts/compare_channels.py OUT.csv [--frames 120] [--rate 2] [--seeds 0 1 2] [--oversampling 2]``

Every row is one tracker over one flight of the default city at 50° off nadir: completeness, purity, false
tracks a frame, identity switches. The trackers of a flight share its light; a seed is a city, its paints, the
time of its traffic and its noise. Rows are written when their flight ends; those already in the file are
kept and not flown again, so that the command can be interrupted and repeated. What is expected of the rows is
written in docs/tracking.md; ``--summary`` prints means and differences with their 95 % intervals over seeds.
"""

import argparse
import csv
import itertools
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import scipy.stats

from glintrack.config import Case, find_case
from glintrack.designs import validated
from glintrack.io.toml import read_toml
from glintrack.simulate import simulate
from glintrack.track import TrackDesign

FLIGHT = ("sun", "trees", "rate_hz", "frames", "rays", "seed")
TRACKER = ("channel", "boost", "spectra")
SCORES = (
    "completeness",
    "completeness_visible",
    "purity",
    "false_per_epoch",
    "custody",
    "identity_switches",
    "tracks_per_epoch",
    "vehicles_per_epoch",
    "position_rms_m",
)
SHOWN = ("completeness", "completeness_visible", "purity", "false_per_epoch", "identity_switches")
AZIMUTHS_DEG = {"toward": 0.0, "away": 180.0}
SLANT_RANGE_M = 3000.0  # Table 1: constant over off-nadir angles
DECLINATION_DEG = 50.0
START_S = (0.0, 30.0, 60.0)  # of the traffic, by seed
UNLIMITED = 10_000
TRACKERS = (
    *itertools.product(("pan", "dolp", "all"), ("1",), ("none",)),
    *itertools.product(("pan",), ("1",), ("predicted", "random", "entropy", "unlimited")),
    ("dolp", "1", "entropy"),
    ("dolp", "5", "none"),
)
# what the expectations are about: name, the tracker or flight looked at, and what it is held against
COMPARISONS = (
    ("DoLP − pan", {"channel": "dolp"}, {"channel": "pan"}, ("sun", "trees")),
    ("boost 5 − 1", {"channel": "dolp", "boost": "5"}, {"channel": "dolp"}, ("sun", "trees")),
    ("trees − none", {"trees": "yes"}, {"trees": "no"}, ("sun", "channel")),
    ("spectra − none", {"spectra": "entropy"}, {}, ("trees", "channel")),
    ("spectra of predictions − none", {"spectra": "predicted"}, {}, ("trees", "channel")),
    ("entropy − random", {"spectra": "entropy"}, {"spectra": "random"}, ("trees", "channel")),
    ("unlimited − 20 spectra", {"spectra": "unlimited"}, {"spectra": "entropy"}, ("trees", "channel")),
    ("all − pan", {"channel": "all"}, {"channel": "pan"}, ("sun", "trees")),
)
PLAIN = {"boost": "1", "spectra": "none"}

Row = dict[str, str]


def case_of(args: argparse.Namespace, key: Mapping[str, str]) -> Case:
    """The packaged case with what the flight changes."""
    table, seed = read_toml(find_case(args.case), "case"), int(key["seed"])
    table["name"], table["seed"], table["channels"] = "claims", seed, ["pan", "dolp"]
    flight = table.setdefault("flight", {})
    flight["off_nadir_deg"] = DECLINATION_DEG
    flight["altitude_m"] = SLANT_RANGE_M * float(np.cos(np.deg2rad(DECLINATION_DEG)))
    flight["frames"], flight["rate_hz"] = args.frames, args.rate
    flight["start_s"] = START_S[seed % len(START_S)]
    # the aircraft flies on while it stares: the line of sight passes the azimuth half way through
    ground_m = SLANT_RANGE_M * float(np.sin(np.deg2rad(DECLINATION_DEG)))
    turned_deg = np.rad2deg(flight.get("speed_m_s", 50.0) * args.frames / args.rate / ground_m)
    flight["azimuth_from_sun_deg"] = AZIMUTHS_DEG[key["sun"]] - 0.5 * turned_deg
    table["scene"] = {**table.get("scene", {}), "trees": key["trees"] == "yes", "seed": seed}
    sensor = {"oversampling": args.oversampling, "demosaic": args.demosaic}
    table["sensor"] = {**table.get("sensor", {}), **sensor}
    return validated(Case, table)


def design_of(base: TrackDesign, channel: str, boost: str, spectra: str) -> TrackDesign:
    """The case's tracker with what the row changes: spectra are of detections, but for ``predicted``."""
    changes = {"detect.channel": channel, "detect.dolp_boost": float(boost), "query.at": "detection"}
    changes["query.policy"] = spectra if spectra in ("none", "random") else "entropy"
    if spectra == "unlimited":
        changes["query.budget"] = UNLIMITED
    if spectra == "predicted":
        changes["query.at"] = "prediction"
    return base.replace(changes)


def fly(case: Case, key: Row, missing: list[tuple[str, ...]]) -> list[Row]:
    """One row a tracker."""
    trackers = {" ".join(one): design_of(case.track, *one) for one in missing}
    progress = lambda epoch: print(  # noqa: E731
        f"\r{epoch.index + 1}/{case.flight.frames} ", end="", file=sys.stderr, flush=True
    )
    tree = simulate(case, callback=progress, trackers=trackers)
    if int(tree.attrs["interrupted"]):
        raise KeyboardInterrupt
    return [
        {**key, **dict(zip(TRACKER, one, strict=True))}
        | {score: f"{float(tree[' '.join(one)].attrs[score]):.6g}" for score in SCORES}
        for one in missing
    ]


def interval(values: list[float]) -> str:
    """Mean and the half width of its 95 % interval (Student's t) over seeds."""
    found = np.array(values)
    if len(found) < 2:
        return f"{found.mean():.3g}" if len(found) else "–"
    half = scipy.stats.t.ppf(0.975, len(found) - 1) * found.std(ddof=1) / np.sqrt(len(found))
    return f"{found.mean():.3g} ± {half:.2g}"


def print_table(named: tuple[str, ...], lines: list[tuple[str, ...]]) -> None:
    """In Markdown."""
    print("| " + " | ".join(named) + " |\n|" + " --- |" * len(named))
    for line in lines:
        print("| " + " | ".join(line) + " |")


def summarize(path: Path) -> None:
    """Mean of each design over the seeds, then differences, each seed against itself."""
    rows, named = read(path), ("sun", "trees", *TRACKER)
    design = lambda row: tuple(row[k] for k in named)  # noqa: E731
    for rate in sorted({row["rate_hz"] for row in rows}, key=float):
        mine = [row for row in rows if row["rate_hz"] == rate]
        lines = []
        for one, group in itertools.groupby(sorted(mine, key=design), design):
            values = list(group)
            cells = [interval([float(row[score]) for row in values]) for score in SHOWN]
            lines.append((*one, str(len(values)), *cells))
        frames = ", ".join(sorted({f"{row['frames']} frames, {row['rays']} rays a side" for row in mine}))
        print(f"\n{rate} Hz, {frames}\n")
        print_table((*named, "seeds", *SHOWN), lines)
        print()
        print_table(("difference", "where", "seeds", *SHOWN), list(differences(mine)))


def differences(rows: list[Row]) -> Iterator[tuple[str, ...]]:
    """Lines of the second table: what is not named is averaged before seeds are compared."""
    for name, one, other, by in COMPARISONS:
        places = sorted(
            {tuple(row[k] for k in by) for row in rows if {**PLAIN, **one}.items() <= row.items()}
        )
        for place in places:
            where = {k: v for k, v in zip(by, place, strict=True) if k not in one}
            mine, theirs = ({**PLAIN, **where, **side} for side in (one, other))
            seeds = sorted({row["seed"] for row in rows})
            cells: dict[str, list[float]] = {score: [] for score in SHOWN}
            for seed in seeds:
                a, b = (
                    [row for row in rows if row["seed"] == seed and side.items() <= row.items()]
                    for side in (mine, theirs)
                )
                if not a or not b:
                    continue
                for score in SHOWN:
                    cells[score].append(
                        float(np.mean([float(row[score]) for row in a]))
                        - float(np.mean([float(row[score]) for row in b]))
                    )
            if cells[SHOWN[0]]:
                told = ", ".join(f"{k} {v}" for k, v in where.items())
                yield (name, told, str(len(cells[SHOWN[0]])), *(interval(cells[score]) for score in SHOWN))


def read(path: Path) -> list[Row]:
    """Rows of earlier flights."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def main() -> None:
    """Fly what is missing and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="CSV file, kept and added to")
    parser.add_argument("--case", default="quickstart", help="packaged case or file that the rest comes from")
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--rate", type=float, default=2.0, help="[Hz]")
    parser.add_argument("--oversampling", type=int, default=2, help="rays along each side of an element")
    parser.add_argument("--demosaic", default="bilinear", help="sensor.demosaic; one file for each")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--sun", nargs="+", choices=sorted(AZIMUTHS_DEG), default=["toward", "away"])
    parser.add_argument("--trees", nargs="+", choices=("yes", "no"), default=["yes", "no"])
    parser.add_argument(
        "--trackers", nargs="+", choices=[" ".join(one) for one in TRACKERS], help="not all of them"
    )
    parser.add_argument("--summary", action="store_true", help="only print the tables of what is there")
    args = parser.parse_args()
    done = {tuple(row[k] for k in (*FLIGHT, *TRACKER)) for row in read(args.out)}
    wanted = [one for one in TRACKERS if not args.trackers or " ".join(one) in args.trackers]
    flights = [] if args.summary else itertools.product(args.seeds, args.trees, args.sun)
    for seed, trees, sun in flights:
        values = (sun, trees, f"{args.rate:g}", str(args.frames), str(args.oversampling), str(seed))
        key = dict(zip(FLIGHT, values, strict=True))
        missing = [one for one in wanted if (*values, *one) not in done]
        if not missing:
            continue
        print("\n" + ", ".join(f"{k} {v}" for k, v in key.items()), file=sys.stderr, flush=True)
        rows = fly(case_of(args, key), key, missing)
        fresh = not args.out.exists()
        with args.out.open("a", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, [*FLIGHT, *TRACKER, *SCORES])
            if fresh:
                writer.writeheader()
            writer.writerows(rows)
    summarize(args.out)


if __name__ == "__main__":
    main()
