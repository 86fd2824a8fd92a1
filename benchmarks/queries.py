"""Whom to ask for a spectrum: query policies under a budget, on recorded traffic, with intervals over seeds.

``python benchmarks/queries.py [--quick] [--tune] [--json FILE]``. Detections are those of tracking.py
(misses, clutter, noise of position) in three cases of stop-and-go traffic: standing vehicles never detected,
as change detection that has learnt them would (``unseen``); detected like the others (``seen``); and poor
detections, two of three, 1 m, 80 false ones a frame (``poor``). A vehicle has one of twelve made-up paints
and a shade of its own; spectra are asked of predictions and taken with the next frame, or of detections and
taken at once (``--at``), one a column of 1.5 m, of the vehicle that the point lies on, else of the road,
which the tracker cannot tell. ``told`` is no policy but
every detection's own spectrum in its own frame. Policies meet the same detections and paints; ``Δ`` is the
difference from `random` at the same budget, seed by seed, with the 95 % interval of its mean (Student's t).
Nothing was chosen on these seeds and frames: ``--tune`` takes others.
"""

import argparse
import itertools
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.stats
from tracking import AREA_M, GRID, Epochs, Reports, score, speed_of, traffic

from glintrack import track
from glintrack.track.detect.detections import order
from glintrack.track.files import DETECTIONS_DESIGN
from glintrack.track.identity import features

POLICIES = ("none", "random", "round-robin", "entropy", "told")
WITHOUT_BUDGET = ("none", "told")  # nothing asked; every detection's own spectrum at once
UNLIMITED = 10_000
PLACES = ("prediction", "detection")
BUDGETS = (5, 20, 80, UNLIMITED)
COLUMN_M = 1.5
LENGTH_M, WIDTH_M = 4.5, 1.8
VEHICLES, NOISE = 1000, 0.1
MISTAKEN, RADIUS_M = track.TrackDesign().identity.outlier_share, track.TrackDesign().identity.radius_m
REPORTED = (20.0, range(5))  # start of the window [s], seeds
TUNED_ON = (85.0, range(100, 105))
SHOWN = ("completeness", "purity", "identity_switches", "false_per_epoch")


@dataclass(frozen=True)
class Detector:
    """What a frame shows of the traffic."""

    detected: float
    standing: float
    sigma_m: float
    clutter: int


CASES = {
    "unseen": Detector(0.85, 0.0, 0.5, 40),
    "seen": Detector(0.85, 0.85, 0.5, 40),
    "poor": Detector(0.67, 0.67, 1.0, 80),
}


@dataclass(frozen=True)
class Paints:
    """What spectra look like: a paint and a shade of each vehicle, and the road."""

    vehicle: np.ndarray
    road: np.ndarray

    def of(self, whose: np.ndarray, rng) -> np.ndarray:
        """Feature of each vehicle by its id, the road's for −1."""
        colour = np.where((whose >= 0)[:, None], self.vehicle[whose], self.road)
        return colour + rng.normal(0, NOISE, colour.shape)

    def seen_at(self, points: np.ndarray, ids: np.ndarray, states: np.ndarray, rng) -> np.ndarray:
        """Feature of the spectrum taken at each point."""
        heading = states[:, 2]
        forward = np.stack([np.sin(heading), np.cos(heading)], axis=1)
        apart = points[:, None] - states[None, :, :2]
        along = np.abs((apart * forward).sum(axis=-1))
        across = np.abs(apart[..., 0] * forward[:, 1] - apart[..., 1] * forward[:, 0])
        on = (along <= LENGTH_M / 2) & (across <= WIDTH_M / 2)
        return self.of(np.where(on.any(axis=1), ids[on.argmax(axis=1)], -1), rng)


def paints(seed: int) -> Paints:
    """Of one seed."""
    rng = np.random.default_rng((seed, 1))
    kinds, own = rng.normal(0, 0.5, (12, 8)), rng.normal(0, NOISE, (VEHICLES, 8))
    return Paints(kinds[rng.integers(12, size=VEHICLES)] + own, rng.normal(0, 0.5, 8))


def measure(epochs: Epochs, detector: Detector, seed: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Detections of each epoch in chance order, and whose they are (−1 for nobody's)."""
    rng = np.random.default_rng(seed)
    measured, whose = [], []
    for _, ids, states in epochs:
        chance = np.where(speed_of(states) >= 1.0, detector.detected, detector.standing)
        seen = rng.random(len(states)) < chance
        clutter = rng.uniform(AREA_M[:2], AREA_M[2:], (rng.poisson(detector.clutter), 2))
        points = np.r_[states[seen, :2] + rng.normal(0, detector.sigma_m, (seen.sum(), 2)), clutter]
        order = rng.permutation(len(points))
        measured.append(points[order])
        whose.append(np.r_[ids[seen], np.full(len(clutter), -1)][order])
    return measured, whose


def column_of(ground: np.ndarray) -> np.ndarray:
    """Superpixel column that sees a point."""
    return np.floor((ground[:, 0] - AREA_M[0]) / COLUMN_M).astype(int)


def fly(
    design: track.TrackDesign,
    detector: Detector,
    epochs: Epochs,
    measured: list,
    whose: list | None,
    seed: int,
) -> tuple[Reports, float]:
    """Tracks of each epoch, and the mean number of spectra that reach a detection in a frame.

    Where it is said whose the detections are, each has its spectrum unasked.
    """
    colours, reports, used = paints(seed), [], 0
    state, queries = track.start(design, seed), ()
    for k, ((time_s, ids, states), points) in enumerate(zip(epochs, measured, strict=True)):
        n = len(points)
        covariance = np.repeat(detector.sigma_m**2 * np.eye(2)[None], n, axis=0)
        found = track.Detections(points, covariance, np.full(n, 4.0), np.ones(n))
        seen = track.given_detections(state, found, time_s, GRID)
        if design.query.at == "detection":
            queries = track.query_detections(state, seen, column_of)
        asked = np.array([(q.east_m, q.north_m) for q in queries]).reshape(-1, 2)
        spectra = colours.seen_at(asked, ids, states, np.random.default_rng((seed, 2, k)))
        bare = np.array([q.track_id < 0 for q in queries], bool)
        told = features.attach(asked[~bare], spectra[~bare], seen.found.position, design.identity.radius_m)
        if whose is not None:
            told = colours.of(whose[k], np.random.default_rng((seed, 3, k)))[order(found)]
        used += int(np.isfinite(told[:, 0]).sum())
        state = track.step_detections(state, seen, time_s, GRID, told, spectra[bare])
        state, queries = track.query_predictions(state, column_of)
        confirmed = state.targets.confirmed
        reports.append((state.targets.id[confirmed], state.targets.position[confirmed]))
    return reports, used / len(epochs)


def rows_of(
    name: str,
    epochs: Epochs,
    seeds: range,
    budgets: list[int],
    policies: list[str],
    places: list[str],
    mistaken: float,
) -> list[dict]:
    """One row a place of asking, policy, budget and seed."""
    detector, rows = CASES[name], []
    for seed in seeds:
        measured, whose = measure(epochs, detector, seed)
        for policy, budget, at in itertools.product(policies, budgets, places):
            oracle = policy == "told"
            if policy in WITHOUT_BUDGET and (budget, at) != (budgets[0], places[0]):
                continue
            design = DETECTIONS_DESIGN.replace(
                {
                    "query.policy": "none" if oracle else policy,
                    "query.budget": budget,
                    "query.at": at,
                    "association.method": "gnn",
                    "identity.outlier_share": 0.0 if oracle else mistaken,
                    "identity.radius_m": RADIUS_M,
                }
            )
            reports, spectra = fly(design, detector, epochs, measured, whose if oracle else None, seed)
            scores = score(epochs, reports)
            rows.append(
                {"case": name, "at": at, "policy": policy, "budget": budget, "seed": seed, "spectra": spectra}
                | {k: scores[k] for k in SHOWN}
            )
    return rows


def interval(values: np.ndarray) -> str:
    """Mean and half width of its 95 % interval."""
    half = scipy.stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values))
    return f"{values.mean():.4g} ± {half:.2g}"


def print_rows(rows: list[dict]) -> None:
    """A Markdown line for each case, budget and policy: means, and differences from `random`."""
    print(
        "| case | asked at | budget | policy | spectra a frame | "
        + " | ".join(SHOWN)
        + " | Δ purity | Δ switches |"
    )
    print("|" + " --- |" * (len(SHOWN) + 7))
    key = lambda row: (row["case"], row["at"], row["budget"], row["policy"])  # noqa: E731
    rank = lambda row: (*key(row)[:3], POLICIES.index(row["policy"]))  # noqa: E731
    groups = {k: list(v) for k, v in itertools.groupby(sorted(rows, key=rank), key)}
    for (case, at, budget, policy), mine in groups.items():
        cells = [f"{np.mean([r[k] for r in mine]):.4g}" for k in ("spectra", *SHOWN)]
        apart = ["", ""]
        random = groups.get((case, at, budget, "random"))
        if policy in ("round-robin", "entropy") and random:
            apart = [
                interval(np.array([a[k] - b[k] for a, b in zip(mine, random, strict=True)]))
                for k in ("purity", "identity_switches")
            ]
        told = "–" if policy in WITHOUT_BUDGET else "unlimited" if budget >= UNLIMITED else str(budget)
        place = "–" if policy in WITHOUT_BUDGET else at
        print(f"| {case} | {place} | {told} | {policy} | " + " | ".join((*cells, *apart)) + " |", flush=True)


def main() -> None:
    """Run, print and perhaps write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="two seeds, 30 frames, budget 20")
    parser.add_argument(
        "--tune", action="store_true", help="on the frames and seeds that choices were made on"
    )
    parser.add_argument("--policies", nargs="+", choices=POLICIES, default=list(POLICIES))
    parser.add_argument("--at", nargs="+", choices=PLACES, default=list(PLACES))
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--budgets", type=int, nargs="+", default=list(BUDGETS))
    parser.add_argument("--mistaken", type=float, default=MISTAKEN, help="as track.identity.outlier_share")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    args = parser.parse_args()
    start_s, seeds = TUNED_ON if args.tune else REPORTED
    budgets, frames = (args.budgets, 120 if start_s < 60 else 70)
    if args.quick:
        seeds, budgets, frames = seeds[:2], [20], 30
    epochs = traffic(frames, start_s=start_s)
    rows = []
    for name in args.cases:
        rows += rows_of(name, epochs, seeds, budgets, args.policies, args.at, args.mistaken)
        print_rows([row for row in rows if row["case"] == name])
    if args.json:
        args.json.write_text(json.dumps({"rows": rows}, indent=1))
        print(f"wrote {args.json}")


if __name__ == "__main__":
    main()
