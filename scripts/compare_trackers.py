"""Association and motion on frames: every tracker follows the same flight, each its own change.

``python scripts/compare_trackers.py OUT.csv [--frames 60] [--oversampling 1] [--products pan dolp]``

Flies a case once, without spectra, and scores the three associations with one mode of motion and with
interacting ones. The table is printed in Markdown and written as CSV.
"""

import argparse
import csv
import itertools
import sys
from pathlib import Path

from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.core.designs import validated
from glintrack.io.toml import read_toml
from glintrack.loop import simulate
from glintrack.track import TrackDesign

MOTIONS = {
    "one mode": {"motion.model": "constant-velocity"},
    "interacting": {"motion.model": "imm", "motion.acceleration_psd_m2_s3": 3.0, "motion.straight_s": 20.0},
}
ASSOCIATIONS = ("gnn", "jpda", "mht")
NAMES = ("product", "association", "motion")
SCORES = ("completeness", "completeness_visible", "purity", "false_per_epoch", "identity_switches")


def designs(base: TrackDesign, products: list[str]) -> dict[tuple[str, str, str], TrackDesign]:
    """The case's tracker with what each row changes."""
    return {
        (product, association, motion): base.replace(
            {
                "detect.channel": product,
                "association.method": association,
                "query.policy": "none",
                **MOTIONS[motion],
            }
        )
        for product, association, motion in itertools.product(products, ASSOCIATIONS, MOTIONS)
    }


def fly(case: Case, products: list[str]) -> list[dict[str, str]]:
    """Scores of every tracker, one row each."""
    wanted = designs(case.track, products)
    progress = lambda epoch: print(  # noqa: E731
        f"\r{epoch.index + 1}/{case.flight.frames} ", end="", file=sys.stderr, flush=True
    )
    tree = simulate(case, callback=progress, trackers={", ".join(key): one for key, one in wanted.items()})
    if int(tree.attrs["interrupted"]):
        raise KeyboardInterrupt
    return [
        dict(zip(NAMES, key, strict=True))
        | {score: f"{float(tree[', '.join(key)].attrs[score]):.4g}" for score in SCORES}
        for key in wanted
    ]


def main() -> None:
    """Fly, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="CSV file")
    parser.add_argument("--case", default="quickstart", help="packaged case or file")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--oversampling", type=int, default=1, help="rays along each side of an element")
    parser.add_argument("--products", nargs="+", choices=("pan", "dolp", "all"), default=["pan", "dolp"])
    args = parser.parse_args()
    table = read_toml(find_case(args.case), "case")
    table["channels"] = ["pan", "dolp"]
    table.setdefault("flight", {})["frames"] = args.frames
    table.setdefault("sensor", {})["oversampling"] = args.oversampling
    rows = fly(validated(Case, table), args.products)
    with args.out.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [*NAMES, *SCORES])
        writer.writeheader()
        writer.writerows(rows)
    print("| " + " | ".join((*NAMES, *SCORES)) + " |\n|" + " --- |" * (len(NAMES) + len(SCORES)))
    for row in rows:
        print("| " + " | ".join(row.values()) + " |")
    print(f"wrote {args.out}", file=sys.stderr)


if __name__ == "__main__":
    main()
