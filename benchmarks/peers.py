"""glintrack beside its peers in one table: times, their ratios, and what each peer does not do.

``python benchmarks/peers.py [--quick] [--only PART …] [--json FILE]``. The rows are those of `render.py`,
`tracking.py`, `tracker.py` and `ortho.py`, where each comparison says what both sides get. Ours and the peer
take turns in one run, each part in a process of its own; ratios are the peer's time over ours. ``clock`` is
the wall's or the processor's, of all threads, which other work on the machine stretches less. A peer that is
not installed has a row that says so (``pip install -c constraints.txt '.[oracles,opencv]'``).
"""

import argparse
import json
import multiprocessing
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import tracker
import tracking

import ortho
import render
from glintrack.track.files import DETECTIONS_DESIGN

LACKS = {
    "Mitsuba 3": "renders one band at a time, with noise; here its sky is even and its leaves have no holes",
    "Stone Soup": "GNN and JPDA have one mode of motion and one scan here; no spectra asked for or used",
    "SORT-style": "no gate by covariance, no window of scans; ends a track at the second miss; no spectra",
    "NumPy and SciPy": "dense tables: 20,000 targets would take 10 GB; no tracks begin or end",
    "orthority": "no Stokes vectors, which turn as they are laid on the ground; a file for each result",
    "OpenCV remap": "places and heights of all cells must be ready; one band after the other",
    "OpenCV MOG2": "says what is foreground alone: no centres, no covariances; learns what is tracked too",
}
PAN, ALL_CHANNELS = 1, 4  # bands that are rectified


@dataclass(frozen=True)
class Beside:
    """One line of the table; without a ratio, ``note`` says why."""

    what: str
    peer: str
    ours_ms: float | None
    ratio: float | None
    clock: str
    note: str = ""


def absent(what: str, peer: str, why: str = "not installed") -> Beside:
    """A line for a peer that cannot be asked."""
    return Beside(what, peer, None, None, "", why)


def mitsuba(quick: bool) -> list[Beside]:
    """The cube of 61 bands, at equal samples and at equal noise."""
    named = {
        "cube_61_vs_mitsuba_direct": "cube of 61 bands, equal samples, vehicles as instances",
        "cube_61_vs_mitsuba_baked": "the same, all as triangles",
        "cube_61_equal_noise": "the same, equal noise",
    }
    one, lines = render.build_set(), []
    for row in render.peer_rows(one, one.observer.tracer, quick):
        if row["name"] in named:
            what = named[row["name"]]
            note = row["peer"].partition(", all as triangles, ")[2] if "noise" in what else ""
            if row["ratio"] is None:
                lines.append(absent(what, "Mitsuba 3", row["peer"].rpartition(": ")[2]))
            else:
                lines.append(Beside(what, "Mitsuba 3", row["value"], row["ratio"], "wall", note))
    return lines


def trackers(quick: bool) -> list[Beside]:
    """Steps on the same detections of recorded traffic, with the scores of both."""
    epochs = tracking.traffic(30 if quick else 120)
    measured, _ = tracking.measure(epochs, 1)
    gnn = DETECTIONS_DESIGN.replace({"association.method": "gnn"})
    one_mode = gnn.replace({"motion.model": "constant-velocity"})
    jpda = DETECTIONS_DESIGN.replace({"association.method": "jpda"})
    few = 6 if quick else 30
    asked = [
        ("`mht`", DETECTIONS_DESIGN, "SORT-style", "SORT", tracking.sort_style, len(epochs)),
        ("`gnn`", gnn, "SORT-style", "SORT", tracking.sort_style, len(epochs)),
    ]
    if find_spec("stonesoup"):
        soup = tracking.stone_soup(False)
        asked += [
            ("`mht`", DETECTIONS_DESIGN, "Stone Soup", "GNN", soup, 2 * few),
            ("`gnn`", gnn, "Stone Soup", "GNN", soup, 2 * few),
            ("`gnn`, one mode of motion", one_mode, "Stone Soup", "GNN", soup, 2 * few),
            ("`jpda`", jpda, "Stone Soup", "JPDA", tracking.stone_soup(True), few),
        ]
    lines, known = [], {}
    for name, design, peer, method, step, frames in asked:
        some = epochs[:frames], measured[:frames]
        tracking.ours(design)(epochs[:6], measured[:6])  # compiles
        ours = tracking.row(name, *some, tracking.ours(design))
        if (peer, method) not in known:
            known[peer, method] = tracking.row(peer, *some, step)
        theirs = known[peer, method]
        scores = ", ".join(
            f"{key} {ours[key]:.3f} against {theirs[key]:.3f}" for key in ("completeness", "purity")
        )
        scores = f"{frames} frames, {scores}"
        ratio = theirs["value"] / ours["value"]
        lines.append(
            Beside(f"step of {name} beside {method}", peer, ours["value"], ratio, "processor", scores)
        )
    return lines if find_spec("stonesoup") else [*lines, absent("steps of trackers", "Stone Soup")]


def filters(quick: bool) -> list[Beside]:
    """Predict, gate, assign and update, at constant density."""
    return [
        Beside(row["name"], "NumPy and SciPy", row["value"], row["ratio"], "wall")
        for row in tracker.filter_rows(quick, np.random.default_rng(0))
        if row["ratio"]
    ]


def rectification(quick: bool) -> list[Beside]:
    """A frame of 560 × 880 elements and a DEM to an array; and, places ready, OpenCV's remap alone."""
    what = "rectified frame"
    if not ortho.PEER:
        return [absent(what, "orthority"), absent(what, "OpenCV remap")]
    repeats, lines = (5 if quick else 25), []
    for peer, work in (("orthority", ortho.jobs), ("OpenCV remap", ortho.arrays)):
        for bands, method in ((PAN, "bilinear"), (PAN, "cubic"), (ALL_CHANNELS, "bilinear")):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a camera's image has no place on the ground
                row = work(560, 880, bands, method, repeats)
            size = f"{what}, {bands} band{'s' if bands > 1 else ''}, {method}"
            lines.append(Beside(size, peer, row["cpu_ms"], row["cpu_ratio"], "processor"))
    return lines


def change(quick: bool) -> list[Beside]:
    """Change detection of a frame by `background`."""
    lines = [
        Beside(row["name"].replace(" beside OpenCV", ""), "OpenCV MOG2", row["value"], row["ratio"], "wall")
        for row in tracker.frame_rows(quick, np.random.default_rng(0))
        if "OpenCV" in row["name"]
    ]
    return lines or [absent("change detection", "OpenCV MOG2")]


PARTS: dict[str, Callable[[bool], list[Beside]]] = {
    "mitsuba": mitsuba,
    "trackers": trackers,
    "filters": filters,
    "rectification": rectification,
    "change": change,
}


def measured_part(name: str, quick: bool) -> list[Beside]:
    """One part; called in a fresh process."""
    return PARTS[name](quick)


def line_of(row: Beside) -> str:
    """A row of the table."""
    lacks = LACKS[row.peer]
    if row.ratio is None or row.ours_ms is None:
        return f"| {row.what} | {row.peer} | | {row.note} | | {lacks} |"
    ratio = f"{row.ratio:.2g}" if row.ratio < 10 else f"{float(f'{row.ratio:.3g}'):,.0f}".replace(",", " ")
    note = f" ({row.note})" if row.note else ""
    return f"| {row.what}{note} | {row.peer} | {row.ours_ms:.3g} ms | {ratio} × | {row.clock} | {lacks} |"


def main() -> None:
    """Measure, print, perhaps write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="few repeats, few frames")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS), metavar="PART")
    parser.add_argument("--json", type=Path, metavar="FILE")
    given = parser.parse_args()
    rows: list[Beside] = []
    print("| what | peer | ours | peer's time over ours | clock | what the peer does not do |")
    print("| --- " * 6 + "|")
    for name in given.only:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            part = pool.apply(measured_part, (name, given.quick))
        print("\n".join(map(line_of, part)), flush=True)
        rows += part
    if given.json:
        lines = [{**asdict(row), "lacks": LACKS[row.peer]} for row in rows]
        given.json.write_text(json.dumps({"rows": lines}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
