"""The paper's claims: pan and DoLP, toward and away from the sun, with and without trees and spectra.

``python scripts/compare_modalities.py OUT.csv [--frames 120] [--rate 2] [--seeds 0 1 2]``

Every row is one flight of the default city at 50° declination: completeness, purity, false tracks a frame,
identity switches. Rows already in the file are kept and not flown again. What is expected of them is written
in docs/tracking.md; ``--summary`` prints mean and range over the seeds.
"""

import argparse
import csv
import itertools
import sys
from pathlib import Path

import numpy as np

from glintrack.config import Case, find_case, read_toml, validated
from glintrack.simulate import simulate

KEYS = ("sun", "trees", "spectra", "boost", "rate_hz", "frames", "seed", "modality")
SCORES = (
    "completeness",
    "completeness_visible",
    "purity",
    "false_per_epoch",
    "stray_per_epoch",
    "identity_switches",
    "tracks_per_epoch",
    "vehicles_per_epoch",
    "position_rms_m",
)
AZIMUTHS_DEG = {"toward": 0.0, "away": 180.0}
SLANT_RANGE_M = 3000.0  # Table 1: constant over declination
DECLINATION_DEG = 50.0


def case_of(args: argparse.Namespace, sun: str, trees: bool, spectra: bool, boost: float, seed: int) -> Case:
    """The packaged case with what the row changes."""
    table = read_toml(find_case(args.case), "case")
    table["name"], table["seed"], table["modalities"] = "claims", seed, args.modalities
    duration_s = args.frames / args.rate
    flight = table.setdefault("flight", {})
    flight["declination_deg"] = DECLINATION_DEG
    flight["altitude_m"] = SLANT_RANGE_M * float(np.cos(np.deg2rad(DECLINATION_DEG)))
    flight["frames"], flight["rate_hz"] = args.frames, args.rate
    # the aircraft flies on while it stares: the line of sight passes the azimuth half way through
    ground_m = SLANT_RANGE_M * float(np.sin(np.deg2rad(DECLINATION_DEG)))
    turned_deg = np.rad2deg(flight.get("speed_m_s", 50.0) * duration_s / ground_m)
    flight["azimuth_from_sun_deg"] = AZIMUTHS_DEG[sun] - 0.5 * turned_deg
    table["scene"] = {**table.get("scene", {}), "trees": trees, "seed": seed}
    track = table.setdefault("track", {})
    track["query_policy"] = "entropy" if spectra else "none"
    track["dolp_boost"] = boost
    return validated(Case, table)


def rows_of(case: Case, key: dict) -> list[dict]:
    """One row a modality."""
    tree = simulate(case)
    if int(tree.attrs["interrupted"]):
        raise KeyboardInterrupt
    return [
        {**key, "modality": name, **{s: float(tree[name].attrs[s]) for s in SCORES}}
        for name in case.modalities
    ]


def summarize(path: Path) -> None:
    """Mean and range over the seeds of each design, in Markdown."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    shown = ("completeness", "completeness_visible", "purity", "false_per_epoch", "identity_switches")
    named = [k for k in KEYS if k != "seed"]
    print("| " + " | ".join((*named, "seeds", *shown)) + " |")
    print("|" + " --- |" * (len(named) + 1 + len(shown)))
    design = lambda row: tuple(row[k] for k in named)  # noqa: E731
    for one, group in itertools.groupby(sorted(rows, key=design), design):
        values = list(group)
        cells = []
        for score in shown:
            found = np.array([float(row[score]) for row in values])
            cells.append(f"{np.nanmean(found):.3f} ({np.nanmin(found):.3f}–{np.nanmax(found):.3f})")
        print("| " + " | ".join((*one, str(len(values)), *cells)) + " |")


def main() -> None:
    """Fly what is missing and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="CSV file, kept and added to")
    parser.add_argument("--case", default="quickstart", help="packaged case or file that the rest comes from")
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--rate", type=float, default=2.0, help="[Hz]")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--modalities", nargs="+", default=["pan", "dolp"])
    parser.add_argument("--boosts", type=float, nargs="+", default=[1.0, 5.0])
    parser.add_argument("--sun", nargs="+", choices=sorted(AZIMUTHS_DEG), default=["toward", "away"])
    parser.add_argument("--summary", action="store_true", help="only print the table of what is there")
    args = parser.parse_args()
    if args.summary:
        return summarize(args.out)
    done = set()
    if args.out.exists():
        with args.out.open(newline="", encoding="utf-8") as file:
            done = {tuple(row[k] for k in KEYS) for row in csv.DictReader(file)}
    designs = itertools.product(args.seeds, args.sun, (True, False), (True, False), args.boosts)
    for seed, sun, trees, spectra, boost in designs:
        names = [m for m in args.modalities if boost == 1.0 or m != "pan"]  # a boost does not change pan
        key = {
            "sun": sun, "trees": "yes" if trees else "no", "spectra": "yes" if spectra else "no",
            "boost": f"{boost:g}", "rate_hz": f"{args.rate:g}", "frames": str(args.frames), "seed": str(seed),
        }  # fmt: skip
        names = [m for m in names if (*key.values(), m) not in done]
        if not names:
            continue
        print(", ".join(f"{k} {v}" for k, v in key.items()), "…", file=sys.stderr, flush=True)
        case = case_of(args, sun, trees, spectra, boost, seed).model_copy(update={"modalities": tuple(names)})
        rows = rows_of(case, key)
        fresh = not args.out.exists()
        with args.out.open("a", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, [*KEYS, *SCORES])
            if fresh:
                writer.writeheader()
            writer.writerows(rows)
    summarize(args.out)


if __name__ == "__main__":
    main()
